//! A light whose course is known: the row time at which the rows show that course.
//!
//! `s[r] = A(r) + g(r) · m(t₀ + k[r]·τ)`, `m` the light integrated over the exposure, for every
//! readout order: a coarse search by correlation over the row time `τ` and the moment `t₀`,
//! then least squares over `τ, t₀` and the exposure together.

use super::fit::{Basis, Linear, Optimum, dot, linear, minimise, polynomials};
use super::waveform::{Extension, Waveform};
use rayon::prelude::*;
use rowburst_core::fft::FftNumber;
use rustfft::{Fft, num_complex::Complex64};
use std::collections::HashMap;
use std::sync::{Arc, Mutex};

/// The fit of one readout order.
pub(super) struct MatchedFit {
    pub row_time_us: f64,
    pub row_time_error: f64,
    pub exposure_us: f64,
    pub exposure_error: f64,
    /// End of the exposure of the first instant of each frame, on the signal's clock.
    pub offsets_us: Vec<f64>,
    pub rss: f64,
    /// Values less parameters.
    pub dof: f64,
    /// By how much related residuals raise a variance.
    pub variance_inflation: f64,
    pub model: Vec<Vec<f64>>,
    /// Smallest and largest light that the exposures saw, of frame 1 and in its units.
    pub extremes: (f64, f64),
}

/// Degrees of the profiles of steady light and lamp.
const STEADY_DEGREE: usize = 3;
const LAMP_DEGREE: usize = 2;

/// A place to start from.
#[derive(Debug, Clone, Copy)]
struct Start {
    row_time_us: f64,
    offset_us: f64,
    exposure_us: f64,
    /// Part of the rows' variance that it explains.
    score: f64,
}

/// Exposures tried, in parts of the instants; one row time besides.
const EXPOSURES: [f64; 2] = [0.04, 0.2];
/// Starts refined for each readout order.
const STARTS: usize = 4;
const MAX_ROW_TIMES: f64 = 6000.0;

/// The best fit of each readout order in `orders`.
pub(super) fn fit_all(
    frames: &[Vec<f64>],
    orders: &[Vec<usize>],
    waveform: &Waveform,
    range_us: (f64, f64),
) -> Vec<Option<MatchedFit>> {
    let starts = coarse(&frames[0], orders, waveform, range_us);
    orders
        .par_iter()
        .zip(starts)
        .map(|(k, starts)| {
            let fits = starts
                .iter()
                .filter_map(|start| refine(frames, k, waveform, *start));
            fits.min_by(|a, b| a.rss.total_cmp(&b.rss))
        })
        .collect()
}

/// Starts for each order, best first.
fn coarse(
    rows: &[f64],
    orders: &[Vec<usize>],
    waveform: &Waveform,
    (low, high): (f64, f64),
) -> Vec<Vec<Start>> {
    let trend = linear(&polynomials(rows.len(), 1), rows).residual;
    let folded: Vec<(Vec<f64>, Vec<f64>)> = orders.iter().map(|k| fold(&trend, k)).collect();
    let longest = folded.iter().map(|f| f.0.len()).max().unwrap_or(1);
    // Fine enough that the ends of the frame stay in step with the course.
    let mut row_times = Vec::new();
    let mut tau = low;
    while tau <= high {
        row_times.push(tau);
        let step = smoothness(waveform, tau, longest) / longest as f64;
        tau *= 1.0 + step.clamp((high / low).ln() / MAX_ROW_TIMES, 0.05);
    }
    let total = dot(&trend, &trend);
    let tried: Vec<(f64, f64)> = row_times
        .iter()
        .flat_map(|&tau| {
            let parts = EXPOSURES.map(|part| part * longest as f64);
            let lengths = parts.into_iter().filter(|&l| l > 1.5).chain([1.0]);
            lengths.map(move |l| (tau, l * tau)).collect::<Vec<_>>()
        })
        .collect();
    let ffts = FftCache::default();
    let found: Vec<Vec<Start>> = tried
        .par_iter()
        .map(|&(tau, exposure)| correlate(&ffts, &folded, waveform, (tau, exposure), total))
        .collect();
    (0..orders.len())
        .map(|o| {
            let mut all: Vec<Start> = found.iter().map(|f| f[o]).collect();
            all.sort_by(|a, b| b.score.total_cmp(&a.score));
            let mut kept: Vec<Start> = Vec::new();
            for start in all {
                let near = |s: &Start| {
                    (s.row_time_us / start.row_time_us - 1.0).abs() < 0.01
                        && (s.exposure_us / start.exposure_us - 1.0).abs() < 0.1
                };
                if !kept.iter().any(near) {
                    kept.push(start);
                }
                if kept.len() == STARTS {
                    break;
                }
            }
            kept
        })
        .collect()
}

