//! What repeats in a trace, with its error.
//!
//! ```text
//! trace[n] ≈ c + Σ_h a_h cos(2π h f n) + b_h sin(2π h f n),   n in bins
//! ```
//!
//! by weighted least squares: all but `f` is linear and eliminated (Golub & Pereyra, SIAM J.
//! Numer. Anal. 10, 413, 1973), `f` is found along a line. The error is that of the Jacobian:
//! `σ_f = s/‖d⊥‖` with `d = ∂model/∂f` over the standard errors, and `⊥` its part outside the
//! other columns; `s² = max(1, χ²/ν)`.
//!
//! **Folding.** A bin is a sample: a harmonic `h f` above half the frame rate appears folded
//! below it. A blinking light has odd harmonics, and left out they pull `f` by their leakage
//! (20,833 Hz in 54 bins: by up to 0.1 %), so those that stand out and are separate from all
//! else by 1.5/N cycles a bin are fitted along. Those that fall on `f` itself only change its
//! amplitude and phase. That `f` itself is not folded cannot be seen in a trace.

use super::tone::strongest_tone;
use std::f64::consts::TAU;

/// The frequency of a trace.
#[derive(Debug, Clone, PartialEq)]
pub struct Frequency {
    /// In hertz.
    pub hertz: f64,
    /// Its standard error.
    pub error_hz: f64,
    /// Amplitude of the sine (half of peak to peak), in units of the trace.
    pub amplitude: f64,
    /// Its standard error.
    pub amplitude_error: f64,
    /// Share of the trace's variance that a sine of this frequency explains, 0…1.
    pub share: f64,
    /// Whether it cannot be told from half the frame rate: the error then reaches below only.
    pub is_half_rate: bool,
    /// Harmonics that were fitted along.
    pub harmonics: Vec<AliasedHarmonic>,
}

/// A harmonic as it appears in a trace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AliasedHarmonic {
    /// Its number; 1 is the frequency itself.
    pub order: usize,
    /// Where it appears, in hertz, at most half the frame rate.
    pub hertz: f64,
    /// Its amplitude.
    pub amplitude: f64,
}

/// Highest harmonic that is looked for.
const MAX_HARMONIC: usize = 9;
/// What a harmonic must take from `χ²/ν`: three standard deviations of each of its two values.
const MIN_CHI2_GAIN: f64 = 18.0;
/// Least distance of frequencies that are fitted along, in cycles a trace.
const APART: f64 = 1.5;
/// What `χ²` must gain for a frequency just below half the frame rate to be told from it.
const MIN_CHI2_TO_NYQUIST: f64 = 4.0;

/// The frequency of `trace`, with `errors` of width 1σ (all the same where one is not a number
/// above zero), sampled at `rate_hz`; `None` where no sine stands out.
///
/// # Panics
/// If the lengths differ.
pub fn frequency_of(trace: &[f64], errors: &[f64], rate_hz: f64) -> Option<Frequency> {
    assert_eq!(trace.len(), errors.len(), "an error for each value");
    let single: Vec<f32> = trace.iter().map(|&v| v as f32).collect();
    let tone = strongest_tone(&single, rate_hz)?;
    let has_errors = errors.iter().all(|e| e.is_finite() && *e > 0.0);
    let weights: Vec<f64> = errors
        .iter()
        .map(|e| if has_errors { 1.0 / e } else { 1.0 })
        .collect();
    let data = Data {
        values: trace.iter().zip(&weights).map(|(v, w)| v * w).collect(),
        weights,
        has_errors,
    };
    let n = trace.len() as f64;
    let mut orders = vec![1];
    let mut cycles = data.refine(tone.hertz / rate_hz, &orders);
    for order in 2..=MAX_HARMONIC {
        let alias_frequency = alias(order as f64 * cycles);
        let mut others = orders.iter().map(|&h| alias(h as f64 * cycles));
        let is_apart = others.all(|other| (other - alias_frequency).abs() * n >= APART);
        if !is_apart || alias_frequency * n < APART || (0.5 - alias_frequency) * n < APART {
            continue;
        }
        let without = data.fit(cycles, &orders);
        orders.push(order);
        let with = data.fit(cycles, &orders);
        if without.misfit - with.misfit < MIN_CHI2_GAIN * data.scale(&with) {
            orders.pop();
        }
    }
    if orders.len() > 1 {
        cycles = data.refine(cycles, &orders);
    }
    let half = data.fit(0.5, &[1]);
    let best = data.fit(cycles, &orders);
    let near_half = (0.5 - cycles) * n < 1.0 && orders == [1];
    let scale = data.scale(&best);
    if near_half && half.misfit - best.misfit < MIN_CHI2_TO_NYQUIST * scale {
        let step = 0.002 / n;
        let limit = best.misfit + scale * (1.0 + (half.misfit - best.misfit) / scale);
        let reach = (1..500).find(|&k| data.fit(0.5 - k as f64 * step, &[1]).misfit > limit);
        return Some(Frequency {
            hertz: 0.5 * rate_hz,
            error_hz: reach.unwrap_or(500) as f64 * step * rate_hz,
            amplitude: half.amplitude_of(1).0,
            amplitude_error: half.amplitude_of(1).1 * scale.sqrt(),
            share: tone.share,
            is_half_rate: true,
            harmonics: Vec::new(),
        });
    }
    let (amplitude, amplitude_error) = best.amplitude_of(1);
    let harmonic = |&order: &usize| AliasedHarmonic {
        order,
        hertz: alias(order as f64 * cycles) * rate_hz,
        amplitude: best.amplitude_of(order).0,
    };
    Some(Frequency {
        hertz: cycles * rate_hz,
        error_hz: best.cycles_error * scale.sqrt() * rate_hz,
        amplitude,
        amplitude_error: amplitude_error * scale.sqrt(),
        share: tone.share,
        is_half_rate: false,
        harmonics: orders[1..].iter().map(harmonic).collect(),
    })
}

