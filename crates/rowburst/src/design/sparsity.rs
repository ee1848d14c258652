//! How many non-zero pixels a bin may have, by trial.
//!
//! Compressed sensing promises recovery from `m ≥ C·k·ln(n/k)` random measurements of
//! `k` non-zero values among `n` (Candès & Wakin, IEEE Signal Process. Mag. 25, 21
//! (2008); the paper's `m ≥ O(k log n)`) and leaves `C` open. Here `C` is measured with
//! the PSF at hand: scenes of `k` random pixels a bin go the whole road, forward model,
//! noise, reconstruction, and each bin that comes back right is a success. Bins without
//! a temporal prior are independent problems, so one simulated camera of `T` bins is `T`
//! trials.
//!
//! **Right** means: what differs between the bin and its truth, both smoothed to one
//! speckle grain (no optics tell apart what lies closer), has less than
//! [`SparsityParams::tolerance`] of the norm of the truth.

use crate::reconstruct::{Options, Prior, Problem};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rowburst_core::linop::LinearOperator;
use rowburst_core::{Error, ErrorKind, Parameter, Result, phrase};
use rowburst_optics::camera::CameraParams;
use rowburst_optics::measurement::Measurement;
use rowburst_optics::{Camera, Image, Psf, RollingShutter, Sensor, Shutter, Video};
use rowburst_simulate::noise::Noise;
use std::ops::ControlFlow;

/// What is tried.
#[derive(Debug, Clone, PartialEq)]
pub struct SparsityParams {
    /// Non-zero pixels in each bin, ascending.
    pub ks: Vec<usize>,
    /// Rms of the noiseless frame over the noise, ascending.
    pub snrs: Vec<f64>,
    /// Largest relative error of a success.
    pub tolerance: f64,
    /// Full width at half maximum of the smoothing before the comparison, in pixels.
    pub grain_px: f64,
    /// Most iterations of a reconstruction.
    pub max_iterations: usize,
    /// Seed of scenes and noise.
    pub seed: u64,
}

impl SparsityParams {
    /// Ten values of `k` from a 54th to a fifth of the measurements of a bin of `camera`,
    /// but no more than [`success_map`] takes, and the ratios from 8 to the 256 of the
    /// paper.
    ///
    /// A trial takes at most 160 iterations; more cost time and hardly move the rates (`docs/design/017`).
    pub fn for_camera(camera: &Camera, grain_px: f64, seed: u64) -> Self {
        let m = measurements_per_bin(camera);
        let largest = (camera.video_shape().pixels() / MIN_PIXELS_PER_SOURCE).max(1) as f64;
        let most = (m / 5.0).max(4.0).min(largest);
        let least = (m / 54.0).max(2.0).min(most);
        let steps = 10;
        let k = |i: usize| least * (most / least).powf(i as f64 / (steps - 1) as f64);
        let mut ks: Vec<usize> = (0..steps).map(|i| k(i).round() as usize).collect();
        ks.dedup();
        Self {
            ks,
            snrs: vec![8.0, 16.0, 32.0, 64.0, 128.0, 256.0],
            tolerance: 0.3,
            grain_px,
            max_iterations: 160,
            seed,
        }
    }
}

/// Which part of the bins came back right, over `k` and SNR.
#[derive(Debug, Clone, PartialEq)]
pub struct SuccessMap {
    /// What was tried.
    pub params: SparsityParams,
    /// Part of the bins that came back right, `[snr][k]`.
    pub rates: Vec<Vec<f64>>,
    /// Non-zero pixels that half of the bins survive, for each SNR; 0 where fewer than
    /// half came back at the smallest `k`, and at most the largest `k` tried.
    pub k50: Vec<f64>,
    /// Bins of each reconstruction.
    pub trials: usize,
    /// Reconstructions.
    pub reconstructions: usize,
    /// Rows and columns of the camera that was simulated.
    pub sensor: (usize, usize),
    /// Measurements of a bin of that camera.
    pub measurements_per_bin: f64,
    /// Field pixels of that camera.
    pub field_pixels: usize,
}