/// Sum of the rows read at each instant, and their number.
fn fold(rows: &[f64], k: &[usize]) -> (Vec<f64>, Vec<f64>) {
    let instants = k.iter().max().map_or(1, |last| last + 1);
    let (mut sums, mut counts) = (vec![0.0; instants], vec![0.0; instants]);
    for (value, &k) in rows.iter().zip(k) {
        sums[k] += value;
        counts[k] += 1.0;
    }
    (sums, counts)
}

/// Row times over which the light, seen at steps of `tau`, keeps its value.
fn smoothness(waveform: &Waveform, tau: f64, instants: usize) -> f64 {
    let (first, last) = waveform.span_us();
    let count = (((last - first) / tau) as usize).clamp(8, 8 * instants + 64);
    let step = (last - first) / count as f64;
    let values: Vec<f64> = (0..=count)
        .map(|i| waveform.mean_over_exposure(first + i as f64 * step, tau))
        .collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let spread: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    let change: f64 = values.windows(2).map(|p| (p[1] - p[0]).powi(2)).sum();
    ((spread / change.max(1e-300)).sqrt() * step / tau).clamp(0.5, instants as f64)
}

/// Transforms of each length, planned once: a plan costs as much as several transforms.
#[derive(Default)]
struct FftCache(Mutex<HashMap<usize, FftPair>>);

/// Forward and inverse.
type FftPair = (Arc<dyn Fft<f64>>, Arc<dyn Fft<f64>>);

impl FftCache {
    /// Forward and inverse, of `length`.
    fn of(&self, length: usize) -> FftPair {
        let mut ffts = self.0.lock().expect("no thread panics while planning");
        ffts.entry(length)
            .or_insert_with(|| f64::complex_transforms(length))
            .clone()
    }
}

