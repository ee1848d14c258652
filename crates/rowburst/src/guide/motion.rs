//! Motion: `v(x, t) = a Σ_i w_i(t) G_i(x + d(x) + Σ_k (τ_k(t) − τ_k(t_i)) θ_k(x)) + c`.
//!
//! `d` is the affine map from the field to the guides, `θ_k` are displacements on a B-spline grid with a membrane prior,
//! `τ_k` cosines, `t_i` the times of the guides and `w_i` weights that pass from one guide to the next. With one guide of
//! unknown time `τ_k(t_i)` is left out and `k` begins at 0. Gauss–Newton from coarse to fine by a blur of the guides, with
//! conjugate gradients inside; gain `a` and offset `c` are fitted in every step.

use super::affine::{Affine, Field};
use super::basis::{Spline, cosine, cosines};
use super::frame_fit::FrameFit;
use super::least_squares::{conjugate_gradients, project};
use super::picture;
use rayon::prelude::*;
use rowburst_core::vecmath::{dot, norm_squared};
use rowburst_optics::Image;

/// Pixels between control points on a field of 108; larger is smoother.
const SPACING_PX: f64 = 6.0;
/// Weight of the membrane prior; larger is smoother.
const SMOOTHNESS: f64 = 3.0;
/// Conjugate gradients in a Gauss–Newton step.
const INNER: usize = 16;
/// Part of the objective that a step must leave at most, or the steps end.
const MIN_PROGRESS: f64 = 0.999;
/// Factors of a step that are tried one after another.
const STEP_FACTORS: [f32; 4] = [1.0, 0.4, 0.16, 0.064];
/// Standard deviation of a parameter of the affine map about its start, in pixels of a field of 108.
const AFFINE_PX: f64 = 3.0;

/// A guide on the grid of the field.
#[derive(Clone)]
pub(super) struct KeyFrame {
    /// The picture.
    pub image: Image,
    /// First and last bin of its exposure, as fractions of bins; `None`: its time is unknown.
    pub bins: Option<(f64, f64)>,
}

/// The model without its parameters.
pub(super) struct MotionModel<'a> {
    frame: &'a FrameFit<'a>,
    field: Field,
    spline: Spline,
    /// Highest cosine.
    order: usize,
    /// First cosine: 0 where the time of the guide is unknown, else 1.
    first: usize,
    /// `τ_k(t) − τ_k(t_i)` of each guide, `[i][k][t]`.
    times: Vec<Vec<Vec<f32>>>,
    /// `w_i(t)`.
    shares: Vec<Vec<f32>>,
    guides: Vec<Image>,
    start: Affine,
    /// Light of an even video in the frame.
    even: Vec<f32>,
    target: Vec<f32>,
}

/// The parameters.
#[derive(Clone)]
pub(super) struct Motion {
    /// Along y and x, each: the sets of control points of `θ_k`, then the three parameters of the affine map's change.
    values: Vec<f32>,
    pub gain: f64,
    pub offset: f64,
    misfit: f64,
}

/// Values and gradients of the guides at the present places.
struct Linearised {
    /// Video without gain and offset.
    video: Vec<f32>,
    /// Gradients along y and x of each guide times its share, `[i][t, y, x]`.
    along_y: Vec<Vec<f32>>,
    along_x: Vec<Vec<f32>>,
}

impl<'a> MotionModel<'a> {
    /// Motion with cosines up to `order` on the fitted pixels of `frame`.
    pub fn new(frame: &'a FrameFit<'a>, guides: &[KeyFrame], start: Affine, order: usize) -> Self {
        let shape = frame.shape();
        let field = Field {
            rows: shape.rows,
            columns: shape.columns,
        };
        let unit = field.half_side() / 54.0;
        let first = usize::from(guides.iter().all(|g| g.bins.is_some()));
        Self {
            spline: Spline::new(shape.rows, shape.columns, SPACING_PX * unit),
            times: guides
                .iter()
                .map(|guide| times_of(guide, first, order, shape.bins))
                .collect(),
            shares: shares(guides, shape.bins),
            guides: guides.iter().map(|g| g.image.clone()).collect(),
            even: frame.apply(&vec![1.0; shape.voxels()]),
            target: frame.target(),
            frame,
            field,
            order,
            first,
            start,
        }
    }

    /// Number of displacement fields `θ_k`.
    fn modes(&self) -> usize {
        self.order + 1 - self.first
    }

