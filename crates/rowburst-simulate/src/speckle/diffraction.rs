//! The sampled pupil, its far field, and the pixels that integrate it.
//!
//! All lengths in the image plane are in pixels. The window of the transform holds
//! the whole envelope, so that nothing wraps around; its samples lie at most half a
//! grain apart, the Nyquist rate of an intensity of band limit `D/(λz)`. The mean
//! over a pixel is then exact: a product with sinc in the frequency domain.

use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use rand_pcg::Pcg64;
use rowburst_core::fft::{Fft2, smooth_length};
use rowburst_core::{Error, Parameter, Result};
use rustfft::num_complex::Complex32;
use std::f64::consts::PI;

/// Rms phase of the screen in radians. The unscattered light is `exp(−σ_φ²)` = 10⁻⁷
/// of the whole, below a thousandth of one grain; a stronger screen has a longer
/// correlation, fewer independent parts in the pupil, and poorer statistics.
pub(super) const RMS_PHASE: f64 = 4.0;

/// `1 − c/σ_φ²` is the width of the exact spectrum of `exp(−σ_φ²(1 − exp(−r²/ℓ²)))` over
/// that of its limit `exp(−σ_φ²r²/ℓ²)` at half maximum: the spectrum is a sum of Gaussians
/// of variance `n` with Poisson weights of mean `σ_φ²`. Exact at [`RMS_PHASE`] (0.9424);
/// beyond, what is left is the next order.
const SPECTRUM_NARROWING: f64 = (1.0 - 0.9424) * RMS_PHASE * RMS_PHASE;

/// Window in standard deviations of the envelope. A Gaussian has 10⁻⁶ outside; the
/// tails of the exact spectrum, a little heavier, have 10⁻⁴.
const WINDOW_SIGMAS: f64 = 10.0;

/// Longest side of a transform: 8192² complex f32 are 512 MiB.
const MAX_TRANSFORM: usize = 8192;

/// Full width at half maximum of a Gaussian over its standard deviation, √(8 ln 2).
const FWHM_PER_SIGMA: f64 = 2.354_820_045;

/// Sampling of the pupil and of the image plane.
#[derive(Debug)]
pub(super) struct Grid {
    /// Side of the transform.
    n: usize,
    /// Samples along a pixel.
    per_pixel: usize,
    /// Diameter of the pupil in pupil samples.
    pupil: f64,
    /// Rms phase `σ_φ` of the screen in radians.
    rms_phase: f64,
    /// Correlation length `ℓ` of the screen in pupil samples.
    correlation: f64,
}

impl Grid {
    /// The sampling for a grain `λz/D` and an envelope, both in pixels, and a screen of
    /// `rms_phase` radians, at least [`RMS_PHASE`].
    pub(super) fn new(grain_px: f64, envelope_fwhm_px: f64, rms_phase: f64) -> Result<Self> {
        // A grain of two pixels but for rounding needs no finer samples.
        let per_pixel = (2.0 / grain_px - 1e-9).ceil().max(1.0);
        let sigma = envelope_fwhm_px / FWHM_PER_SIGMA * per_pixel;
        let needed = WINDOW_SIGMAS * sigma;
        if needed > MAX_TRANSFORM as f64 {
            return Err(Error::input(
                Parameter::SpeckleOptics,
                format!(
                    "an envelope of {envelope_fwhm_px:.0} px and grains of {grain_px:.3} px, a transform of {needed:.0} points a side"
                ),
                format!("a simulated PSF needs at most {MAX_TRANSFORM}"),
                "Take a diffuser of a smaller angle, a smaller pupil, or larger pixels.",
            ));
        }
        let n = smooth_length((needed.ceil() as usize).max(32));
        // One pupil sample is λz/(n·dx): the pupil D is n·dx/grain samples.
        let pupil = n as f64 / (grain_px * per_pixel);
        // Phase slope s per sample scatters to s·n/(2π) image samples, and the slope
        // variance of the screen is 2σ_φ²/ℓ² along each axis.
        let width = 1.0 - SPECTRUM_NARROWING / (rms_phase * rms_phase);
        let slope = 2.0 * PI * sigma / (width * n as f64);
        Ok(Self {
            n,
            per_pixel: per_pixel as usize,
            pupil,
            rms_phase,
            correlation: 2f64.sqrt() * rms_phase / slope,
        })
    }