/// Where a frequency of `cycles` a bin appears, from 0 to ½.
fn alias(cycles: f64) -> f64 {
    let part = cycles.fract();
    part.min(1.0 - part)
}

/// A trace over its errors.
struct Data {
    values: Vec<f64>,
    weights: Vec<f64>,
    has_errors: bool,
}

/// The linear fit at a frequency.
struct Fit {
    /// Sum of squares that is left.
    misfit: f64,
    /// Values that were fitted, the frequency included.
    parameters: usize,
    /// Order, cosine and sine of each harmonic, with the standard error of its amplitude.
    harmonics: Vec<(usize, f64, f64, f64)>,
    /// Standard error of the frequency, in cycles a bin.
    cycles_error: f64,
}

impl Fit {
    fn amplitude_of(&self, order: usize) -> (f64, f64) {
        let found = self.harmonics.iter().find(|h| h.0 == order);
        found.map_or((0.0, f64::NAN), |&(_, c, s, error)| (c.hypot(s), error))
    }
}

impl Data {
    /// `max(1, χ²/ν)`; `χ²/ν` where the errors are not known.
    fn scale(&self, fit: &Fit) -> f64 {
        let free = self.values.len().saturating_sub(fit.parameters).max(1);
        let scale = fit.misfit / free as f64;
        if self.has_errors {
            scale.max(1.0)
        } else {
            scale
        }
    }

    /// The frequency of the least misfit within one cycle a trace about `start`.
    fn refine(&self, start: f64, orders: &[usize]) -> f64 {
        let reach = 1.0 / self.values.len() as f64;
        let (mut low, mut high) = ((start - reach).max(0.1 * reach), (start + reach).min(0.5));
        // Several minima where harmonics are strong: a coarse look first.
        let at = |k: usize| low + (high - low) * k as f64 / 40.0;
        let misfits: Vec<f64> = (0..=40).map(|k| self.fit(at(k), orders).misfit).collect();
        let best = (0..=40).min_by(|&i, &j| misfits[i].total_cmp(&misfits[j]));
        let best = best.unwrap_or(20);
        (low, high) = (at(best.saturating_sub(1)), at((best + 1).min(40)));
        for _ in 0..40 {
            let third = (high - low) / 3.0;
            if self.fit(low + third, orders).misfit > self.fit(high - third, orders).misfit {
                low += third;
            } else {
                high -= third;
            }
        }
        0.5 * (low + high)
    }