/// The best moment for each of the folded orders, by correlation at all moments that are
/// whole row times apart.
fn correlate(
    ffts: &FftCache,
    folded: &[(Vec<f64>, Vec<f64>)],
    waveform: &Waveform,
    (tau, exposure): (f64, f64),
    total: f64,
) -> Vec<Start> {
    let (first, last) = waveform.span_us();
    let longest = folded.iter().map(|f| f.0.len()).max().unwrap_or(1);
    let rounds = ((last - first) / tau).ceil() as usize;
    let (begin, moments) = match waveform.extension() {
        Extension::Repeats => (first, rounds.max(1)),
        Extension::Holds => (
            first - longest as f64 * tau,
            rounds + longest + (exposure / tau).ceil() as usize,
        ),
    };
    let length = (moments + longest).next_power_of_two();
    let course: Vec<f64> = (0..moments + longest)
        .map(|i| waveform.mean_over_exposure(begin + i as f64 * tau, exposure))
        .collect();
    let (forward, inverse) = ffts.of(length);
    let spectrum = |values: &[f64]| {
        let mut padded: Vec<Complex64> = values.iter().map(|&v| Complex64::new(v, 0.0)).collect();
        padded.resize(length, Complex64::default());
        forward.process(&mut padded);
        padded
    };
    // `Σ_k v_k u_{i+k}` for all moments i.
    let correlation = |u: &[Complex64], v: &[f64]| -> Vec<f64> {
        let mut product = spectrum(v);
        product
            .iter_mut()
            .zip(u)
            .for_each(|(v, u)| *v = u * v.conj());
        inverse.process(&mut product);
        product[..moments]
            .iter()
            .map(|p| p.re / length as f64)
            .collect()
    };
    let of_course = spectrum(&course);
    let running = |power: i32| -> Vec<f64> {
        let mut sums = vec![0.0];
        sums.extend(course.iter().scan(0.0, |sum, v| {
            *sum += v.powi(power);
            Some(*sum)
        }));
        sums
    };
    let (sums, squares) = (running(1), running(2));
    folded
        .iter()
        .map(|(values, counts)| {
            let seen = correlation(&of_course, values);
            let n = values.len();
            // Rows an instant: one, or two (three at the middle of an odd sensor counts little).
            let rows = counts.iter().sum::<f64>() / n as f64;
            let mut best = Start {
                row_time_us: tau,
                offset_us: begin,
                exposure_us: exposure,
                score: f64::NEG_INFINITY,
            };
            for (i, seen) in seen.iter().enumerate() {
                let sum = sums[i + n] - sums[i];
                let square = squares[i + n] - squares[i];
                let spread = square - sum * sum / n as f64;
                // A light that hardly changes while the frame is read explains nothing.
                if *seen > 0.0 && spread > 1e-6 * square {
                    let score = seen * seen / (rows * spread) / total.max(f64::MIN_POSITIVE);
                    if score > best.score {
                        best.score = score;
                        best.offset_us = begin + i as f64 * tau;
                    }
                }
            }
            best
        })
        .collect()
}

/// The model of the frames for one readout order.
///
/// θ is in units of the start: row time and exposure (logarithms), then the moment of the
/// middle of each frame.
struct OrderModel<'a> {
    frames: &'a [Vec<f64>],
    /// Instant of each row.
    k: &'a [usize],
    waveform: &'a Waveform,
    /// Profile of the steady light; that of the lamp is its beginning.
    steady: Basis,
    /// Number of instants.
    instants: f64,
    /// The middle instant.
    middle: f64,
    /// Row time of the start, in microseconds.
    unit: f64,
}

/// What the fitted model predicts.
struct Prediction {
    model: Vec<Vec<f64>>,
    extremes: (f64, f64),
}

impl<'a> OrderModel<'a> {
    fn new(frames: &'a [Vec<f64>], k: &'a [usize], waveform: &'a Waveform, unit: f64) -> Self {
        let instants = k.iter().max().map_or(1, |last| last + 1) as f64;
        Self {
            frames,
            k,
            waveform,
            steady: polynomials(k.len(), STEADY_DEGREE),
            instants,
            middle: 0.5 * (instants - 1.0),
            unit,
        }
    }

    /// Profile of the lamp.
    fn lamp(&self) -> &[Vec<f64>] {
        &self.steady[..=LAMP_DEGREE]
    }

    /// Row time at `theta`, in microseconds.
    fn row_time_us(&self, theta: &[f64]) -> f64 {
        self.unit * theta[0].exp()
    }

    /// Exposure at `theta`, in microseconds.
    fn exposure_us(&self, theta: &[f64]) -> f64 {
        self.unit * theta[1].exp()
    }

    /// The linear fit of frame `f` at `theta`, and the light that its rows saw.
    fn fit_frame(&self, theta: &[f64], f: usize) -> (Linear, Vec<f64>) {
        let (tau, exposure) = (self.row_time_us(theta), self.exposure_us(theta));
        let course: Vec<f64> = self
            .k
            .iter()
            .map(|&k| {
                self.waveform.mean_over_exposure(
                    self.unit * theta[2 + f] + (k as f64 - self.middle) * tau,
                    exposure,
                )
            })
            .collect();
        let lit = |p: &Vec<f64>| p.iter().zip(&course).map(|(p, c)| p * c).collect();
        let lamp = self.lamp().iter().map(lit);
        let basis: Basis = lamp.chain(self.steady.iter().cloned()).collect();
        (linear(&basis, &self.frames[f]), course)
    }

