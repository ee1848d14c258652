//! A light of known frequency and unknown course.
//!
//! `s[r] = A(r) + g(r) Σ_h (c_h cos 2πhνk[r] + d_h sin 2πhνk[r])`: `A` the steady light and `g` the
//! profile of the lamp over the rows, low polynomials; `ν` the cycles per row
//! time. With the harmonics taken together the least-squares `ν` is that of maximum likelihood.

use super::fit::{Basis, Optimum, add, dot, linear, minimise, polynomials};
use std::f64::consts::TAU;

/// The fit of one readout order.
#[derive(Clone)]
pub(super) struct PeriodicFit {
    pub cycles_per_row: f64,
    pub optimum: Optimum,
    /// `(c_h, d_h)` of each frame.
    pub harmonics: Vec<Vec<(f64, f64)>>,
    /// What the fit says of each row of each frame.
    pub model: Vec<Vec<f64>>,
    /// Profile of the lamp in each frame, and the steady light.
    pub gain: Vec<Vec<f64>>,
    pub steady: Vec<Vec<f64>>,
    /// What the profiles are made of.
    pub profile: Basis,
    /// Values less parameters.
    pub dof: f64,
    /// By how much parameters that are not in the fit raise variances.
    pub scene_inflation: f64,
}

/// Highest frequency of a harmonic in cycles per row time: beyond half a cycle it would
/// pass for a lower one.
const MAX_HARMONIC_FREQUENCY: f64 = 0.47;
/// A square wave seen through an exposure of a hundredth of its period still has them.
pub(super) const MAX_HARMONICS: usize = 32;

/// Degree of the profiles: a lamp and a lens vary slowly. With few periods a higher
/// one would bend along with them.
pub(super) fn degree(periods: f64) -> usize {
    if periods < 6.0 { 2 } else { 4 }
}

/// Fits up to so many `harmonics` from the frequency `start`, first with few harmonics: high ones have many minima close together.
pub(super) fn fit(frames: &[Vec<f64>], k: &[usize], start: f64, harmonics: usize) -> PeriodicFit {
    let instants = k.iter().max().map_or(1, |last| last + 1);
    let most = ((MAX_HARMONIC_FREQUENCY / start) as usize)
        .min(instants / 6)
        .clamp(1, harmonics);
    let profile = polynomials(k.len(), degree(start * instants as f64));
    let trend = |y: &Vec<f64>| sum(&profile, &linear(&profile, y).weights);
    let mut gain: Vec<Vec<f64>> = frames.iter().map(trend).collect();
    let mut count = 2.min(most);
    let mut best = fit_once(frames, k, &profile, &mut gain, start, count);
    while count < most {
        count = (2 * count).min(most);
        let next = fit_once(frames, k, &profile, &mut gain, best.cycles_per_row, count);
        let values = next.optimum.residual.len() as f64;
        let further = best.dof - next.dof;
        let gained = values * (best.optimum.rss / next.optimum.rss).ln();
        // Bayes' information criterion; a fit without noise needs no more.
        let enough = gained < further * values.ln() || next.optimum.rss < 1e-18 * values;
        if gained > 0.0 {
            best = next;
        }
        if enough {
            break;
        }
    }
    best
}

/// Profiles and frequency in turns: each is linear, or nearly so, given the other.
const ROUNDS: usize = 3;

fn fit_once(
    frames: &[Vec<f64>],
    k: &[usize],
    profile: &Basis,
    gain: &mut [Vec<f64>],
    start: f64,
    count: usize,
) -> PeriodicFit {
    let mut found = round(frames, k, profile, gain, start, count);
    for _ in 1..ROUNDS {
        let before = found.optimum.rss;
        found = round(frames, k, profile, gain, found.cycles_per_row, count);
        if found.optimum.rss > 0.99 * before {
            break;
        }
    }
    found
}

