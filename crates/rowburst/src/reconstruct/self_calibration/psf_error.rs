//! What a captured PSF may be wrong by: noise of its capture, and speckle that has changed since.
//!
//! A speckle PSF `p` has a smooth local mean `μ`, and `p/μ` has the power spectrum `F`, which ends at the optics'
//! cut-off. Power beyond it is the noise of the capture, with the variance `g μ`. Both errors are
//!
//! ```text
//! δp = D F^½ z,    z ~ N(0, 1)
//! ```
//!
//! with `D = √(g p)` and the Wiener gain for `F` (noise), or `D = κ μ` and the spectrum of the speckle (change). `κ` is
//! found from the misfit of a frame.

use rowburst_core::fft2::{Fft2, smooth_length};
use rowburst_optics::Image;
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
/// Smallest value that noise is taken from, over the local mean.
const MIN_VALUE: f64 = 0.1;
/// Noise power over the squared mean of the PSF below which a capture has no noise.
const MIN_NOISE: f64 = 1e-5;
/// Standard deviation in pixels of the smoothing of the values that noise is taken from.
const SMOOTHING_PX: f64 = 0.7;

/// The Fourier transforms of images of one size, on a larger square.
#[derive(Clone)]
struct Plane {
    rows: usize,
    columns: usize,
    side: usize,
    fft: Fft2,
}

impl Plane {
    fn new(rows: usize, columns: usize) -> Self {
        let side = smooth_length(rows.max(columns) + BORDER);
        Self {
            rows,
            columns,
            side,
            fft: Fft2::new(side),
        }
    }

    /// Frequency in cycles per pixel of position `at` of a transform.
    fn frequency(&self, at: usize) -> f64 {
        let along = |k: usize| k.min(self.side - k) as f64 / self.side as f64;
        along(at / self.side).hypot(along(at % self.side))
    }

    /// The square with `values` in a corner, surrounded by zeros or by its mirror image.
    fn padded(&self, values: &[f32], is_mirrored: bool) -> Vec<Complex32> {
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
    fn cropped(&self, square: &[Complex32], scale: f32) -> Vec<f32> {
        let lines = square.chunks_exact(self.side).take(self.rows);
        lines
            .flat_map(|line| line[..self.columns].iter().map(|v| scale * v.re))
            .collect()
    }

    /// Multiplies the spectrum of `square` by `gain` at each position.
    fn filter(&self, square: &mut [Complex32], gain: &[f32]) {
        self.fft.forward(square);
        square.iter_mut().zip(gain).for_each(|(v, g)| *v *= g);
        self.fft.inverse(square);
    }

    /// `1/n²` of the transform there and back.
    fn scale(&self) -> f32 {
        1.0 / (self.side * self.side) as f32
    }

    /// The image `values`, continued as its mirror image, through a filter of `gain` at each frequency.
    fn filtered(&self, values: &[f32], gain: impl Fn(f64) -> f64) -> Vec<f32> {
        let mut square = self.padded(values, true);
        let gain: Vec<f32> = (0..square.len())
            .map(|i| gain(self.frequency(i)) as f32)
            .collect();
        self.filter(&mut square, &gain);
        self.cropped(&square, self.scale())
    }

    /// Smoothing by a Gaussian.
    fn smoothed(&self, values: &[f32], sigma_px: f64) -> Vec<f32> {
        let exponent = -2.0 * (std::f64::consts::PI * sigma_px).powi(2);
        self.filtered(values, |f| (exponent * f * f).exp())
    }
}

/// A Gaussian prior of the error of a PSF.
#[derive(Clone)]
pub(super) struct PsfError {
    plane: Plane,
    /// `D`.
    deviation: Vec<f32>,
    /// `F^½` at each frequency.
    gain: Vec<f32>,
}

impl PsfError {
    /// Number of values of `z`.
    pub fn unknowns(&self) -> usize {
        self.gain.len()
    }

    /// `D F^½ z`.
    pub fn apply(&self, z: &[f32]) -> Vec<f32> {
        let mut square: Vec<Complex32> = z.iter().map(|&z| Complex32::new(z, 0.0)).collect();
        self.plane.filter(&mut square, &self.gain);
        let mut error = self.plane.cropped(&square, self.plane.scale());
        error
            .iter_mut()
            .zip(&self.deviation)
            .for_each(|(e, d)| *e *= d);
        error
    }