    /// Residual of the frames `from..to` at `theta`.
    fn residual(&self, theta: &[f64], from: usize, to: usize) -> Vec<f64> {
        // Exposures beyond thousands of rows are no start of anything.
        if theta[1].abs() > 12.0 || theta[0].abs() > 1.0 {
            return vec![1e3; (to - from) * self.k.len()];
        }
        (from..to)
            .flat_map(|f| self.fit_frame(theta, f).0.residual)
            .collect()
    }

    /// Steps of the derivatives for `count` frames.
    fn steps(&self, count: usize) -> Vec<f64> {
        let mut steps = vec![1e-4; 2 + count];
        steps[0] = 1e-4 / self.instants;
        steps
    }

    /// The least-squares θ: frame 1 first, then the moment of each further frame, then all.
    fn optimum(&self, start: Start) -> Optimum {
        let first = start.offset_us / self.unit + self.middle;
        let exposure = (start.exposure_us / self.unit).ln();
        let mut theta = vec![0.0, exposure, first];
        let one = minimise(&theta, &self.steps(1), &|t| self.residual(t, 0, 1));
        theta = one.theta;
        for f in 1..self.frames.len() {
            let moment = moment_of(
                &self.frames[f],
                self.k,
                self.waveform,
                self.row_time_us(&theta),
                self.exposure_us(&theta),
            );
            theta.push(moment / self.unit + self.middle * theta[0].exp());
            let other = |t: &[f64]| {
                let mut all = theta[..2].to_vec();
                all.extend(std::iter::repeat_n(0.0, f));
                all.push(t[0]);
                self.residual(&all, f, f + 1)
            };
            theta[2 + f] = minimise(&[theta[2 + f]], &[1e-4], &other).theta[0];
        }
        let count = self.frames.len();
        minimise(&theta, &self.steps(count), &|t| self.residual(t, 0, count))
    }

    /// Values less parameters.
    fn dof(&self) -> f64 {
        let count = self.frames.len();
        let parameter_count = (self.lamp().len() + self.steady.len() + 1) * count + 2;
        (count * self.k.len()) as f64 - parameter_count as f64
    }

    /// The rows by the fit at `theta`; `None` if the light darkens a frame.
    fn prediction(&self, theta: &[f64]) -> Option<Prediction> {
        let lamp = self.lamp();
        let mut model = Vec::new();
        let mut extremes = (0.0, 0.0);
        for (f, seen) in self.frames.iter().enumerate() {
            let (fit, course) = self.fit_frame(theta, f);
            // Light brightens: a course that darkens the rows is another light.
            if fit.weights[0] <= 0.0 {
                return None;
            }
            if f == 0 {
                let (low, high) = super::waveform::range(course.iter().copied());
                let steady =
                    fit.weights[lamp.len()] - fit.weights.get(lamp.len() + 2).unwrap_or(&0.0);
                extremes = (
                    steady + fit.weights[0] * low,
                    steady + fit.weights[0] * high,
                );
            }
            model.push(seen.iter().zip(&fit.residual).map(|(y, e)| y - e).collect());
        }
        Some(Prediction { model, extremes })
    }
}

