//! What the grains look like in the pixels, and how much colour they stand.
//!
//! With `v = πs/g` and the grain `g = λz/D = λ/(2NA)` the intensity of speckle has the
//! autocovariance `μ²(s) = |2J₁(v)/v|²` at the distance `s`. Pixels of side 1 turn it into
//!
//! ```text
//! K(s) = ∬ (1−|x|)(1−|y|) μ²(|s − (x, y)|) dx dy,     contrast = √K(0)
//! ```
//!
//! and what is seen on the sensor is `K(s)/K(0)`.
//!
//! **Wavelength.** Going from `λ` to `λ + Δλ` does two things (J. W. Goodman, Speckle
//! Phenomena in Optics, on wavelength diversity and the free-space geometry; here with a
//! thin diffuser in transmission):
//!
//! - diffraction widens the pattern about the undeflected point: the grain at radius `R`
//!   moves by `RΔλ/λ`. The same in words of path lengths: between the two edges of the
//!   pupil the paths to `R` differ by `RD/z`, and `Δλ = λ²/(RD/z)` moves it by one grain;
//! - the optical path through the diffuser, of rms `ℓ_p`, takes another phase: the
//!   correlation falls by `exp(−(2πℓ_pΔλ/λ²)²)`.
//!
//! The correlation of two PSFs is that of their grains, each by the square of its
//! brightness and by the pairs of field point and pixel that it serves:
//!
//! ```text
//! C(Δλ) = exp(−(2πℓ_pΔλ/λ²)²) · Σ_d w(d) K(|d|Δλ/λ)/K(0) / Σ_d w(d)
//! ```
//!
//! A source of bandwidth `B`, even over it, keeps `√((1/B²)∬C(λ₁−λ₂))` of the contrast.

use super::spread::FWHM_PER_SIGMA;
use rowburst_optics::Camera;
use std::f64::consts::PI;

/// `|2J₁(v)/v|²`.
///
/// `J₁(v) = (1/π)∫₀^π cos(t − v sin t) dt`, by the trapezoidal rule, which converges
/// faster than any power for a periodic integrand.
fn airy(v: f64) -> f64 {
    if v.abs() < 1e-6 {
        return 1.0;
    }
    let steps = 16 + v.abs().ceil() as usize;
    let sum: f64 = (0..steps)
        .map(|i| {
            // Half steps: the rule's ends fall together with its neighbours.
            let t = PI * (i as f64 + 0.5) / steps as f64;
            (t - v * t.sin()).cos()
        })
        .sum();
    (2.0 * sum / steps as f64 / v).powi(2)
}

/// The autocovariance of speckle in pixels, tabulated.
#[derive(Debug, Clone, PartialEq)]
pub struct Grains {
    /// Grain `λ/(2NA)` in pixels.
    pub grain_px: f64,
    /// `K` at multiples of [`Grains::step`].
    values: Vec<f64>,
    step: f64,
}

/// Points of the quadrature over a pixel's width.
const QUADRATURE: usize = 12;
/// Values of the table, and grains and pixels that it goes to.
const TABLE: usize = 97;
const TABLE_REACH: f64 = 3.0;

impl Grains {
    /// Those of a grain `λ/(2NA)` in pixels.
    pub fn new(grain_px: f64) -> Self {
        let step = (TABLE_REACH * grain_px + 2.0) / (TABLE - 1) as f64;
        let points: Vec<(f64, f64)> = (0..2 * QUADRATURE)
            .map(|i| {
                let x = (i as f64 + 0.5) / QUADRATURE as f64 - 1.0;
                (x, (1.0 - x.abs()) / QUADRATURE as f64)
            })
            .collect();
        // μ² over the distance, finely: the quadrature asks for it 55,000 times.
        let fine = 0.02 * grain_px.min(1.0);
        let reach = step * TABLE as f64 + 3.0;
        let curve: Vec<f64> = (0..(reach / fine) as usize + 2)
            .map(|i| airy(PI * i as f64 * fine / grain_px))
            .collect();
        let covariance = |s: f64| {
            let at = s / fine;
            let i = at as usize;
            curve[i] + (at - i as f64) * (curve[i + 1] - curve[i])
        };
        let values = (0..TABLE)
            .map(|i| {
                let s = i as f64 * step;
                let line = |&(y, wy): &(f64, f64)| -> f64 {
                    let sum: f64 = points
                        .iter()
                        .map(|(x, wx)| wx * covariance((s - x).hypot(y)))
                        .sum();
                    wy * sum
                };
                points.iter().map(line).sum()
            })
            .collect();
        Self {
            grain_px,
            values,
            step,
        }
    }

    /// Contrast of fully developed speckle in the pixels.
    pub fn contrast(&self) -> f64 {
        self.values[0].sqrt()
    }