    /// Number of parameters, with gain and offset.
    pub fn parameters(&self) -> usize {
        2 * self.axis_len() + 2
    }

    /// Parameters along one axis.
    fn axis_len(&self) -> usize {
        self.modes() * self.spline.points() + 3
    }

    /// Factor of the affine parameters, which gives them the curvature of a control point's.
    fn affine_scale(&self) -> f32 {
        2.0 / (self.spline.points() as f32).sqrt()
    }

    /// No motion.
    pub fn at_rest(&self) -> Motion {
        let mut motion = Motion {
            values: vec![0.0; 2 * self.axis_len()],
            gain: 1.0,
            offset: 0.0,
            misfit: f64::INFINITY,
        };
        self.evaluate(&mut motion, &self.guides);
        motion
    }

    /// The motion of a model with fewer cosines.
    pub fn extended(&self, other: &Self, motion: &Motion) -> Motion {
        let points = self.spline.points();
        let mut values = vec![0.0; 2 * self.axis_len()];
        let (from, to) = (other.axis_len(), self.axis_len());
        let shared = other.modes().min(self.modes()) * points;
        for axis in 0..2 {
            let old = &motion.values[axis * from..(axis + 1) * from];
            let new = &mut values[axis * to..(axis + 1) * to];
            new[..shared].copy_from_slice(&old[..shared]);
            new[to - 3..].copy_from_slice(&old[from - 3..]);
        }
        Motion { values, ..*motion }
    }

    /// Gauss–Newton steps with the guides blurred by each of `blurs`, in pixels of a field of 108.
    pub fn fit(&self, motion: &mut Motion, blurs: &[f64], steps: usize) {
        let unit = self.field.half_side() / 54.0;
        for blur in blurs {
            let guides: Vec<Image> = self.guides.iter().map(|g| g.blurred(blur * unit)).collect();
            self.evaluate(motion, &guides);
            for _ in 0..steps {
                if self.frame.cancel().is_cancelled() || !self.step(motion, &guides) {
                    break;
                }
            }
        }
    }

    /// A Gauss–Newton step. Returns whether it made the objective smaller by a visible part.
    fn step(&self, motion: &mut Motion, guides: &[Image]) -> bool {
        let at = self.linearise(motion, guides);
        let residual = self.residual(motion, &at.video);
        let gain = motion.gain as f32;
        let mut rhs = self.reduce(&self.frame.adjoint(&residual), &at);
        rhs.iter_mut().for_each(|r| *r *= gain);
        let prior = self.prior(&motion.values);
        rhs.iter_mut().zip(&prior).for_each(|(r, p)| *r -= p);
        let normal = |d: &[f32]| {
            let frame = self.frame.apply(&self.change(d, &at));
            let mut product = self.reduce(&self.frame.adjoint(&frame), &at);
            let prior = self.prior(d);
            product
                .iter_mut()
                .zip(&prior)
                .for_each(|(p, q)| *p = gain * gain * *p + q);
            product
        };
        let step = conjugate_gradients(normal, &rhs, INNER, 1e-2, self.frame.cancel());
        let before = motion.misfit;
        for factor in STEP_FACTORS {
            let mut next = motion.clone();
            next.values
                .iter_mut()
                .zip(&step)
                .for_each(|(v, s)| *v += factor * s);
            self.evaluate(&mut next, guides);
            if next.misfit < before {
                *motion = next;
                return motion.misfit < MIN_PROGRESS * before;
            }
        }
        false
    }

    /// Finds gain and offset, and the objective.
    fn evaluate(&self, motion: &mut Motion, guides: &[Image]) {
        let video = self.warped(motion, guides);
        let light = self.frame.apply(&video);
        let fit = project(&[&light, &self.even], &self.target);
        (motion.gain, motion.offset) = (fit[0], fit[1]);
        let misfit: f64 = (0..light.len())
            .map(|i| {
                let model = fit[0] * f64::from(light[i]) + fit[1] * f64::from(self.even[i]);
                (f64::from(self.target[i]) - model).powi(2)
            })
            .sum();
        motion.misfit = misfit + dot(&motion.values, &self.prior(&motion.values));
    }