/// The least-squares fit from `start`; `None` if the start has no score or the light darkens a frame.
fn refine(
    frames: &[Vec<f64>],
    k: &[usize],
    waveform: &Waveform,
    start: Start,
) -> Option<MatchedFit> {
    if !start.score.is_finite() {
        return None;
    }
    let unit = start.row_time_us;
    let order = OrderModel::new(frames, k, waveform, unit);
    let found = order.optimum(start);
    let dof = order.dof();
    let (errors, variance_inflation) = found.errors(dof, k.len());
    let tau = order.row_time_us(&found.theta);
    let Prediction { model, extremes } = order.prediction(&found.theta)?;
    let (exposure, exposure_error) = match fit_shared_profile(frames, k, waveform, &found, unit) {
        Some(tied)
            if tied.variance < SHARED_PROFILE_MAX_VARIANCE_RATIO * found.rss / dof.max(1.0) =>
        {
            tied.exposure
        }
        _ => {
            let exposure = order.exposure_us(&found.theta);
            (exposure, exposure * errors[1])
        }
    };
    Some(MatchedFit {
        row_time_us: tau,
        row_time_error: tau * errors[0],
        exposure_us: exposure,
        exposure_error,
        offsets_us: (0..frames.len())
            .map(|f| unit * found.theta[2 + f] - order.middle * tau)
            .collect(),
        rss: found.rss,
        dof,
        variance_inflation,
        model,
        extremes,
    })
}

/// A fit with one profile for steady light and lamp may leave this much more variance.
const SHARED_PROFILE_MAX_VARIANCE_RATIO: f64 = 1.15;
const SHARED_PROFILE_DEGREE: usize = 4;

struct SharedProfileFit {
    exposure: (f64, f64),
    variance: f64,
}

/// The fit again with steady light and lamp of one profile, `g(r)·(o + m)`: true of a lamp
/// alone in the dark, and the exposure, which dims fast parts of the course as a profile of
/// the lamp might, comes out several times more exact.
fn fit_shared_profile(
    frames: &[Vec<f64>],
    k: &[usize],
    waveform: &Waveform,
    found: &Optimum,
    unit: f64,
) -> Option<SharedProfileFit> {
    let instants = k.iter().max().map_or(1, |last| last + 1) as f64;
    let middle = 0.5 * (instants - 1.0);
    let profile = polynomials(k.len(), SHARED_PROFILE_DEGREE);
    let count = frames.len();
    let (first, last) = waveform.span_us();
    let whole = waveform.mean_over_exposure(last, last - first);
    // θ as before, and at its end the steady light of each frame over the signal's mean.
    let residual = |theta: &[f64]| -> Vec<f64> {
        if theta[1].abs() > 12.0 || theta[0].abs() > 1.0 {
            return vec![1e3; count * k.len()];
        }
        let (tau, exposure) = (unit * theta[0].exp(), unit * theta[1].exp());
        let of = |f: usize| {
            let steady = whole * theta[2 + count + f];
            let lit = |&k: &usize| {
                let moment = unit * theta[2 + f] + (k as f64 - middle) * tau;
                steady + waveform.mean_over_exposure(moment, exposure)
            };
            let lit: Vec<f64> = k.iter().map(lit).collect();
            let column = |p: &Vec<f64>| p.iter().zip(&lit).map(|(p, l)| p * l).collect();
            let basis: Basis = profile.iter().map(column).collect();
            linear(&basis, &frames[f]).residual
        };
        (0..count).flat_map(of).collect()
    };
    let mut theta = found.theta.clone();
    theta.extend(std::iter::repeat_n(0.1, count));
    let mut steps = vec![1e-4; theta.len()];
    steps[0] = 1e-4 / instants;
    let best = minimise(&theta, &steps, &residual);
    let dof = (count * k.len()) as f64 - (count * (profile.len() + 2) + 2) as f64;
    let (errors, _) = best.errors(dof, k.len());
    let exposure = unit * best.theta[1].exp();
    let error = exposure * errors[1];
    error.is_finite().then_some(SharedProfileFit {
        exposure: (exposure, error),
        variance: best.rss / dof.max(1.0),
    })
}

/// The moment of a further frame, row time and exposure known.
fn moment_of(rows: &[f64], k: &[usize], waveform: &Waveform, tau: f64, exposure: f64) -> f64 {
    let trend = linear(&polynomials(rows.len(), 1), rows).residual;
    let folded = [fold(&trend, k)];
    let total = dot(&trend, &trend);
    correlate(
        &FftCache::default(),
        &folded,
        waveform,
        (tau, exposure),
        total,
    )[0]
    .offset_us
}