    fn fit(&self, cycles: f64, orders: &[usize]) -> Fit {
        // Time from the middle: frequency and phase are then nearly independent.
        let middle = 0.5 * (self.values.len() as f64 - 1.0);
        let column = |of: &dyn Fn(f64) -> f64| -> Vec<f64> {
            let weights = self.weights.iter().enumerate();
            weights.map(|(n, w)| w * of(n as f64 - middle)).collect()
        };
        let mut columns = vec![column(&|_| 1.0)];
        for &h in orders {
            let angle = TAU * cycles * h as f64;
            columns.push(column(&|n| (angle * n).cos()));
            columns.push(column(&|n| (angle * n).sin()));
        }
        let basis = Basis::of(&columns);
        let coefficients = basis.coefficients(&self.values);
        let model = |n: usize| -> f64 {
            (0..columns.len())
                .map(|j| coefficients[j] * columns[j][n])
                .sum()
        };
        let misfit = (0..self.values.len()).map(|n| (self.values[n] - model(n)).powi(2));
        let misfit = misfit.sum();
        let slope = |n: usize| -> f64 {
            let t = n as f64 - middle;
            let of = |(k, &h): (usize, &usize)| {
                let (c, s) = (coefficients[1 + 2 * k], coefficients[2 + 2 * k]);
                let (cos, sin) = (columns[1 + 2 * k][n], columns[2 + 2 * k][n]);
                TAU * h as f64 * t * (s * cos - c * sin)
            };
            orders.iter().enumerate().map(of).sum()
        };
        let slopes: Vec<f64> = (0..self.values.len()).map(slope).collect();
        let rest = basis.outside(&slopes);
        let amplitude_error = |k: usize| {
            let (c, s) = (coefficients[1 + 2 * k], coefficients[2 + 2 * k]);
            let size = c.hypot(s).max(f64::MIN_POSITIVE);
            // Along the phase that was found; everything else is free.
            let along: Vec<f64> = (0..self.values.len())
                .map(|n| (c * columns[1 + 2 * k][n] + s * columns[2 + 2 * k][n]) / size)
                .collect();
            let mut others: Vec<Vec<f64>> = (0..columns.len())
                .filter(|&j| j != 1 + 2 * k && j != 2 + 2 * k)
                .map(|j| columns[j].clone())
                .collect();
            others.push(
                (0..self.values.len())
                    .map(|n| (c * columns[2 + 2 * k][n] - s * columns[1 + 2 * k][n]) / size)
                    .collect(),
            );
            1.0 / norm(&Basis::of(&others).outside(&along))
        };
        Fit {
            misfit,
            parameters: basis.vectors.len() + 1,
            harmonics: (0..orders.len())
                .map(|k| {
                    let (c, s) = (coefficients[1 + 2 * k], coefficients[2 + 2 * k]);
                    (orders[k], c, s, amplitude_error(k))
                })
                .collect(),
            cycles_error: 1.0 / norm(&rest),
        }
    }
}

/// An orthonormal basis of some columns; those that depend on earlier ones are left out (the
/// sine at half the frame rate).
struct Basis {
    vectors: Vec<Vec<f64>>,
    /// For each vector: its column, and the products of all columns with it.
    pivots: Vec<(usize, Vec<f64>)>,
    columns: usize,
}

impl Basis {
    fn of(columns: &[Vec<f64>]) -> Self {
        let mut basis = Self {
            vectors: Vec::new(),
            pivots: Vec::new(),
            columns: columns.len(),
        };
        // Not over its own norm: at half the frame rate the sine is rounding alone.
        let largest = columns.iter().map(|c| norm(c)).fold(0.0, f64::max);
        for (j, column) in columns.iter().enumerate() {
            // Twice is enough (Kahan).
            let rest = basis.outside(&basis.outside(column));
            let size = norm(&rest);
            if size > 1e-6 * largest {
                let vector: Vec<f64> = rest.iter().map(|v| v / size).collect();
                let products = columns.iter().map(|c| dot(c, &vector)).collect();
                basis.vectors.push(vector);
                basis.pivots.push((j, products));
            }
        }
        basis
    }

    /// The part of `v` outside the space of the columns.
    fn outside(&self, v: &[f64]) -> Vec<f64> {
        let mut rest = v.to_vec();
        for vector in &self.vectors {
            let part = dot(&rest, vector);
            rest.iter_mut()
                .zip(vector)
                .for_each(|(r, q)| *r -= part * q);
        }
        rest
    }

