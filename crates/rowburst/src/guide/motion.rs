//! A fit of motion, `a v(x, t) + c` with the video `v` of [`Flow`]: Gauss–Newton from coarse to fine by a blur of the guides, with
//! conjugate gradients inside. Gain `a` and offset `c` follow the motion: they are fitted in every step, and inside it what they explain is
//! taken out (variable projection; Kaufman, BIT 15, 49, 1975). The margins of the guides are fitted before the steps.

use super::affine::{Affine, Field};
use super::flow::{DrawnVideo, Flow};
use super::frame_fit::FrameFit;
use super::key_frames::KeyFrame;
use super::least_squares::{conjugate_gradients, project};
use super::margin::Margin;
use super::smoothness::{PriorFactors, Smoothness};
use rayon::prelude::*;
use rowburst_core::vecmath::norm_squared;
use rowburst_optics::Image;

/// Conjugate gradients in a Gauss–Newton step.
const INNER: usize = 16;
/// The steps end with one that leaves more than this part of the objective; larger takes more steps.
const MIN_PROGRESS: f64 = 0.996;
/// Factors of a step that are tried one after another.
const STEP_FACTORS: [f32; 4] = [1.0, 0.4, 0.16, 0.064];
/// Standard deviation of a parameter of the affine map about its start, in pixels of a field of 108.
const AFFINE_PX: f64 = 3.0;

/// The model without its parameters.
pub(super) struct MotionModel<'a> {
    frame: &'a FrameFit<'a>,
    flow: Flow,
    smoothness: Smoothness,
    margin: Margin,
    /// The guides with margins of their edge values, where a fit begins.
    guides: Vec<Image>,
    /// Pixels per pixel of a field of 108.
    unit: f64,
    /// Light of an even video in the frame.
    even: Vec<f32>,
    target: Vec<f32>,
}

/// The parameters.
#[derive(Clone)]
pub(super) struct Motion {
    /// Those of [`Flow`].
    values: Vec<f32>,
    /// The guides with fitted margins.
    guides: Vec<Image>,
    pub gain: f64,
    pub offset: f64,
    /// The objective of the fit that found it, without the prior of the margins.
    misfit: f64,
}

/// The video of a motion and its light in the frame, without gain and offset.
struct Evaluated {
    drawn: DrawnVideo,
    light: Vec<f32>,
}

impl<'a> MotionModel<'a> {
    /// Motion with modes up to `order` on the fitted pixels of `frame`.
    pub fn new(frame: &'a FrameFit<'a>, guides: &[KeyFrame], start: Affine, order: usize) -> Self {
        let shape = frame.shape();
        let field = Field::of(shape);
        let unit = field.half_side() / 54.0;
        let margin = Margin::new(unit);
        let first = usize::from(guides.iter().all(|g| g.bins.is_some()));
        Self {
            flow: Flow::new(shape, guides, start, first..=order, margin.width),
            smoothness: Smoothness::new(first..=order, unit),
            guides: guides.iter().map(|g| margin.around(&g.image)).collect(),
            margin,
            unit,
            even: frame.apply(&vec![1.0; shape.voxels()]),
            target: frame.target(),
            frame,
        }
    }

    /// Number of parameters, with gain and offset.
    pub fn parameters(&self) -> usize {
        2 * self.flow.axis_len() + 2
    }

    /// No motion.
    pub fn at_rest(&self) -> Motion {
        let mut motion = Motion {
            values: vec![0.0; 2 * self.flow.axis_len()],
            guides: self.guides.clone(),
            gain: 1.0,
            offset: 0.0,
            misfit: f64::INFINITY,
        };
        self.evaluate(&mut motion, &self.guides);
        motion
    }

    /// The motion of a model with fewer modes.
    pub fn extended(&self, other: &Self, motion: &Motion) -> Motion {
        let (from, to) = (other.flow.axis_len(), self.flow.axis_len());
        let mut values = vec![0.0; 2 * to];
        let shared = from.min(to) - 3;
        for axis in 0..2 {
            let old = &motion.values[axis * from..(axis + 1) * from];
            let new = &mut values[axis * to..(axis + 1) * to];
            new[..shared].copy_from_slice(&old[..shared]);
            new[to - 3..].copy_from_slice(&old[from - 3..]);
        }
        Motion {
            values,
            ..motion.clone()
        }
    }

