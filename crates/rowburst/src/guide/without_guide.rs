//! A video without a guide: a few cosines in time with Gaussian priors on the picture of each.
//!
//! `v = m + Σ_k τ_k(t) u_k(x)`, where `u_k` has the power spectrum `s_k² c (f₀² + f²)^−1.3` of natural pictures. It is the
//! linear estimate of least error for that prior, by conjugate gradients in whitened coefficients, whose first
//! iterations find the strong low frequencies.

use super::basis::cosines;
use super::frame_fit::FrameFit;
use super::least_squares::preconditioned_gradients;
use faer::linalg::solvers::Solve;
use faer::{Mat, Side};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rayon::prelude::*;
use rowburst_core::linop::{BinTransform, Cosine};

/// Cosines in time; more follow faster changes, and cost time.
const MODES: usize = 8;
/// Iterations; more gain little once the low frequencies are found.
const ITERATIONS: usize = 250;
/// Standard deviation of the still part over the mean light, and that of the first cosine of the change; that of the
/// k-th is smaller by `1/k`.
const STILL: f64 = 0.5;
const CHANGE: f64 = 0.25;
/// Fall of the power with frequency, `(f₀² + f²)^−x`, and `f₀` in periods over the longer side.
const EXPONENT: f64 = 1.3;
const CORNER: f64 = 0.5;

/// The estimate.
pub(super) struct WithoutGuide {
    /// The video `[t, y, x]`.
    pub video: Vec<f32>,
    /// Held-out error in σ.
    pub held_out: f64,
}

impl WithoutGuide {
    /// Estimates the video of the fitted pixels of `frame`.
    pub fn new(frame: &FrameFit) -> Self {
        let shape = frame.shape();
        let mean = frame.mean_light() as f32;
        let modes = Modes::new(frame, f64::from(mean));
        let flat = vec![mean; shape.voxels()];
        let start = frame.apply(&flat);
        let target: Vec<f32> = frame
            .target()
            .iter()
            .zip(&start)
            .map(|(b, a)| b - a)
            .collect();
        let rhs = modes.adjoint(&frame.adjoint(&target));
        let normal = |z: &[f32]| {
            let mut product = modes.adjoint(&frame.adjoint(&frame.apply(&modes.expand(z))));
            product.iter_mut().zip(z).for_each(|(p, z)| *p += z);
            product
        };
        let preconditioner = Preconditioner::new(frame, &modes);
        let z = preconditioned_gradients(
            normal,
            |r| preconditioner.apply(r),
            &rhs,
            ITERATIONS,
            1e-4,
            frame.cancel(),
        );
        let mut video = modes.expand(&z);
        // Values below zero stay: without them the video does not fit the frame.
        video.iter_mut().for_each(|v| *v += mean);
        let held_out = frame.errors(&video).1;
        Self { video, held_out }
    }
}

/// Whitened coefficients: cosines in time and space, scaled by the prior's standard deviation.
struct Modes {
    transform: Cosine,
    /// Standard deviation of the still part's coefficients, in the order of [`Cosine`].
    deviation: Vec<f32>,
    /// `s_k` of each mode.
    scales: Vec<f32>,
    time: Vec<Vec<f32>>,
    pixels: usize,
}

impl Modes {
    fn new(frame: &FrameFit, mean: f64) -> Self {
        let shape = frame.shape();
        let count = MODES.min(shape.bins);
        let (rows, columns) = (shape.rows, shape.columns);
        // Coefficients are stored [l, k].
        let f0 = CORNER / rows.max(columns) as f64;
        let power = |i: usize| {
            let (l, k) = (i / rows, i % rows);
            let f = (0.5 * k as f64 / rows as f64).hypot(0.5 * l as f64 / columns as f64);
            (f0 * f0 + f * f).powf(-EXPONENT)
        };
        let pixels = shape.pixels();
        let total: f64 = (0..pixels).map(power).sum();
        let scale = mean.abs().powi(2) * pixels as f64 / total;
        Self {
            transform: Cosine::new(rows, columns),
            deviation: (0..pixels)
                .map(|i| (scale * power(i)).sqrt() as f32)
                .collect(),
            scales: (0..count)
                .map(|k| {
                    let scale = if k == 0 { STILL } else { CHANGE / k as f64 };
                    scale as f32
                })
                .collect(),
            time: cosines(count, shape.bins),
            pixels,
        }
    }

    fn expand(&self, z: &[f32]) -> Vec<f32> {
        let mut images = vec![0.0; z.len()];
        let pairs = images
            .par_chunks_mut(self.pixels)
            .zip(z.par_chunks(self.pixels));
        pairs.zip(&self.scales).for_each(|((image, z), scale)| {
            let scaled = z.iter().zip(&self.deviation).map(|(z, d)| z * d * scale);
            let scaled: Vec<f32> = scaled.collect();
            self.transform.synthesise(&scaled, image);
        });
        let bins = self.time[0].len();
        let mut video = vec![0.0; bins * self.pixels];
        video
            .par_chunks_mut(self.pixels)
            .enumerate()
            .for_each(|(t, bin)| {
                for (time, image) in self.time.iter().zip(images.chunks_exact(self.pixels)) {
                    bin.iter_mut()
                        .zip(image)
                        .for_each(|(v, u)| *v += time[t] * u);
                }
            });
        video
    }

    fn adjoint(&self, video: &[f32]) -> Vec<f32> {
        let mut z = vec![0.0; self.scales.len() * self.pixels];
        let modes = z
            .par_chunks_mut(self.pixels)
            .zip(&self.time)
            .zip(&self.scales);
        modes.for_each(|((z, time), scale)| {
            let mut image = vec![0.0f32; self.pixels];
            for (bin, weight) in video.chunks_exact(self.pixels).zip(time) {
                image
                    .iter_mut()
                    .zip(bin)
                    .for_each(|(u, v)| *u += weight * v);
            }
            self.transform.analyse(&image, z);
            z.iter_mut()
                .zip(&self.deviation)
                .for_each(|(z, d)| *z *= d * scale);
        });
        z
    }
}