    /// What `v` is made of; 0 for columns that were left out.
    fn coefficients(&self, v: &[f64]) -> Vec<f64> {
        let mut coefficients = vec![0.0; self.columns];
        for (vector, (pivot, products)) in self.vectors.iter().zip(&self.pivots).rev() {
            let later: f64 = (pivot + 1..self.columns)
                .map(|j| products[j] * coefficients[j])
                .sum();
            coefficients[*pivot] = (dot(v, vector) - later) / products[*pivot];
        }
        coefficients
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_distr::StandardNormal;

    const RATE_HZ: f64 = 1e6 / 9.6;

    /// The error is that of the scatter over noise seeds, for sines anywhere in the band.
    #[test]
    fn errors_are_the_scatter() {
        for (hertz, phase) in [
            (7_000.0, 0.3),
            (20_833.0, 1.1),
            (34_722.0, 2.0),
            (47_000.0, 0.7),
        ] {
            let (mut squares, mut claimed, mut amplitudes) = (0.0, 0.0, 0.0);
            let seeds = 300;
            for seed in 0..seeds {
                let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
                let errors: Vec<f64> = (0..54).map(|n| 0.02 + 0.001 * n as f64).collect();
                let trace: Vec<f64> = (0..54)
                    .map(|n| {
                        let noise: f64 = rng.sample(StandardNormal);
                        let time = n as f64 / RATE_HZ;
                        0.6 + 0.4 * (TAU * hertz * time + phase).sin() + errors[n] * noise
                    })
                    .collect();
                let found = frequency_of(&trace, &errors, RATE_HZ).expect("a clear tone");
                squares += (found.hertz - hertz).powi(2);
                claimed += found.error_hz;
                amplitudes += ((found.amplitude - 0.4) / found.amplitude_error).powi(2);
            }
            let ratio = (squares / seeds as f64).sqrt() / (claimed / seeds as f64);
            assert!((0.9..1.1).contains(&ratio), "{hertz} Hz: {ratio}");
            let ratio = (amplitudes / seeds as f64).sqrt();
            assert!(
                (0.85..1.15).contains(&ratio),
                "{hertz} Hz, amplitude: {ratio}"
            );
        }
    }

    /// A blinking light of any phase, sampled as the camera does: harmonics fold, and the
    /// frequency is not pulled.
    #[test]
    fn square_waves_are_not_pulled_by_their_folded_harmonics() {
        for hertz in [12_345.0, 20_833.0, 34_722.0] {
            for phase in [0.0, 0.13, 0.37, 0.71] {
                let lit = |u: f64| 0.5 * u.floor() + u.fract().min(0.5);
                let periods = |n: usize| hertz * n as f64 / RATE_HZ + phase;
                let trace: Vec<f64> = (0..54)
                    .map(|n| (lit(periods(n + 1)) - lit(periods(n))) / (hertz / RATE_HZ))
                    .collect();
                let found = frequency_of(&trace, &[0.003; 54], RATE_HZ).expect("a clear tone");
                let error = (found.hertz / hertz - 1.0).abs();
                assert!(error < 5e-4, "{hertz} {phase}: {found:?}");
            }
        }
    }

    #[test]
    fn what_cannot_be_told_from_half_the_rate_says_so() {
        let trace: Vec<f64> = (0..54)
            .map(|n| 0.5 + if n % 2 == 0 { 0.2 } else { -0.2 })
            .collect();
        let found = frequency_of(&trace, &[0.01; 54], RATE_HZ).expect("a clear tone");
        assert!(found.is_half_rate);
        assert_eq!(found.hertz, 0.5 * RATE_HZ);
        assert!((found.amplitude - 0.2).abs() < 1e-9);
        assert!((20.0..300.0).contains(&found.error_hz), "{found:?}");
        // A clear beat can be told.
        let beat: Vec<f64> = (0..54)
            .map(|n| 0.5 + 0.2 * (TAU * 0.49 * n as f64 + 0.4).sin())
            .collect();
        let found = frequency_of(&beat, &[0.01; 54], RATE_HZ).expect("a clear tone");
        assert!(!found.is_half_rate && (found.hertz / RATE_HZ - 0.49).abs() < 1e-3);
    }

    #[test]
    fn no_frequency_without_a_tone() {
        assert_eq!(frequency_of(&[1.0; 54], &[0.1; 54], RATE_HZ), None);
        assert_eq!(frequency_of(&[], &[], RATE_HZ), None);
    }

    #[test]
    fn errors_come_from_the_residual_where_none_are_given() {
        let trace: Vec<f64> = (0..54)
            .map(|n| (TAU * 0.2 * n as f64).sin() + 0.01 * ((n * 7919 % 13) as f64 - 6.0) / 3.7)
            .collect();
        let unknown = frequency_of(&trace, &[f64::NAN; 54], RATE_HZ).unwrap();
        let known = frequency_of(&trace, &[0.01; 54], RATE_HZ).unwrap();
        let ratio = unknown.error_hz / known.error_hz;
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }
}
