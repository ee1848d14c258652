//! Gain field: `v(x, t) = G(x + d(x)) Σ_k φ_k(x) τ_k(t)`, known places with unknown brightness.
//!
//! `φ_k` lie on a B-spline grid, so the video is linear in them: one least-squares problem. What is dark in the guide stays
//! dark. The affine map `d` is corrected by Gauss–Newton steps between solutions.

use super::affine::{Affine, Field};
use super::basis::{Spline, cosines};
use super::frame_fit::FrameFit;
use super::least_squares::{conjugate_gradients, project};
use super::margin::Margin;
use super::picture::{self, GuideSample};
use rayon::prelude::*;
use rowburst_core::vecmath::{dot, norm_squared, solve_normal};
use rowburst_optics::Image;

/// Cosines in time.
const MODES: usize = 8;
/// Pixels between control points on a field of 108; larger is smoother.
const SPACING_PX: f64 = 5.0;
/// Weight of the prior on a coefficient of the k-th cosine, over `max(k, ½)`; larger keeps the gain even.
const WEIGHT: f64 = 100.0;
/// Conjugate gradients of the first solution, and of those after a correction of the map.
const ITERATIONS: usize = 60;
const RESTART_ITERATIONS: usize = 25;
/// Corrections of the affine map.
const CORRECTIONS: usize = 3;
/// Fits of the margin for a scene at rest.
const STILL_FILLS: usize = 2;
/// Standard deviation of a parameter of the affine map about its start, in pixels of a field of 108.
const AFFINE_PX: f64 = 3.0;

/// The model without its parameters.
pub(super) struct GainModel<'a> {
    frame: &'a FrameFit<'a>,
    field: Field,
    spline: Spline,
    time: Vec<Vec<f32>>,
    margin: Margin,
    /// The guide with its margin.
    guide: Image,
    start: Affine,
    target: Vec<f32>,
}

/// The parameters.
#[derive(Clone)]
pub(super) struct GainField {
    control: Vec<f32>,
    /// Gain of the guide that the field varies about.
    pub gain: f64,
    pub affine: Affine,
    /// The guide with its margin.
    guide: Image,
}

impl<'a> GainModel<'a> {
    /// A gain field on `guide` for the fitted pixels of `frame`.
    pub fn new(frame: &'a FrameFit<'a>, guide: &Image, start: Affine) -> Self {
        let shape = frame.shape();
        let field = Field::of(shape);
        let unit = field.half_side() / 54.0;
        let margin = Margin::new(unit);
        let mut guide = margin.around(guide);
        guide.data_mut().iter_mut().for_each(|g| *g = g.max(0.0));
        Self {
            spline: Spline::new(shape.rows, shape.columns, SPACING_PX * unit),
            time: cosines(MODES.min(shape.bins), shape.bins),
            target: frame.target(),
            frame,
            field,
            margin,
            guide,
            start,
        }
    }

    /// Number of parameters, with those of the map.
    pub fn parameters(&self) -> usize {
        self.time.len() * self.spline.points() + 6
    }

    /// The best gain field, and affine map.
    pub fn fit(&self) -> GainField {
        let points = self.spline.points();
        let mut control = vec![0.0; self.time.len() * points];
        control[..points].fill(1.0);
        let mut found = GainField {
            control,
            gain: 1.0,
            affine: self.start,
            guide: self.guide.clone(),
        };
        let even = self
            .frame
            .apply(&self.expand(&found.control, &self.warped(&found)));
        let gain = dot(&even, &self.target) / norm_squared(&even).max(f64::MIN_POSITIVE);
        found.gain = gain.max(0.0);
        self.fill_margin(&mut found);
        self.solve(&mut found, ITERATIONS);
        for _ in 0..CORRECTIONS {
            if self.frame.cancel().is_cancelled() || !self.correct_affine(&mut found) {
                break;
            }
            self.refit(&mut found);
        }
        found
    }

    /// Goes on from `found`, with another map or other pixels.
    pub fn refit(&self, found: &mut GainField) {
        self.fill_margin(found);
        self.solve(found, RESTART_ITERATIONS);
    }