    fn residual(&self, motion: &Motion, video: &[f32]) -> Vec<f32> {
        let light = self.frame.apply(video);
        let (gain, offset) = (motion.gain as f32, motion.offset as f32);
        (0..light.len())
            .map(|i| self.target[i] - gain * light[i] - offset * self.even[i])
            .collect()
    }

    /// The video of the model, without negative light.
    pub fn video(&self, motion: &Motion) -> Vec<f32> {
        self.light(motion, &self.guides)
    }

    fn light(&self, motion: &Motion, guides: &[Image]) -> Vec<f32> {
        let (gain, offset) = (motion.gain as f32, motion.offset as f32);
        let mut video = self.warped(motion, guides);
        video
            .par_iter_mut()
            .for_each(|v| *v = (gain * *v + offset).max(0.0));
        video
    }

    /// Which blur of the guides, in pixels, fits the frame best with this motion.
    pub fn best_blur(&self, motion: &Motion, blurs: &[f64]) -> f64 {
        let misfit = |blur: f64| {
            let guides: Vec<Image> = self.guides.iter().map(|g| g.blurred(blur)).collect();
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
        let guides: Vec<Image> = self.guides.iter().map(|g| g.blurred(blur)).collect();
        let mut motion = motion.clone();
        self.evaluate(&mut motion, &guides);
        (self.light(&motion, &guides), motion.gain, motion.offset)
    }

    /// The affine map, its correction included.
    pub fn affine(&self, motion: &Motion) -> Affine {
        let (n, scale) = (self.axis_len(), f64::from(self.affine_scale()));
        let change = |k: usize| {
            let axis = &motion.values[(k / 3) * n..(k / 3 + 1) * n];
            scale * f64::from(axis[n - 3 + k % 3])
        };
        let parameters = std::array::from_fn(|k| self.start.parameters[k] + change(k));
        Affine { parameters }
    }

    /// Images of the displacement along each axis, `[axis][mode, y, x]`; the last mode is the affine change.
    fn displacements(&self, values: &[f32]) -> [Vec<f32>; 2] {
        let (n, pixels) = (self.axis_len(), self.field.rows * self.field.columns);
        std::array::from_fn(|axis| {
            let values = &values[axis * n..(axis + 1) * n];
            let (control, affine) = values.split_at(n - 3);
            let mut images = self.spline.expand(control);
            let scale = self.affine_scale();
            images.extend((0..pixels).map(|i| {
                let (eta, xi) = self.field.place(i);
                scale * (affine[0] + affine[1] * eta + affine[2] * xi)
            }));
            images
        })
    }

    /// Factor of mode `m` in the displacement of guide `i` in bin `t`.
    fn factor(&self, i: usize, m: usize, t: usize) -> f32 {
        self.times[i].get(m).map_or(1.0, |times| times[t])
    }

    /// Sum of the displacement images of guide `i` in bin `t`.
    fn displacement(&self, images: &[f32], i: usize, t: usize, out: &mut [f32]) {
        out.fill(0.0);
        for (m, image) in images.chunks_exact(out.len()).enumerate() {
            let factor = self.factor(i, m, t);
            out.iter_mut()
                .zip(image)
                .for_each(|(d, u)| *d += factor * u);
        }
    }

    /// Calls `act(bin, dy, dx, t, i)` with the displacements of each guide in each bin of `video`.
    fn for_each_bin(
        &self,
        values: &[f32],
        video: &mut [f32],
        act: impl Fn(&mut [f32], &[f32], &[f32], usize, usize) + Sync,
    ) {
        let pixels = self.field.rows * self.field.columns;
        let [along_y, along_x] = self.displacements(values);
        let scratch = || (vec![0.0f32; pixels], vec![0.0f32; pixels]);
        let bins = video.par_chunks_mut(pixels).enumerate();
        bins.for_each_init(scratch, |(dy, dx), (t, bin)| {
            for i in (0..self.guides.len()).filter(|&i| self.shares[i][t] > 0.0) {
                self.displacement(&along_y, i, t, dy);
                self.displacement(&along_x, i, t, dx);
                act(bin, dy, dx, t, i);
            }
        });
    }

    /// The guides at the displaced places, without gain and offset.
    fn warped(&self, motion: &Motion, guides: &[Image]) -> Vec<f32> {
        let (start_y, start_x) = self.field.displacement(&self.start);
        let columns = self.field.columns;
        let mut video = vec![0.0; self.frame.shape().voxels()];
        self.for_each_bin(&motion.values, &mut video, |bin, dy, dx, t, i| {
            let share = self.shares[i][t];
            for (p, v) in bin.iter_mut().enumerate() {
                let y = (p / columns) as f32 + start_y[p] + dy[p];
                let x = (p % columns) as f32 + start_x[p] + dx[p];
                *v += share * picture::at(&guides[i], y, x).0;
            }
        });
        video
    }

    /// Video and gradients at `motion`.
    fn linearise(&self, motion: &Motion, guides: &[Image]) -> Linearised {
        let (start_y, start_x) = self.field.displacement(&self.start);
        let (columns, voxels) = (self.field.columns, self.frame.shape().voxels());
        let pixels = start_y.len();
        let mut at = Linearised {
            video: vec![0.0; voxels],
            along_y: vec![vec![0.0; voxels]; guides.len()],
            along_x: vec![vec![0.0; voxels]; guides.len()],
        };
        let [images_y, images_x] = self.displacements(&motion.values);
        for (i, guide) in guides.iter().enumerate() {
            let bins = at.video.par_chunks_mut(pixels).enumerate();
            let gradients = at.along_y[i]
                .par_chunks_mut(pixels)
                .zip(at.along_x[i].par_chunks_mut(pixels));
            bins.zip(gradients).for_each(|((t, bin), (gy, gx))| {
                let share = self.shares[i][t];
                if share == 0.0 {
                    return;
                }
                let (mut dy, mut dx) = (vec![0.0; pixels], vec![0.0; pixels]);
                self.displacement(&images_y, i, t, &mut dy);
                self.displacement(&images_x, i, t, &mut dx);
                for p in 0..pixels {
                    let y = (p / columns) as f32 + start_y[p] + dy[p];
                    let x = (p % columns) as f32 + start_x[p] + dx[p];
                    let (value, along_y, along_x) = picture::at(guide, y, x);
                    bin[p] += share * value;
                    gy[p] = share * along_y;
                    gx[p] = share * along_x;
                }
            });
        }
        at
    }

    /// Change of the video, without gain, under the change `d` of the parameters.
    fn change(&self, d: &[f32], at: &Linearised) -> Vec<f32> {
        let mut video = vec![0.0; self.frame.shape().voxels()];
        self.for_each_bin(d, &mut video, |bin, dy, dx, t, i| {
            let range = t * bin.len()..(t + 1) * bin.len();
            let (gy, gx) = (&at.along_y[i][range.clone()], &at.along_x[i][range]);
            for p in 0..bin.len() {
                bin[p] += gy[p] * dy[p] + gx[p] * dx[p];
            }
        });
        video
    }

    /// The adjoint of [`Self::change`].
    fn reduce(&self, video: &[f32], at: &Linearised) -> Vec<f32> {
        let pixels = self.field.rows * self.field.columns;
        let mut out = Vec::with_capacity(2 * self.axis_len());
        for gradients in [&at.along_y, &at.along_x] {
            let mut images = vec![0.0f32; (self.modes() + 1) * pixels];
            // Sums over time, for parts of the pixels in parallel.
            let parts: Vec<(usize, Vec<f32>)> = (0..pixels)
                .step_by(PART)
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|start| (start, self.reduce_part(start, video, gradients)))
                .collect();
            for (start, part) in parts {
                let length = part.len() / (self.modes() + 1);
                for (m, line) in part.chunks_exact(length).enumerate() {
                    images[m * pixels + start..m * pixels + start + length].copy_from_slice(line);
                }
            }
            let (modes, affine) = images.split_at(self.modes() * pixels);
            out.extend(self.spline.reduce(modes));
            let mut sums = [0.0f64; 3];
            for (i, value) in affine.iter().enumerate() {
                let (eta, xi) = self.field.place(i);
                let value = f64::from(*value);
                sums[0] += value;
                sums[1] += value * f64::from(eta);
                sums[2] += value * f64::from(xi);
            }
            let scale = f64::from(self.affine_scale());
            out.extend(sums.map(|s| (scale * s) as f32));
        }
        out
    }