/// Field pixels for each lit one in a trial, at least: more could not all be apart.
const MIN_PIXELS_PER_SOURCE: usize = 16;
/// Largest side of the sensor that is simulated; larger costs time (docs/design/017).
const MAX_SIDE: usize = 108;
/// The same where an exposure couples the bins, which is dearer.
const MAX_SIDE_COUPLED: usize = 48;
/// From this rate on, smaller `k` are not tried, and below the other no larger ones: the
/// rate falls with `k`. Untried ones get the rate of the nearest that was.
const CERTAIN_RATE: f64 = 0.98;
const HOPELESS_RATE: f64 = 0.04;
/// Trials that an SNR takes, for the progress: mostly 4 or 5 of 10.
const USUAL_TRIALS: f64 = 5.0;

/// A camera of the structure of `camera` that is small enough for many reconstructions:
/// itself, or with fewer rows and columns, the same readout order, exposure in row times
/// and ratio of field to sensor.
///
/// # Errors
/// None for a camera that is valid itself.
pub fn trial_camera(camera: &Camera) -> Result<Camera> {
    let params = camera.params();
    let largest = if camera.time().is_disjoint() && !matches!(params.shutter, Shutter::Global) {
        MAX_SIDE
    } else {
        MAX_SIDE_COUPLED
    };
    let (rows, columns) = (params.rows.min(largest), params.columns.min(largest));
    let shutter = match &params.shutter {
        Shutter::Custom(order) if rows < params.rows => {
            let start = (params.rows - rows) / 2;
            Shutter::Custom(ranks(&order[start..start + rows]))
        }
        other => other.clone(),
    };
    let scaled = |field: usize, from: usize, to: usize| {
        ((field * to) as f64 / from as f64).round().max(to as f64) as usize
    };
    Camera::new(CameraParams {
        rows,
        columns,
        shutter,
        field: params.field.map(|(field_rows, field_columns)| {
            (
                scaled(field_rows, params.rows, rows),
                scaled(field_columns, params.columns, columns),
            )
        }),
        sensor: Sensor::default(),
        ..params.clone()
    })
}

/// The rank of each value among the different values.
fn ranks(values: &[usize]) -> Vec<usize> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    let rank = |v: &usize| sorted.partition_point(|s| s < v);
    values.iter().map(rank).collect()
}

/// Measurements that see one bin.
pub fn measurements_per_bin(camera: &Camera) -> f64 {
    (camera.rows() * camera.columns()) as f64 / camera.time().bins() as f64
}

/// `C` of `m = C·k·ln(n/k)`.
pub fn constant(m: f64, k: f64, n: usize) -> f64 {
    m / (k * (n as f64 / k).ln())
}

/// `C` of the paper's camera with the speckle of [`rowburst_simulate::SpeckleOptics::demo`] at an SNR, from
/// [`success_map`] (`docs/design/017`). Interpolated over the logarithm of the SNR; beyond the table, the nearest
/// value.
pub fn usual_constant(snr: f64) -> f64 {
    const MEASURED: [(f64, f64); 6] = [
        (8.0, 3.92),
        (16.0, 2.99),
        (32.0, 2.37),
        (64.0, 1.96),
        (128.0, 1.96),
        (256.0, 1.87),
    ];
    let above = MEASURED.partition_point(|m| m.0 < snr);
    match (
        above.checked_sub(1).map(|i| MEASURED[i]),
        MEASURED.get(above),
    ) {
        (Some(low), Some(high)) => {
            let part = (snr / low.0).ln() / (high.0 / low.0).ln();
            low.1 + part * (high.1 - low.1)
        }
        (Some(last), None) => last.1,
        (None, _) => MEASURED[0].1,
    }
}