    /// The motion of a model with a guide of known time, at the place `bin`, for this one, whose guide has no time.
    pub fn of_known_time(&self, motion: &Motion, bin: f64) -> Motion {
        let values = self.flow.of_known_time(&motion.values, bin);
        Motion {
            values,
            ..motion.clone()
        }
    }

    /// The guides blurred by `pixels`.
    fn blurred(motion: &Motion, pixels: f64) -> Vec<Image> {
        motion.guides.iter().map(|g| g.blurred(pixels)).collect()
    }

    /// Gauss–Newton steps with the guides blurred by each of `blurs`, in pixels of a field of 108.
    pub fn fit(&self, motion: &mut Motion, blurs: &[f64], steps: usize) {
        self.fill_margins(motion);
        for blur in blurs {
            let guides = Self::blurred(motion, blur * self.unit);
            let mut at = self.evaluate(motion, &guides);
            for _ in 0..steps {
                if self.frame.cancel().is_cancelled() || !self.step(motion, &mut at, &guides) {
                    break;
                }
            }
        }
    }

    /// Fits the margins of the guides, one after another, with this motion.
    fn fill_margins(&self, motion: &mut Motion) {
        for i in 0..motion.guides.len() {
            if self.frame.cancel().is_cancelled() {
                return;
            }
            let guides = motion.guides.clone();
            let at = self.evaluate(motion, &guides);
            let residual = self.residual(motion, &at.light);
            let sample = self.flow.samples(&motion.values, &at.drawn, i);
            let (guide, gain) = (&mut motion.guides[i], motion.gain);
            self.margin.fill(guide, self.frame, sample, &residual, gain);
        }
    }

    /// A Gauss–Newton step. Returns whether it made the objective smaller by a visible part.
    fn step(&self, motion: &mut Motion, at: &mut Evaluated, guides: &[Image]) -> bool {
        let derivative = self.flow.derivative(&motion.values, &at.drawn, guides);
        let residual = self.residual(motion, &at.light);
        let gain = motion.gain as f32;
        let mut rhs = derivative.adjoint(&self.frame.adjoint(&residual));
        rhs.iter_mut().for_each(|r| *r *= gain);
        let control = self.flow.control(&motion.values);
        let factors = self.smoothness.factors(self.flow.spline(), control);
        let prior = self.prior(&factors, &motion.values);
        rhs.iter_mut().zip(&prior).for_each(|(r, p)| *r -= p);
        let normal = |d: &[f32]| {
            let mut frame = self.frame.apply(&derivative.apply(d));
            let shares = project(&[&at.light, &self.even], &frame);
            for (f, light) in frame.iter_mut().zip(self.combined(&shares, &at.light)) {
                *f -= light;
            }
            let mut product = derivative.adjoint(&self.frame.adjoint(&frame));
            let prior = self.prior(&factors, d);
            product
                .iter_mut()
                .zip(&prior)
                .for_each(|(p, q)| *p = gain * gain * *p + q);
            product
        };
        let step = conjugate_gradients(normal, &rhs, INNER, 1e-2, self.frame.cancel());
        drop(derivative);
        let before = motion.misfit;
        for factor in STEP_FACTORS {
            let mut next = motion.clone();
            next.values
                .iter_mut()
                .zip(&step)
                .for_each(|(v, s)| *v += factor * s);
            let next_at = self.evaluate(&mut next, guides);
            if next.misfit < before {
                (*motion, *at) = (next, next_at);
                return motion.misfit < MIN_PROGRESS * before;
            }
        }
        false
    }

    /// Draws the video, and finds gain, offset and the objective.
    fn evaluate(&self, motion: &mut Motion, guides: &[Image]) -> Evaluated {
        let drawn = self.flow.draw(&motion.values, guides);
        let light = self.frame.apply(&drawn.video);
        let fit = project(&[&light, &self.even], &self.target);
        (motion.gain, motion.offset) = (fit[0], fit[1]);
        let control = self.flow.control(&motion.values);
        motion.misfit = norm_squared(&self.residual(motion, &light))
            + self.smoothness.energy(self.flow.spline(), control)
            + self.affine_energy(&motion.values);
        Evaluated { drawn, light }
    }