    /// `Σ_t Σ_i factor · gradient · video` of the pixels from `start` on, for every mode.
    fn reduce_part(&self, start: usize, video: &[f32], gradients: &[Vec<f32>]) -> Vec<f32> {
        let pixels = self.field.rows * self.field.columns;
        let length = PART.min(pixels - start);
        let mut sums = vec![0.0f32; (self.modes() + 1) * length];
        let mut product = vec![0.0f32; length];
        for t in 0..self.frame.shape().bins {
            let at = t * pixels + start;
            let video = &video[at..at + length];
            for (i, gradient) in gradients.iter().enumerate() {
                if self.shares[i][t] == 0.0 {
                    continue;
                }
                let gradient = &gradient[at..at + length];
                for p in 0..length {
                    product[p] = gradient[p] * video[p];
                }
                for (m, sums) in sums.chunks_exact_mut(length).enumerate() {
                    let factor = self.factor(i, m, t);
                    sums.iter_mut()
                        .zip(&product)
                        .for_each(|(s, p)| *s += factor * p);
                }
            }
        }
        sums
    }

    /// The gradient of the prior at `values`.
    fn prior(&self, values: &[f32]) -> Vec<f32> {
        let (n, points) = (self.axis_len(), self.spline.points());
        let unit = self.field.half_side() / 54.0;
        let affine = f64::from(self.affine_scale()) / (AFFINE_PX * unit);
        let mut out = vec![0.0; values.len()];
        for (values, out) in values.chunks_exact(n).zip(out.chunks_exact_mut(n)) {
            for m in 0..self.modes() {
                let range = m * points..(m + 1) * points;
                let order = (m + self.first) as f64;
                let weight = SMOOTHNESS * (1.0 + order).sqrt() / (unit * unit);
                self.spline
                    .add_membrane(&values[range.clone()], weight as f32, &mut out[range]);
            }
            for k in n - 3..n {
                out[k] = (affine * affine) as f32 * values[k];
            }
        }
        out
    }