/// Finds the frequency with the present `gain`, then a better `gain`.
fn round(
    frames: &[Vec<f64>],
    k: &[usize],
    profile: &Basis,
    gain: &mut [Vec<f64>],
    start: f64,
    count: usize,
) -> PeriodicFit {
    let instants = k.iter().max().map_or(1, |last| last + 1) as f64;
    let step = 1e-3 / (instants * count as f64);
    let residual = |theta: &[f64]| -> Vec<f64> {
        let waves = waves(theta[0], k, count);
        let fit = |(y, g): (&Vec<f64>, &Vec<f64>)| linear(&columns(&waves, g, profile), y).residual;
        frames.iter().zip(gain.iter()).flat_map(fit).collect()
    };
    let optimum = minimise(&[start], &[step], &residual);
    let nu = optimum.theta[0];
    let waves = waves(nu, k, count);
    let parameter_count = (2 * count + 2 * profile.len() - 1) * frames.len();
    let mut found = PeriodicFit {
        cycles_per_row: nu,
        optimum,
        harmonics: Vec::new(),
        model: Vec::new(),
        gain: gain.to_vec(),
        steady: Vec::new(),
        profile: profile.clone(),
        dof: (frames.len() * k.len()) as f64 - parameter_count as f64 - 1.0,
        scene_inflation: 1.0,
    };
    for (y, gain) in frames.iter().zip(gain) {
        let fit = linear(&columns(&waves, gain, profile), y);
        let (of_waves, of_profile) = fit.weights.split_at(2 * count);
        let course = sum(&waves, of_waves);
        let steady = sum(profile, of_profile);
        // The lamp's profile: how strongly the course is seen in each row.
        let seen: Basis = profile.iter().map(|p| product(p, &course)).collect();
        let swing: Vec<f64> = y.iter().zip(&steady).map(|(y, a)| y - a).collect();
        let new = sum(profile, &linear(&seen, &swing).weights);
        found
            .harmonics
            .push(of_waves.chunks(2).map(|p| (p[0], p[1])).collect());
        found
            .model
            .push(y.iter().zip(&fit.residual).map(|(y, e)| y - e).collect());
        found.steady.push(steady);
        *gain = new;
    }
    found
}

fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

fn sum(basis: &[Vec<f64>], weights: &[f64]) -> Vec<f64> {
    let mut total = vec![0.0; basis[0].len()];
    weights
        .iter()
        .zip(basis)
        .for_each(|(w, column)| add(&mut total, *w, column));
    total
}

/// `cos 2πhνk, sin 2πhνk` for `h = 1 … count`, over the rows.
fn waves(nu: f64, k: &[usize], count: usize) -> Basis {
    let angle: Vec<f64> = k.iter().map(|&k| TAU * (nu * k as f64).fract()).collect();
    (1..=count)
        .flat_map(|h| {
            let of = |f: fn(f64) -> f64| angle.iter().map(|a| f(h as f64 * a)).collect();
            [of(f64::cos), of(f64::sin)]
        })
        .collect()
}

fn columns(waves: &[Vec<f64>], gain: &[f64], profile: &Basis) -> Basis {
    let lit = waves.iter().map(|wave| product(wave, gain));
    lit.chain(profile.iter().cloned()).collect()
}

impl PeriodicFit {
    /// Standard error of the cycles per row, and by how much related residuals raise a
    /// variance.
    pub fn error(&self) -> (f64, f64) {
        let run = self.model[0].len();
        let (errors, variance_inflation) = self.optimum.errors(self.dof, run);
        (errors[0] * self.scene_inflation.sqrt(), variance_inflation)
    }

    /// The course of the light over a period, as `frame` shows it, in the middle row:
    /// its lowest and highest value.
    pub fn extremes(&self, frame: usize) -> (f64, f64) {
        let middle = self.gain[frame].len() / 2;
        super::waveform::range((0..512).map(|i| {
            let angle = TAU * f64::from(i) / 512.0;
            let swing: f64 = self.harmonics[frame]
                .iter()
                .enumerate()
                .map(|(h, (c, d))| {
                    let (sin, cos) = ((h + 1) as f64 * angle).sin_cos();
                    c * cos + d * sin
                })
                .sum();
            self.steady[frame][middle] + self.gain[frame][middle] * swing
        }))
    }

    /// Where in its period the fundamental stands when the first row is read, in periods
    /// from its maximum.
    pub fn phase(&self, frame: usize) -> f64 {
        let (c, d) = self.harmonics[frame][0];
        (-d.atan2(c) / TAU).rem_euclid(1.0)
    }

    /// Largest amplitude of the harmonics from the third on over its standard error.
    pub fn max_harmonic_z(&self) -> f64 {
        let rows = self.model[0].len() as f64;
        let sigma = (self.optimum.rss / self.dof.max(1.0)).sqrt();
        let of = |(frame, harmonics): (usize, &Vec<(f64, f64)>)| {
            let gain = dot(&self.gain[frame], &self.gain[frame]) / rows;
            let error = sigma * (2.0 / (rows * gain)).sqrt();
            let largest = harmonics.iter().skip(2).map(|(c, d)| c.hypot(*d));
            largest.fold(0.0, f64::max) / error
        };
        self.harmonics
            .iter()
            .enumerate()
            .map(of)
            .fold(0.0, f64::max)
    }
}