    /// `F^½ D x`, the adjoint.
    pub fn adjoint(&self, x: &[f32]) -> Vec<f32> {
        let scaled: Vec<f32> = x.iter().zip(&self.deviation).map(|(x, d)| x * d).collect();
        let mut square = self.plane.padded(&scaled, false);
        self.plane.filter(&mut square, &self.gain);
        let scale = self.plane.scale();
        square.iter().map(|v| scale * v.re).collect()
    }

    /// The same prior with `factor` times the standard deviation.
    pub fn scaled(mut self, factor: f64) -> Self {
        self.deviation.iter_mut().for_each(|d| *d *= factor as f32);
        self
    }
}

/// What a capture tells of its PSF.
pub(super) struct Capture {
    /// The PSF without the noise that lies beyond the optics' cut-off, summing to 1.
    pub anchor: Vec<f32>,
    /// The noise left in it; `None`: the capture has none.
    pub noise: Option<PsfError>,
    /// A change of the speckle by its own size.
    pub change: PsfError,
}

impl Capture {
    pub fn new(psf: &Image) -> Self {
        let plane = Plane::new(psf.rows(), psf.columns());
        let mean = plane.smoothed(psf.data(), LOCAL_MEAN_PX);
        let spectrum = Spectrum::new(&plane, psf.data(), &mean);
        let speckle = |plane: &Plane| -> Vec<f32> {
            (0..plane.side * plane.side)
                .map(|i| spectrum.speckle(plane.frequency(i)).sqrt() as f32)
                .collect()
        };
        let change = PsfError {
            deviation: mean.clone(),
            gain: speckle(&plane),
            plane: Plane::new(psf.rows(), psf.columns()),
        };
        let average = psf.data().iter().map(|&p| f64::from(p)).sum::<f64>() / mean.len() as f64;
        if spectrum.noise <= MIN_NOISE * average * average {
            return Self {
                anchor: psf.data().to_vec(),
                noise: None,
                change,
            };
        }
        let wiener = |f: f64| {
            let speckle = spectrum.speckle(f) * spectrum.mean_square;
            if f < TRUSTED * spectrum.cut_off {
                1.0
            } else {
                speckle / (speckle + spectrum.noise)
            }
        };
        let mut anchor = plane.filtered(psf.data(), wiener);
        anchor.iter_mut().for_each(|p| *p = p.max(0.0));
        let sum: f64 = anchor.iter().map(|&p| f64::from(p)).sum();
        anchor
            .iter_mut()
            .for_each(|p| *p = (f64::from(*p) / sum) as f32);
        let smooth = plane.smoothed(&anchor, SMOOTHING_PX);
        let values = smooth.iter().zip(&mean);
        let deviation = values.map(|(p, m)| {
            let value = f64::from(*p).max(MIN_VALUE * f64::from(*m)).max(0.0);
            (spectrum.noise_per_light * value).sqrt() as f32
        });
        let gain = (0..plane.side * plane.side).map(|i| wiener(plane.frequency(i)).sqrt() as f32);
        Self {
            noise: Some(PsfError {
                deviation: deviation.collect(),
                gain: gain.collect(),
                plane,
            }),
            anchor,
            change,
        }
    }
}

/// Radial power spectra of a capture.
struct Spectrum {
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

impl Spectrum {
    fn new(plane: &Plane, psf: &[f32], mean: &[f32]) -> Self {
        let hann = |at: usize, length: usize| {
            let phase = std::f64::consts::PI * (at as f64 + 1.0) / (length as f64 + 1.0);
            phase.sin().powi(2)
        };
        let window =
            |i: usize| hann(i / plane.columns, plane.rows) * hann(i % plane.columns, plane.columns);
        let detail: Vec<f32> = (0..psf.len())
            .map(|i| ((f64::from(psf[i]) - f64::from(mean[i])) * window(i)) as f32)
            .collect();
        let weights: Vec<f64> = (0..psf.len()).map(|i| window(i).powi(2)).collect();
        let weight: f64 = weights.iter().sum();
        let mut square = plane.padded(&detail, false);
        plane.fft.forward(&mut square);
        let count = (std::f64::consts::FRAC_1_SQRT_2 * RESOLUTION).ceil() as usize + 1;
        let mut power = vec![(0.0, 0usize); count];
        for (i, value) in square.iter().enumerate() {
            let bin = &mut power[(plane.frequency(i) * RESOLUTION) as usize];
            *bin = (bin.0 + f64::from(value.norm_sqr()) / weight, bin.1 + 1);
        }
        let power: Vec<f64> = power
            .iter()
            .map(|(sum, n)| sum / (*n).max(1) as f64)
            .collect();
        let band = (NOISE_BAND.0 * RESOLUTION) as usize..(NOISE_BAND.1 * RESOLUTION) as usize;
        let noise = power[band.clone()].iter().sum::<f64>() / band.len() as f64;
        let weighted = |of: &dyn Fn(f64) -> f64| -> f64 {
            let values = weights.iter().zip(mean);
            values.map(|(w, m)| w * of(f64::from(*m))).sum::<f64>() / weight
        };
        let mean_square = weighted(&|m| m * m);
        let noise_per_light = noise / weighted(&|m| m).max(f64::MIN_POSITIVE);
        let average = mean.iter().map(|&m| f64::from(m)).sum::<f64>() / mean.len() as f64;
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
        Self {
            speckle,
            noise: noise_per_light * average,
            noise_per_light,
            mean_square: mean.iter().map(|&m| f64::from(m).powi(2)).sum::<f64>()
                / mean.len() as f64,
            cut_off: end as f64 / RESOLUTION,
        }
    }