    /// Root mean square displacement over the field and the bins, in pixels.
    pub fn rms_displacement_px(&self, motion: &Motion) -> f64 {
        let mut values = motion.values.clone();
        let n = self.axis_len();
        values
            .chunks_exact_mut(n)
            .for_each(|axis| axis[n - 3..].fill(0.0));
        let mut squares = vec![0.0; self.frame.shape().voxels()];
        self.for_each_bin(&values, &mut squares, |bin, dy, dx, t, i| {
            for p in 0..bin.len() {
                bin[p] += self.shares[i][t].sqrt() * dy[p].hypot(dx[p]);
            }
        });
        (norm_squared(&squares) / squares.len() as f64).sqrt()
    }
}

/// Pixels of a parallel part of [`MotionModel::reduce`].
const PART: usize = 1 << 11;

/// `τ_k(t) − τ_k(t_i)` for the cosines from `first` to `order`.
fn times_of(guide: &KeyFrame, first: usize, order: usize, bins: usize) -> Vec<Vec<f32>> {
    let lines = cosines(order + 1, bins).into_iter().enumerate().skip(first);
    lines
        .map(|(k, line)| {
            let at = guide.bins.filter(|_| first == 1).map_or(0.0, |(from, to)| {
                let samples = 9;
                let place = |s: usize| from + (to - from) * s as f64 / f64::from(samples - 1);
                let sum: f64 = (0..samples as usize)
                    .map(|s| cosine(k, place(s), bins))
                    .sum();
                sum / f64::from(samples)
            });
            line.into_iter().map(|v| v - at as f32).collect()
        })
        .collect()
}

/// Weight of each guide in each bin: linear between the times of neighbouring guides.
fn shares(guides: &[KeyFrame], bins: usize) -> Vec<Vec<f32>> {
    let middle = |g: &KeyFrame| g.bins.map_or(0.0, |(from, to)| 0.5 * (from + to));
    let times: Vec<f64> = guides.iter().map(middle).collect();
    let share = |i: usize, t: f64| {
        let before = times.iter().filter(|s| **s < times[i]).copied();
        let after = times.iter().filter(|s| **s > times[i]).copied();
        let before = before.fold(f64::NEG_INFINITY, f64::max);
        let after = after.fold(f64::INFINITY, f64::min);
        if t < times[i] && before.is_finite() {
            ((t - before) / (times[i] - before)).max(0.0)
        } else if t > times[i] && after.is_finite() {
            ((after - t) / (after - times[i])).max(0.0)
        } else {
            1.0
        }
    };
    (0..guides.len())
        .map(|i| (0..bins).map(|t| share(i, t as f64) as f32).collect())
        .collect()
}