    /// The video of the model, without negative light.
    pub fn video(&self, found: &GainField) -> Vec<f32> {
        let mut video = self.expand(&found.control, &self.warped(found));
        let gain = found.gain as f32;
        video.par_iter_mut().for_each(|v| *v = (gain * *v).max(0.0));
        video
    }

    fn warped(&self, found: &GainField) -> Vec<f32> {
        let map = self.margin.map(&found.affine);
        self.field.warp(&found.guide, &map).into_data()
    }

    /// Fits the margin of the guide with this gain field.
    fn fill_margin(&self, found: &mut GainField) {
        let residual = self.residual(found);
        let map = self.margin.map(&found.affine);
        let factors = self.expand(
            &found.control,
            &vec![1.0; self.field.rows * self.field.columns],
        );
        let sample = |v: usize| GuideSample {
            weight: factors[v],
            ..self.field.sample(&map, v)
        };
        let gain = found.gain;
        self.margin
            .fill(&mut found.guide, self.frame, sample, &residual, gain);
        let pixels = found.guide.data_mut().iter_mut();
        pixels.for_each(|p| *p = p.max(0.0));
    }

    /// Conjugate gradients in the control points.
    fn solve(&self, found: &mut GainField, iterations: usize) {
        let guide = self.warped(found);
        let gain = found.gain as f32;
        let light = self.frame.apply(&self.expand(&found.control, &guide));
        let residual: Vec<f32> = self
            .target
            .iter()
            .zip(&light)
            .map(|(b, a)| b - gain * a)
            .collect();
        let prior = |control: &[f32]| -> Vec<f32> {
            let points = self.spline.points();
            let weight = |i: usize| (WEIGHT * (i as f64).max(0.5)) as f32;
            let modes = control.chunks_exact(points).enumerate();
            modes
                .flat_map(|(k, c)| c.iter().map(move |c| weight(k) * c))
                .collect()
        };
        // The prior holds the gain near 1.
        let mut deviation = found.control.clone();
        deviation[..self.spline.points()]
            .iter_mut()
            .for_each(|c| *c -= 1.0);
        let mut rhs = self.reduce(&self.frame.adjoint(&residual), &guide);
        let pull = prior(&deviation);
        rhs.iter_mut()
            .zip(&pull)
            .for_each(|(r, p)| *r = gain * *r - p);
        let normal = |c: &[f32]| {
            let frame = self.frame.apply(&self.expand(c, &guide));
            let mut product = self.reduce(&self.frame.adjoint(&frame), &guide);
            let pull = prior(c);
            product
                .iter_mut()
                .zip(&pull)
                .for_each(|(p, q)| *p = gain * gain * *p + q);
            product
        };
        let step = conjugate_gradients(normal, &rhs, iterations, 1e-3, self.frame.cancel());
        found
            .control
            .iter_mut()
            .zip(&step)
            .for_each(|(c, s)| *c += s);
    }

    /// A Gauss–Newton step in the affine map. Returns whether the fit became better.
    fn correct_affine(&self, found: &mut GainField) -> bool {
        let (dy, dx) = self.field.displacement(&self.margin.map(&found.affine));
        let pixels = dy.len();
        let columns = self.field.columns;
        let gradients: Vec<(f32, f32)> = (0..pixels)
            .map(|p| {
                let (y, x) = ((p / columns) as f32, (p % columns) as f32);
                let (_, gy, gx) = picture::at(&found.guide, y + dy[p], x + dx[p]);
                (gy, gx)
            })
            .collect();
        let derivative = |k: usize| {
            let image: Vec<f32> = (0..pixels)
                .map(|p| {
                    let (eta, xi) = self.field.place(p);
                    let gradient = if k < 3 {
                        gradients[p].0
                    } else {
                        gradients[p].1
                    };
                    found.gain as f32 * gradient * [1.0, eta, xi][k % 3]
                })
                .collect();
            self.frame.apply(&self.expand(&found.control, &image))
        };
        let derivatives: Vec<Vec<f32>> = (0..6).map(derivative).collect();
        let residual = self.residual(found);
        let mut gram: Vec<Vec<f64>> = derivatives
            .iter()
            .map(|a| derivatives.iter().map(|b| dot(a, b)).collect())
            .collect();
        let mut rhs: Vec<f64> = derivatives.iter().map(|a| dot(a, &residual)).collect();
        let unit = self.field.half_side() / 54.0;
        let weight = 1.0 / (AFFINE_PX * unit).powi(2);
        for k in 0..6 {
            let deviation = found.affine.parameters[k] - self.start.parameters[k];
            gram[k][k] += weight;
            rhs[k] -= weight * deviation;
        }
        let Some(step) = solve_normal(&gram, &rhs) else {
            return false;
        };
        let mut next = found.clone();
        for (p, s) in next.affine.parameters.iter_mut().zip(step) {
            *p += s.clamp(-2.0 * unit, 2.0 * unit);
        }
        let is_better = norm_squared(&self.residual(&next)) < norm_squared(&residual);
        if is_better {
            *found = next;
        }
        is_better
    }