    /// `K(s)/K(0)`; zero beyond the table.
    pub fn correlation(&self, s: f64) -> f64 {
        let at = s.abs() / self.step;
        let i = at as usize;
        match self.values.get(i..i + 2) {
            Some(v) => (v[0] + (at - i as f64) * (v[1] - v[0])) / self.values[0],
            None => 0.0,
        }
    }

    /// Full width at half maximum of the autocovariance on the sensor, in pixels: what
    /// a measurement of a captured PSF gives.
    pub fn fwhm_px(&self) -> f64 {
        let half = 0.5 * self.values[0];
        let below = self.values.iter().position(|&v| v < half).unwrap_or(1);
        let (above, under) = (self.values[below - 1], self.values[below]);
        2.0 * self.step * ((below - 1) as f64 + (above - half) / (above - under))
    }

    /// Whether two pixels fall on a grain, the Nyquist rate of the intensity's band
    /// limit `1/g`.
    pub fn is_sampled(&self) -> bool {
        self.grain_px >= 2.0
    }
}

/// How the PSF changes with the wavelength.
#[derive(Debug, Clone, PartialEq)]
pub struct Dispersion {
    wavelength_nm: f64,
    path_rms_nm: f64,
    grains: Grains,
    /// Weights over the distance from the undeflected point, in steps of a pixel.
    weights: Vec<f64>,
}

impl Dispersion {
    /// For an envelope of `fwhm_px` on `camera`; `path_rms_nm` is the rms of the optical
    /// path through the diffuser.
    pub fn new(
        camera: &Camera,
        grains: &Grains,
        fwhm_px: f64,
        wavelength_nm: f64,
        path_rms_nm: f64,
    ) -> Self {
        let sigma = fwhm_px / FWHM_PER_SIGMA;
        let (field_rows, field_columns) = camera.field();
        // Pairs of field point and pixel at a displacement, with a field about as large
        // as the sensor and around it, times the squared envelope.
        let along = |field: usize, sensor: usize| -> Vec<f64> {
            let (long, short) = (field.max(sensor) as f64, field.min(sensor) as f64);
            (0..(field + sensor) / 2 + 1)
                .map(|d| {
                    let pairs = (0.5 * (long + short) - d as f64).clamp(0.0, short);
                    pairs * (-(d as f64 / sigma).powi(2)).exp()
                })
                .collect()
        };
        let down = along(field_rows, camera.rows());
        let right = along(field_columns, camera.columns());
        let mut weights = vec![0.0; (down.len() as f64).hypot(right.len() as f64) as usize + 2];
        for (y, wy) in down.iter().enumerate() {
            for (x, wx) in right.iter().enumerate() {
                // Every quadrant has its share but for the axes, which two have in common.
                let share = [1.0, 0.5][usize::from(y == 0)] * [1.0, 0.5][usize::from(x == 0)];
                weights[(y as f64).hypot(x as f64).round() as usize] += wy * wx * share;
            }
        }
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|w| *w /= sum);
        Self {
            wavelength_nm,
            path_rms_nm,
            grains: grains.clone(),
            weights,
        }
    }

    /// Correlation by the movement of the grains alone, at a difference in nanometres.
    pub fn by_diffraction(&self, difference_nm: f64) -> f64 {
        let part = difference_nm / self.wavelength_nm;
        let moved = self.weights.iter().enumerate();
        moved
            .map(|(r, w)| w * self.grains.correlation(r as f64 * part))
            .sum()
    }

    /// Correlation by the path through the diffuser alone.
    pub fn by_path(&self, difference_nm: f64) -> f64 {
        let phase = 2.0 * PI * self.path_rms_nm * difference_nm / self.wavelength_nm.powi(2);
        (-phase * phase).exp()
    }

    /// Correlation of two PSFs whose wavelengths differ.
    pub fn correlation(&self, difference_nm: f64) -> f64 {
        self.by_diffraction(difference_nm) * self.by_path(difference_nm)
    }

    /// The difference at which a correlation that falls has come down to one half.
    pub fn half_width_nm(&self, correlation: impl Fn(f64) -> f64) -> f64 {
        let (mut low, mut high) = (0.0, self.wavelength_nm);
        if correlation(high) > 0.5 {
            return high;
        }
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if correlation(middle) > 0.5 {
                low = middle;
            } else {
                high = middle;
            }
        }
        high
    }

    /// Part of the contrast that light of the bandwidth keeps.
    pub fn contrast_kept(&self, bandwidth_nm: f64) -> f64 {
        const STEPS: usize = 200;
        let sum: f64 = (0..STEPS)
            .map(|i| {
                let u = (i as f64 + 0.5) / STEPS as f64;
                2.0 * (1.0 - u) * self.correlation(u * bandwidth_nm)
            })
            .sum();
        (sum / STEPS as f64).sqrt()
    }
}