    /// Power of `p/μ` at a frequency, by linear interpolation.
    fn speckle(&self, frequency: f64) -> f64 {
        let at = (frequency * RESOLUTION - 0.5).max(0.0);
        let first = (at as usize).min(self.speckle.len() - 1);
        let next = (first + 1).min(self.speckle.len() - 1);
        let part = (at - first as f64).clamp(0.0, 1.0);
        (1.0 - part) * self.speckle[first] + part * self.speckle[next]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rowburst_core::vecmath::{dot, norm};
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    fn speckle() -> Image {
        let psf = speckle_psf(&SpeckleOptics::demo(), 120, 140, 3).unwrap();
        psf.image().clone()
    }

    /// The image with noise as if its mean pixel had so many electrons.
    fn photographed(image: &Image, electrons: f64) -> Image {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        let unit = electrons * image.data().len() as f64;
        let mut capture = image.clone();
        for p in capture.data_mut() {
            let mean = f64::from(*p) * unit;
            let noise: f64 = StandardNormal.sample(&mut rng);
            *p = ((mean + noise * mean.sqrt()).max(0.0) / unit) as f32;
        }
        capture
    }

    #[test]
    fn adjoints_are_exact() {
        let capture = Capture::new(&photographed(&speckle(), 100.0));
        for error in [capture.change, capture.noise.expect("noise")] {
            let z: Vec<f32> = (0..error.unknowns())
                .map(|i| (i * i % 19) as f32 - 9.0)
                .collect();
            let x: Vec<f32> = (0..120 * 140).map(|i| (i * 7 % 23) as f32 - 11.0).collect();
            let (left, right) = (dot(&error.apply(&z), &x), dot(&z, &error.adjoint(&x)));
            let size = norm(&error.apply(&z)) * norm(&x);
            assert!((left - right).abs() < 1e-6 * size, "{left} {right}");
        }
    }

    /// A simulated PSF has no noise; that of a capture is known to 10 %, and taking what is outside the pass band away
    /// lowers it.
    #[test]
    fn knows_the_noise_of_a_capture() {
        let image = speckle();
        assert!(Capture::new(&image).noise.is_none());
        let noisy = photographed(&image, 100.0);
        let capture = Capture::new(&noisy);
        let plane = Plane::new(120, 140);
        let mean = plane.smoothed(noisy.data(), LOCAL_MEAN_PX);
        let found = Spectrum::new(&plane, noisy.data(), &mean).noise_per_light;
        let expected = 1.0 / (100.0 * (120.0 * 140.0));
        assert!((found / expected - 1.0).abs() < 0.1, "{found} {expected}");
        let error = |values: &[f32]| {
            let pairs = values.iter().zip(image.data());
            norm(&pairs.map(|(a, b)| a - b).collect::<Vec<_>>())
        };
        assert!(error(&capture.anchor) < 0.9 * error(noisy.data()));
        // The prior of what is left has its size.
        let noise = capture.noise.expect("noise");
        let mut rng = rand_pcg::Pcg64::seed_from_u64(2);
        let z: Vec<f32> = (0..noise.unknowns())
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        let ratio = norm(&noise.apply(&z)) / error(&capture.anchor);
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }
}