    fn residual(&self, found: &GainField) -> Vec<f32> {
        let video = self.expand(&found.control, &self.warped(found));
        let light = self.frame.apply(&video);
        let gain = found.gain as f32;
        let pairs = self.target.iter().zip(&light);
        pairs.map(|(b, a)| b - gain * a).collect()
    }

    /// `guide · Σ_k τ_k φ_k`.
    fn expand(&self, control: &[f32], guide: &[f32]) -> Vec<f32> {
        let pixels = guide.len();
        let images = self.spline.expand(control);
        let mut video = vec![0.0f32; self.frame.shape().voxels()];
        let bins = video.par_chunks_mut(pixels).enumerate();
        bins.for_each(|(t, bin)| {
            for (time, image) in self.time.iter().zip(images.chunks_exact(pixels)) {
                bin.iter_mut()
                    .zip(image)
                    .for_each(|(v, u)| *v += time[t] * u);
            }
            bin.iter_mut().zip(guide).for_each(|(v, g)| *v *= g);
        });
        video
    }

    /// The adjoint of [`Self::expand`].
    fn reduce(&self, video: &[f32], guide: &[f32]) -> Vec<f32> {
        let pixels = guide.len();
        let mut images = vec![0.0f32; self.time.len() * pixels];
        let modes = images.par_chunks_mut(pixels).zip(&self.time);
        modes.for_each(|(image, time)| {
            for (bin, weight) in video.chunks_exact(pixels).zip(time) {
                image
                    .iter_mut()
                    .zip(bin)
                    .for_each(|(u, v)| *u += weight * v);
            }
            image.iter_mut().zip(guide).for_each(|(u, g)| *u *= g);
        });
        self.spline.reduce(&images)
    }
}

/// Gain and offset of the guide seen from the field, for a scene at rest, with the margin of the guide fitted in turn.
pub(super) fn still(frame: &FrameFit, guide: &Image, affine: &Affine) -> (f64, f64, Vec<f32>) {
    let shape = frame.shape();
    let field = Field::of(shape);
    let margin = Margin::new(field.half_side() / 54.0);
    let (mut padded, map) = (margin.around(guide), margin.map(affine));
    let (even, target) = (frame.apply(&vec![1.0; shape.voxels()]), frame.target());
    let fitted = |padded: &Image| {
        let video = field.warp(padded, &map).data().repeat(shape.bins);
        let light = frame.apply(&video);
        let fit = project(&[&light, &even], &target);
        (video, light, fit[0], fit[1])
    };
    for _ in 0..STILL_FILLS {
        let (_, light, gain, offset) = fitted(&padded);
        let model = light.iter().zip(&even);
        let model = model.map(|(l, e)| gain as f32 * l + offset as f32 * e);
        let residual: Vec<f32> = target.iter().zip(model).map(|(t, m)| t - m).collect();
        let sample = |v: usize| field.sample(&map, v);
        margin.fill(&mut padded, frame, sample, &residual, gain);
    }
    let (mut video, _, gain, offset) = fitted(&padded);
    video
        .iter_mut()
        .for_each(|v| *v = (gain as f32 * *v + offset as f32).max(0.0));
    (gain, offset, video)
}
