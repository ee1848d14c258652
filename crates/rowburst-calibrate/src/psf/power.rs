//! The power spectrum of the capture of a speckle PSF, and the noise in it.
//!
//! A speckle PSF `p` has a smooth local mean `μ`, and `p/μ` has a power spectrum that ends at the optics' cut-off. Power
//! beyond it is the noise of the capture, with the variance `g μ`.

use rowburst_core::fft::{Fft2, smooth_length};
use rustfft::num_complex::Complex32;

/// Standard deviation of the Gaussian that gives the local mean, in pixels; larger follows the envelope less.
const LOCAL_MEAN_PX: f64 = 12.0;
/// Pixels around a PSF in transforms; fewer let opposite edges meet.
const BORDER: usize = 40;
/// Values of the radial power spectrum for each cycle per pixel.
const RESOLUTION: f64 = 128.0;
/// Frequencies, in cycles per pixel, beyond which the optics pass nothing; where they do, noise is overestimated.
const NOISE_BAND: (f64, f64) = (0.55, 0.70);
/// Power over that of the noise below which there is no speckle.
const MIN_POWER: f64 = 0.03;
/// Frequency over the cut-off below which the capture is taken as it is.
const TRUSTED: f64 = 0.5;

/// The Fourier transforms of images of one size, on a larger square.
#[derive(Clone)]
pub struct PaddedFft {
    rows: usize,
    columns: usize,
    side: usize,
    fft: Fft2,
}

impl PaddedFft {
    /// The transforms of images of `rows × columns` pixels.
    pub fn new(rows: usize, columns: usize) -> Self {
        let side = smooth_length(rows.max(columns) + BORDER);
        Self {
            rows,
            columns,
            side,
            fft: Fft2::new(side),
        }
    }

    /// Number of points of a transform.
    pub fn points(&self) -> usize {
        self.side * self.side
    }

    /// Frequency in cycles per pixel of position `at` of a transform.
    pub fn frequency(&self, at: usize) -> f64 {
        let along = |k: usize| k.min(self.side - k) as f64 / self.side as f64;
        along(at / self.side).hypot(along(at % self.side))
    }

    /// The square with `values` in a corner, surrounded by zeros or by its mirror image.
    pub fn padded(&self, values: &[f32], is_mirrored: bool) -> Vec<Complex32> {
        let mut square = vec![Complex32::default(); self.side * self.side];
        let place = |at: usize, length: usize| match at {
            at if at < length => Some(at),
            _ if !is_mirrored => None,
            // The border is shared by the mirror images at both ends.
            at if at < (length + self.side) / 2 => Some(2 * length - 1 - at),
            at => Some(self.side - 1 - at),
        };
        for (y, line) in square.chunks_exact_mut(self.side).enumerate() {
            for (x, value) in line.iter_mut().enumerate() {
                if let (Some(y), Some(x)) = (place(y, self.rows), place(x, self.columns)) {
                    value.re = values[y * self.columns + x];
                }
            }
        }
        square
    }

    /// The values of a square that are not border, times `scale`.
    pub fn cropped(&self, square: &[Complex32], scale: f32) -> Vec<f32> {
        let lines = square.chunks_exact(self.side).take(self.rows);
        lines
            .flat_map(|line| line[..self.columns].iter().map(|v| scale * v.re))
            .collect()
    }

    /// Multiplies the spectrum of `square` by `gain` at each position.
    pub fn filter(&self, square: &mut [Complex32], gain: &[f32]) {
        self.fft.forward(square);
        square.iter_mut().zip(gain).for_each(|(v, g)| *v *= g);
        self.fft.inverse(square);
    }

    /// `1/n²` of the transform there and back.
    pub fn scale(&self) -> f32 {
        1.0 / (self.side * self.side) as f32
    }

    /// The image `values`, continued as its mirror image, through a filter of `gain` at each frequency.
    pub fn filtered(&self, values: &[f32], gain: impl Fn(f64) -> f64) -> Vec<f32> {
        let mut square = self.padded(values, true);
        let gain: Vec<f32> = (0..square.len())
            .map(|i| gain(self.frequency(i)) as f32)
            .collect();
        self.filter(&mut square, &gain);
        self.cropped(&square, self.scale())
    }

    /// Smoothing by a Gaussian.
    pub fn smoothed(&self, values: &[f32], sigma_px: f64) -> Vec<f32> {
        let exponent = -2.0 * (std::f64::consts::PI * sigma_px).powi(2);
        self.filtered(values, |f| (exponent * f * f).exp())
    }
}

/// The radial power spectrum of a capture, of speckle and of noise.
pub struct CaptureSpectrum {
    /// The local mean `μ` of the capture, `[y, x]`.
    pub local_mean: Vec<f32>,
    /// Power of `p/μ` less the noise, at each multiple of `1/RESOLUTION` cycles per pixel.
    speckle: Vec<f64>,
    /// Mean variance of the noise of a pixel.
    noise: f64,
    /// Variance of the noise over the light, `g`.
    noise_per_light: f64,
    /// Mean of `μ²`.
    mean_square: f64,
    /// The frequency from which on there is no speckle.
    cut_off: f64,
}