/// The largest `k ≤ n/e` with `m ≥ C·k·ln(n/k)`; on that range the right side rises.
pub fn recoverable(m: f64, constant: f64, n: usize) -> f64 {
    let n = n as f64;
    let needed = |k: f64| constant * k * (n / k).ln();
    let (mut low, mut high) = (0.0, n / std::f64::consts::E);
    if needed(high) <= m {
        return high;
    }
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if needed(middle) <= m {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// Simulates and reconstructs scenes of `k` random pixels a bin; `observer` sees the
/// part that is done, from 0 to 1, and may stop it.
///
/// `camera` is taken as it is: see [`trial_camera`].
///
/// # Errors
/// A `k` that the field does not hold; the work stopped by the observer.
///
/// # Cost
/// A reconstruction for each `k` and SNR near the edge of success: about half of all.
pub fn success_map(
    camera: &Camera,
    psf: &Psf,
    params: &SparsityParams,
    observer: &mut dyn FnMut(f64) -> ControlFlow<()>,
) -> Result<SuccessMap> {
    let pixels = camera.video_shape().pixels();
    if let Some(k) = params
        .ks
        .iter()
        .find(|&&k| k == 0 || MIN_PIXELS_PER_SOURCE * k > pixels)
    {
        return Err(Error::input(
            Parameter::NonZeroPixels,
            k,
            format!("a trial lights from 1 to a sixteenth of the {pixels} pixels of the field"),
            phrase![
                "Take a larger field, or leave the map out (",
                Parameter::SuccessMap,
                ")."
            ],
        ));
    }
    let operator = RollingShutter::new(camera, psf);
    let (many, last) = (params.snrs.len(), params.ks.len() - 1);
    let mut rates = vec![Vec::new(); many];
    let mut tried = 0;
    // The edge of success lies near that of the SNR before: only about it is tried.
    let mut start = last / 2;
    for (s, &snr) in params.snrs.iter().enumerate() {
        let mut row: Vec<Option<f64>> = vec![None; last + 1];
        let mut of_this_snr = 0.0;
        let mut rate_of = |i: usize, row: &mut [Option<f64>]| -> Result<f64> {
            let part = (of_this_snr / USUAL_TRIALS).min(0.9);
            of_this_snr += 1.0;
            tried += 1;
            if observer((s as f64 + part) / many as f64).is_break() {
                return Err(Error::work(
                    Parameter::SuccessMap,
                    "it was stopped",
                    phrase![
                        "Use ",
                        Parameter::SuccessMap,
                        " for the numbers that need no simulation."
                    ],
                )
                .with_kind(ErrorKind::Cancelled));
            }
            let rate = success_rate(camera, psf, &operator, params, params.ks[i], snr)?;
            row[i] = Some(rate);
            Ok(rate)
        };
        let first = rate_of(start, &mut row)?;
        let (mut rate, mut i) = (first, start);
        while rate < CERTAIN_RATE && i > 0 {
            i -= 1;
            rate = rate_of(i, &mut row)?;
        }
        (rate, i) = (first, start);
        while rate > HOPELESS_RATE && i < last {
            i += 1;
            rate = rate_of(i, &mut row)?;
        }
        let (low, high) = (
            row.iter().position(Option::is_some).unwrap_or(0),
            row.iter().rposition(Option::is_some).unwrap_or(last),
        );
        rates[s] = (0..=last)
            .map(|i| row[i.clamp(low, high)].unwrap_or(0.0))
            .collect();
        start = rates[s].iter().rposition(|&r| r >= 0.5).unwrap_or(0);
    }
    let k50 = rates.iter().map(|r| half_way(&params.ks, r)).collect();
    Ok(SuccessMap {
        params: params.clone(),
        rates,
        k50,
        trials: camera.time().bins(),
        reconstructions: tried,
        sensor: (camera.rows(), camera.columns()),
        measurements_per_bin: measurements_per_bin(camera),
        field_pixels: pixels,
    })
}

impl SuccessMap {
    /// `C` at `snr`; `None` where fewer than half of the bins came back at the smallest `k`.
    pub fn constant_at(&self, snr: f64) -> Option<f64> {
        let k = self.k50_at(snr);
        (k > 0.0).then(|| constant(self.measurements_per_bin, k, self.field_pixels))
    }

    /// Whether more than half of the bins came back at the largest `k` tried: what is
    /// found for `snr` is then a lower bound.
    pub fn is_lower_bound_at(&self, snr: f64) -> bool {
        let largest = self.params.ks.last().copied().unwrap_or(0);
        self.k50_at(snr) >= largest as f64
    }

    /// Non-zero pixels that half of the bins survive at `snr`: between the ratios tried
    /// by interpolation over the logarithm, beyond them that of the nearest.
    pub fn k50_at(&self, snr: f64) -> f64 {
        let snrs = &self.params.snrs;
        let above = snrs.partition_point(|&s| s < snr);
        if above == 0 {
            return self.k50[0];
        }
        if above == snrs.len() {
            return self.k50[above - 1];
        }
        let part = (snr / snrs[above - 1]).ln() / (snrs[above] / snrs[above - 1]).ln();
        self.k50[above - 1] + part * (self.k50[above] - self.k50[above - 1])
    }
}

/// Where `rates` first fall through one half, interpolated over the logarithm of `k`.
fn half_way(ks: &[usize], rates: &[f64]) -> f64 {
    match rates.iter().position(|&r| r < 0.5) {
        Some(0) => 0.0,
        None => ks[ks.len() - 1] as f64,
        Some(i) => {
            let part = (rates[i - 1] - 0.5) / (rates[i - 1] - rates[i]);
            let (low, high) = (ks[i - 1] as f64, ks[i] as f64);
            low * (high / low).powf(part)
        }
    }
}

/// The part of the bins that come back right.
fn success_rate(
    camera: &Camera,
    psf: &Psf,
    operator: &RollingShutter,
    params: &SparsityParams,
    k: usize,
    snr: f64,
) -> Result<f64> {
    // The same scenes at every SNR: what differs is the noise alone.
    let truth = random_pixels(
        camera,
        k,
        params.seed.wrapping_mul(1009).wrapping_add(k as u64),
    );
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(truth.data(), &mut frame);
    frame.iter_mut().for_each(|b| *b = b.max(0.0));
    let noiseless = Image::new(camera.rows(), camera.columns(), frame)?;
    let recorded = Noise::Gaussian { snr }.apply(&noiseless, &Sensor::default(), params.seed)?;
    let options = Options {
        prior: Some("l1+support".parse::<Prior>()?),
        noise_sigma: Some(recorded.sigma),
        max_iterations: Some(params.max_iterations),
        ..Options::default()
    };
    let problem = Problem::new(&Measurement::new(recorded.frame)?, camera, psf, options)?;
    let found = problem.solve(&mut |_| ControlFlow::Continue(()))?;
    let shape = truth.shape();
    let kernel = smoothing(params.grain_px);
    let right = (0..shape.bins).filter(|&t| {
        let smooth = |bin: &[f32]| smoothed(bin, shape.columns, &kernel);
        let (want, got) = (smooth(truth.bin(t)), smooth(found.video.bin(t)));
        let norm: f64 = want.iter().map(|v| v * v).sum();
        let error: f64 = want.iter().zip(&got).map(|(a, b)| (a - b).powi(2)).sum();
        error <= params.tolerance.powi(2) * norm
    });
    Ok(right.count() as f64 / shape.bins as f64)
}

/// `k` single pixels of brightness 0.5 to 1 in each bin, none beside another.
fn random_pixels(camera: &Camera, k: usize, seed: u64) -> Video {
    let shape = camera.video_shape();
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut video = Video::zeros(shape);
    for t in 0..shape.bins {
        let mut occupied: Vec<(usize, usize)> = Vec::with_capacity(k);
        while occupied.len() < k {
            let at = (
                rng.random_range(0..shape.rows),
                rng.random_range(0..shape.columns),
            );
            let touches = |p: &(usize, usize)| p.0.abs_diff(at.0) <= 1 && p.1.abs_diff(at.1) <= 1;
            if !occupied.iter().any(touches) {
                occupied.push(at);
                let brightness: f32 = rng.random_range(0.5..1.0);
                video.bin_mut(t)[at.0 * shape.columns + at.1] = brightness;
            }
        }
    }
    video
}

/// A Gaussian of full width `fwhm` at half maximum, from its middle outwards.
fn smoothing(fwhm: f64) -> Vec<f64> {
    let sigma = fwhm / 2.355;
    let reach = (3.0 * sigma).ceil() as usize;
    let values: Vec<f64> = (0..=reach)
        .map(|i| (-0.5 * (i as f64 / sigma).powi(2)).exp())
        .collect();
    let sum = values[0] + 2.0 * values[1..].iter().sum::<f64>();
    values.iter().map(|v| v / sum).collect()
}

/// `bin` convolved with the kernel along both axes.
fn smoothed(bin: &[f32], columns: usize, kernel: &[f64]) -> Vec<f64> {
    let rows = bin.len() / columns;
    let reach = kernel.len() as isize - 1;
    let along = |values: &[f64], stride: usize, length: usize, at: usize| -> f64 {
        let i = (at / stride % length) as isize;
        let (from, to) = ((-reach).max(-i), reach.min(length as isize - 1 - i));
        (from..=to)
            .map(|d| kernel[d.unsigned_abs()] * values[at.wrapping_add_signed(d * stride as isize)])
            .sum()
    };
    let values: Vec<f64> = bin.iter().map(|&v| f64::from(v)).collect();
    let half: Vec<f64> = (0..values.len())
        .map(|i| along(&values, 1, columns, i))
        .collect();
    (0..half.len())
        .map(|i| along(&half, columns, rows, i))
        .collect()
}