    /// Light of a video and of an even one in the frame, with the factors `factors`.
    fn combined<'l>(&'l self, factors: &[f64], light: &'l [f32]) -> impl Iterator<Item = f32> + 'l {
        let [gain, offset] = [factors[0] as f32, factors[1] as f32];
        let pairs = light.iter().zip(&self.even);
        pairs.map(move |(light, even)| gain * light + offset * even)
    }

    /// The objective, with the prior of the margins.
    pub fn objective(&self, motion: &Motion) -> f64 {
        let margins = motion.guides.iter().map(|g| self.margin.energy(g));
        motion.misfit + margins.sum::<f64>()
    }

    fn residual(&self, motion: &Motion, light: &[f32]) -> Vec<f32> {
        let model = self.combined(&[motion.gain, motion.offset], light);
        self.target.iter().zip(model).map(|(t, m)| t - m).collect()
    }

    /// The video of the model, without negative light.
    pub fn video(&self, motion: &Motion) -> Vec<f32> {
        self.light(motion, &motion.guides)
    }

    fn light(&self, motion: &Motion, guides: &[Image]) -> Vec<f32> {
        let (gain, offset) = (motion.gain as f32, motion.offset as f32);
        let mut video = self.flow.draw(&motion.values, guides).video;
        video
            .par_iter_mut()
            .for_each(|v| *v = (gain * *v + offset).max(0.0));
        video
    }

    /// Which blur of the guides, in pixels, fits the frame best with this motion.
    pub fn best_blur(&self, motion: &Motion, blurs: &[f64]) -> f64 {
        let misfit = |blur: f64| {
            let guides = Self::blurred(motion, blur);
            let mut motion = motion.clone();
            self.evaluate(&mut motion, &guides);
            motion.misfit
        };
        let pairs = blurs.iter().map(|&blur| (blur, misfit(blur)));
        let best = pairs.min_by(|a, b| a.1.total_cmp(&b.1));
        best.map_or(0.0, |(blur, _)| blur)
    }

    /// The video with the guides blurred by `blur` pixels, with gain and offset.
    pub fn blurred_video(&self, motion: &Motion, blur: f64) -> (Vec<f32>, f64, f64) {
        let guides = Self::blurred(motion, blur);
        let mut motion = motion.clone();
        self.evaluate(&mut motion, &guides);
        (self.light(&motion, &guides), motion.gain, motion.offset)
    }

    /// The affine map, its change included.
    pub fn affine(&self, motion: &Motion) -> Affine {
        self.flow.affine(&motion.values)
    }

    /// Root mean square displacement over the field and the bins, in pixels.
    pub fn rms_displacement_px(&self, motion: &Motion) -> f64 {
        self.flow.rms_displacement_px(&motion.values)
    }

    /// Weight of a squared affine parameter.
    fn affine_weight(&self) -> f64 {
        (f64::from(self.flow.affine_scale()) / (AFFINE_PX * self.unit)).powi(2)
    }

    /// The prior of the affine parameters.
    fn affine_energy(&self, values: &[f32]) -> f64 {
        let n = self.flow.axis_len();
        let affine = values
            .chunks_exact(n)
            .map(|axis| norm_squared(&axis[n - 3..]));
        self.affine_weight() * affine.sum::<f64>()
    }

    /// The curvature of the prior at the motion of `factors`, times `d`.
    fn prior(&self, factors: &PriorFactors, d: &[f32]) -> Vec<f32> {
        let (n, weight) = (self.flow.axis_len(), self.affine_weight() as f32);
        let mut out = vec![0.0; d.len()];
        for (d, out) in d.chunks_exact(n).zip(out.chunks_exact_mut(n)) {
            let (control, affine) = out.split_at_mut(n - 3);
            self.smoothness
                .add_product(self.flow.spline(), factors, &d[..n - 3], control);
            for (out, d) in affine.iter_mut().zip(&d[n - 3..]) {
                *out = weight * d;
            }
        }
        out
    }
}