impl CaptureSpectrum {
    /// The spectrum of `image`, which has the size of `transform`. `noise_per_light` is `g` where it is known; `None`: the power
    /// beyond the cut-off tells it.
    pub fn new(transform: &PaddedFft, image: &[f32], noise_per_light: Option<f64>) -> Self {
        let local_mean = transform.smoothed(image, LOCAL_MEAN_PX);
        let hann = |at: usize, length: usize| {
            let phase = std::f64::consts::PI * (at as f64 + 1.0) / (length as f64 + 1.0);
            phase.sin().powi(2)
        };
        let window = |i: usize| {
            hann(i / transform.columns, transform.rows)
                * hann(i % transform.columns, transform.columns)
        };
        let detail: Vec<f32> = (0..image.len())
            .map(|i| ((f64::from(image[i]) - f64::from(local_mean[i])) * window(i)) as f32)
            .collect();
        let weights: Vec<f64> = (0..image.len()).map(|i| window(i).powi(2)).collect();
        let weight: f64 = weights.iter().sum();
        let power = radial_power(transform, &detail, weight);
        let weighted = |of: &dyn Fn(f64) -> f64| -> f64 {
            let values = weights.iter().zip(&local_mean);
            values.map(|(w, m)| w * of(f64::from(*m))).sum::<f64>() / weight
        };
        let light = weighted(&|m| m).max(f64::MIN_POSITIVE);
        let band = (NOISE_BAND.0 * RESOLUTION) as usize..(NOISE_BAND.1 * RESOLUTION) as usize;
        let measured = power[band.clone()].iter().sum::<f64>() / band.len() as f64;
        let noise = noise_per_light.map_or(measured, |g| g * light);
        let (speckle, end) = speckle_power(&power, noise, weighted(&|m| m * m));
        let mean = |of: &dyn Fn(f64) -> f64| {
            local_mean.iter().map(|&m| of(f64::from(m))).sum::<f64>() / local_mean.len() as f64
        };
        let noise_per_light = noise / light;
        Self {
            speckle,
            noise: noise_per_light * mean(&|m| m),
            noise_per_light,
            mean_square: mean(&|m| m * m),
            cut_off: end as f64 / RESOLUTION,
            local_mean,
        }
    }

    /// The same spectrum, with noise of this variance over the light.
    #[must_use]
    pub fn with_noise(mut self, noise_per_light: f64) -> Self {
        self.noise *= noise_per_light / self.noise_per_light.max(f64::MIN_POSITIVE);
        self.noise_per_light = noise_per_light;
        self
    }

    /// Power of `p/μ` at a frequency in cycles per pixel, by linear interpolation.
    pub fn speckle(&self, frequency: f64) -> f64 {
        let at = (frequency * RESOLUTION - 0.5).max(0.0);
        let first = (at as usize).min(self.speckle.len() - 1);
        let next = (first + 1).min(self.speckle.len() - 1);
        let part = (at - first as f64).clamp(0.0, 1.0);
        (1.0 - part) * self.speckle[first] + part * self.speckle[next]
    }

    /// Mean variance of the noise of a pixel.
    pub fn noise(&self) -> f64 {
        self.noise
    }

    /// Variance of the noise over the light, `g`.
    pub fn noise_per_light(&self) -> f64 {
        self.noise_per_light
    }

    /// The frequency in cycles per pixel from which on there is no speckle.
    pub fn cut_off(&self) -> f64 {
        self.cut_off
    }

    /// The part of the power at a frequency that is light, for a capture that passes speckle by `transfer`: the gain of a
    /// Wiener filter. 1 at low frequencies, where the capture is taken as it is.
    pub fn light_part(&self, frequency: f64, transfer: f64) -> f64 {
        if frequency < TRUSTED * self.cut_off {
            return 1.0;
        }
        let light = self.speckle(frequency) * self.mean_square * transfer.powi(2);
        light / (light + self.noise).max(f64::MIN_POSITIVE)
    }
}

/// Mean power of `detail`, over `weight`, at each multiple of `1/RESOLUTION` cycles per pixel.
fn radial_power(transform: &PaddedFft, detail: &[f32], weight: f64) -> Vec<f64> {
    let mut square = transform.padded(detail, false);
    transform.fft.forward(&mut square);
    let count = (std::f64::consts::FRAC_1_SQRT_2 * RESOLUTION).ceil() as usize + 1;
    let mut power = vec![(0.0, 0usize); count];
    for (i, value) in square.iter().enumerate() {
        let bin = &mut power[(transform.frequency(i) * RESOLUTION) as usize];
        *bin = (bin.0 + f64::from(value.norm_sqr()) / weight, bin.1 + 1);
    }
    let means = power.iter().map(|(sum, n)| sum / (*n).max(1) as f64);
    means.collect()
}

/// `power` less `noise`, over `mean_square`, and the index from which on it is zero.
fn speckle_power(power: &[f64], noise: f64, mean_square: f64) -> (Vec<f64>, usize) {
    let mut speckle: Vec<f64> = power.iter().map(|p| (p - noise).max(0.0)).collect();
    speckle
        .iter_mut()
        .filter(|s| **s < MIN_POWER * noise)
        .for_each(|s| *s = 0.0);
    // The lowest frequencies are those of the local mean.
    let lowest = speckle[2];
    speckle[..2].fill(lowest);
    let end = (4..speckle.len())
        .find(|&i| speckle[i] == 0.0)
        .unwrap_or(speckle.len());
    speckle[end..].fill(0.0);
    speckle
        .iter_mut()
        .for_each(|s| *s /= mean_square.max(f64::MIN_POSITIVE));
    (speckle, end)
}