    /// The mean of the intensity over a pixel centred at each image sample.
    pub(super) fn pixel_intensity(&self, seed: u64) -> Vec<f32> {
        let n = self.n;
        let fft = Fft2::new(n);
        let mut field = self.pupil_field(seed);
        fft.forward(&mut field);
        for value in &mut field {
            *value = Complex32::new(value.norm_sqr(), 0.0);
        }
        fft.forward(&mut field);
        let box_of = |k: usize| {
            let signed = if 2 * k <= n {
                k as f64
            } else {
                k as f64 - n as f64
            };
            sinc(signed / n as f64 * self.per_pixel as f64)
        };
        let pixel: Vec<f64> = (0..n).map(box_of).collect();
        for (row, py) in field.chunks_exact_mut(n).zip(&pixel) {
            for (value, px) in row.iter_mut().zip(&pixel) {
                *value *= (py * px) as f32;
            }
        }
        fft.inverse(&mut field);
        // Below zero only by rounding.
        field.iter().map(|value| value.re.max(0.0)).collect()
    }

    /// The value of the window at a displacement in pixels; zero outside of it.
    pub(super) fn at(&self, window: &[f32], dy: isize, dx: isize) -> f32 {
        let place = |d: isize| {
            let sample = d * self.per_pixel as isize;
            let inside = 2 * sample.unsigned_abs() < self.n;
            inside.then(|| sample.rem_euclid(self.n as isize) as usize)
        };
        match (place(dy), place(dx)) {
            (Some(y), Some(x)) => window[y * self.n + x],
            _ => 0.0,
        }
    }

    /// The circular pupil times the diffuser's phase, at the corner of the array.
    ///
    /// Where the pupil lies in the array changes only the phase of its far field.
    fn pupil_field(&self, seed: u64) -> Vec<Complex32> {
        let (side, screen) = self.phase_screen(seed);
        let mut field = vec![Complex32::default(); self.n * self.n];
        let across = (self.pupil.ceil() as usize + 2).min(side).min(self.n);
        let centre = 0.5 * (across as f64 - 1.0);
        for y in 0..across {
            for x in 0..across {
                let radius = (y as f64 - centre).hypot(x as f64 - centre);
                // The edge sample counts by the part of it inside the circle.
                let inside = (0.5 * self.pupil - radius + 0.5).clamp(0.0, 1.0) as f32;
                if inside > 0.0 {
                    let phase = screen[y * side + x].re;
                    field[y * self.n + x] = Complex32::cis(phase) * inside;
                }
            }
        }
        field
    }

    /// A periodic Gaussian screen, larger than the pupil by more than its correlation:
    /// white noise filtered by the root of the spectrum, `exp(−π²ℓ²f²/2)`.
    fn phase_screen(&self, seed: u64) -> (usize, Vec<Complex32>) {
        let side = smooth_length((self.pupil + 4.0 * self.correlation).ceil() as usize + 2);
        let filter_of = |k: usize| {
            let frequency = k.min(side - k) as f64 / side as f64;
            (-0.5 * (PI * self.correlation * frequency).powi(2)).exp()
        };
        let filter: Vec<f64> = (0..side).map(filter_of).collect();
        let power: f64 = filter.iter().map(|f| f * f).sum();
        let scale = self.rms_phase / power;
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut screen = vec![Complex32::default(); side * side];
        for (row, fy) in screen.chunks_exact_mut(side).zip(&filter) {
            for (value, fx) in row.iter_mut().zip(&filter) {
                let amplitude = (scale * fy * fx) as f32;
                let (re, im): (f32, f32) = (rng.sample(StandardNormal), rng.sample(StandardNormal));
                *value = Complex32::new(re, im) * amplitude;
            }
        }
        Fft2::new(side).forward(&mut screen);
        (side, screen)
    }
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        1.0
    } else {
        (PI * x).sin() / (PI * x)
    }
}