/// Spatial modes along each axis of the exact block; more settle the brightness of wider parts in few iterations.
const BLOCK: usize = 5;
/// Rings of spatial frequency in which the curvature is averaged.
const RINGS: usize = 24;

/// A preconditioner in two levels: the exact block of the lowest spatial modes of every cosine, and for the others the
/// mean curvature at their spatial frequency, measured by a random probe.
struct Preconditioner {
    /// Coefficients of the exact block, and its factor.
    low: Vec<usize>,
    factor: Option<faer::linalg::solvers::Llt<f64>>,
    /// The inverse curvature of every coefficient.
    inverse: Vec<f32>,
}

impl Preconditioner {
    fn new(frame: &FrameFit, modes: &Modes) -> Self {
        let shape = frame.shape();
        let (rows, columns) = (shape.rows, shape.columns);
        let side = |n: usize| BLOCK.min(n);
        let places: Vec<usize> = (0..side(columns))
            .flat_map(|l| (0..side(rows)).map(move |k| l * rows + k))
            .collect();
        let low: Vec<usize> = (0..modes.scales.len())
            .flat_map(|m| places.iter().map(move |p| m * shape.pixels() + p))
            .collect();
        let columns_of_low = low_columns(frame, modes, &places);
        let gram = Mat::from_fn(low.len(), low.len(), |i, j| {
            let identity = if i == j { 1.0 } else { 0.0 };
            rowburst_core::vecmath::dot(&columns_of_low[i], &columns_of_low[j]) + identity
        });
        Self {
            low,
            factor: gram.llt(Side::Lower).ok(),
            inverse: inverse_curvature(frame, modes, rows, columns),
        }
    }

    fn apply(&self, r: &[f32]) -> Vec<f32> {
        let mut out: Vec<f32> = r.iter().zip(&self.inverse).map(|(r, i)| r * i).collect();
        if let Some(factor) = &self.factor {
            let rhs = Mat::from_fn(self.low.len(), 1, |i, _| f64::from(r[self.low[i]]));
            let solved = factor.solve(rhs);
            for (i, &at) in self.low.iter().enumerate() {
                out[at] = solved[(i, 0)] as f32;
            }
        }
        out
    }
}

/// The frame of each of the lowest coefficients. A picture at rest gives the frame of a cosine by a factor for each row,
/// because all pixels of a row see the same instants.
fn low_columns(frame: &FrameFit, modes: &Modes, places: &[usize]) -> Vec<Vec<f32>> {
    let pixels = modes.pixels;
    let bins = modes.time[0].len();
    let factors: Vec<Vec<f32>> = modes
        .time
        .iter()
        .map(|line| frame.row_means(line))
        .collect();
    let stills: Vec<Vec<f32>> = places
        .iter()
        .map(|&place| {
            let mut coefficients = vec![0.0; pixels];
            coefficients[place] = modes.deviation[place];
            let mut image = vec![0.0; pixels];
            modes.transform.synthesise(&coefficients, &mut image);
            frame.apply(&image.repeat(bins))
        })
        .collect();
    let columns = frame.columns();
    let pairs = factors.iter().zip(&modes.scales);
    pairs
        .flat_map(|(factors, scale)| {
            stills.iter().map(move |still| {
                let lines = still.chunks_exact(columns).zip(factors);
                lines
                    .flat_map(|(line, f)| line.iter().map(move |v| v * f * scale))
                    .collect()
            })
        })
        .collect()
}

/// One over the diagonal of the normal matrix, averaged over rings of spatial frequency.
fn inverse_curvature(frame: &FrameFit, modes: &Modes, rows: usize, columns: usize) -> Vec<f32> {
    let pixels = modes.pixels;
    let mut rng = Pcg64::seed_from_u64(1);
    let probe: Vec<f32> = (0..modes.scales.len() * pixels)
        .map(|_| if rng.random::<bool>() { 1.0 } else { -1.0 })
        .collect();
    let ring = |i: usize| {
        let (l, k) = (i / rows, i % rows);
        let f = (k as f64 / rows as f64).hypot(l as f64 / columns as f64);
        ((f * RINGS as f64) as usize).min(RINGS - 1)
    };
    // The prior falls steeply with frequency, so the probe is divided by it.
    let scaled = |z: &[f32], power: i32| -> Vec<f32> {
        let modes_of = z.chunks_exact(pixels).zip(&modes.scales);
        modes_of
            .flat_map(|(z, s)| {
                let pairs = z.iter().zip(&modes.deviation);
                pairs.map(move |(z, d)| z * (d * s).powi(power))
            })
            .collect()
    };
    let video = modes.expand(&scaled(&probe, -1));
    let product = scaled(&modes.adjoint(&frame.adjoint(&frame.apply(&video))), -1);
    let mut inverse = Vec::with_capacity(probe.len());
    for m in 0..modes.scales.len() {
        let mut sums = [(0.0f64, 0usize); RINGS];
        for i in 0..pixels {
            let at = m * pixels + i;
            let sum = &mut sums[ring(i)];
            sum.0 += f64::from(probe[at] * product[at]);
            sum.1 += 1;
        }
        inverse.extend((0..pixels).map(|i| {
            let (sum, count) = sums[ring(i)];
            let curvature = (sum / count.max(1) as f64).max(0.0);
            let deviation = f64::from(modes.deviation[i] * modes.scales[m]);
            (1.0 / (1.0 + curvature * deviation * deviation)) as f32
        }));
    }
    inverse
}
