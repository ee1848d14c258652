//! What a captured PSF may be wrong by: noise of its capture, and speckle that has changed since.
//!
//! A speckle PSF `p` has a smooth local mean `μ`, and `p/μ` has the power spectrum `F`, which ends at the optics'
//! cut-off. The noise of the capture has the variance `g μ`. Both errors are
//!
//! ```text
//! δp = D F^½ z,    z ~ N(0, 1)
//! ```
//!
//! with `D = √(g p)` and the part of light in the power as `F` (noise), or `D = κ μ` and the spectrum of the speckle
//! (change). Where the blur of a pinhole of transfer function `H` was removed, the noise has that part over `H²`. `κ` is
//! found from the misfit of a frame. `g` comes from the calibration of the PSF, or is the power beyond the cut-off.

use rowburst_calibrate::psf::{CaptureSpectrum, PaddedFft, pinhole_inverse, pinhole_transfer};
use rowburst_optics::{Image, Psf};
use rustfft::num_complex::Complex32;

/// Smallest value that noise is taken from, over the local mean.
const MIN_VALUE: f64 = 0.1;
/// Noise power over the squared mean of the PSF below which a capture has no noise.
const MIN_NOISE: f64 = 1e-5;
/// Standard deviation in pixels of the smoothing of the values that noise is taken from.
const SMOOTHING_PX: f64 = 0.7;

/// A Gaussian prior of the error of a PSF.
#[derive(Clone)]
pub(super) struct PsfError {
    transform: PaddedFft,
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
        self.transform.filter(&mut square, &self.gain);
        let mut error = self.transform.cropped(&square, self.transform.scale());
        error
            .iter_mut()
            .zip(&self.deviation)
            .for_each(|(e, d)| *e *= d);
        error
    }

    /// `F^½ D x`, the adjoint.
    pub fn adjoint(&self, x: &[f32]) -> Vec<f32> {
        let scaled: Vec<f32> = x.iter().zip(&self.deviation).map(|(x, d)| x * d).collect();
        let mut square = self.transform.padded(&scaled, false);
        self.transform.filter(&mut square, &self.gain);
        let scale = self.transform.scale();
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
    /// The PSF without the noise that lies beyond the optics' cut-off.
    pub anchor: Psf,
    /// The noise left in it; `None`: the capture has none.
    pub noise: Option<PsfError>,
    /// A change of the speckle by its own size.
    pub change: PsfError,
}

impl Capture {
    pub fn new(psf: &Psf) -> Self {
        let (image, known) = (psf.image(), psf.capture());
        let pinhole_px = known.map_or(0.0, |known| known.pinhole_px);
        let transform = PaddedFft::new(image.rows(), image.columns());
        // Without the blur of a pinhole little noise is left beyond the cut-off.
        let known_noise = known.map(|known| known.noise_per_light);
        let spectrum = CaptureSpectrum::new(
            &transform,
            image.data(),
            known_noise.filter(|_| pinhole_px == 0.0),
        );
        let at_each_frequency = |of: &dyn Fn(f64) -> f64| -> Vec<f32> {
            let frequencies = (0..transform.points()).map(|i| transform.frequency(i));
            frequencies.map(|f| of(f) as f32).collect()
        };
        let change = PsfError {
            deviation: spectrum.local_mean.clone(),
            gain: at_each_frequency(&|f| spectrum.speckle(f).sqrt()),
            transform: transform.clone(),
        };
        let average = 1.0 / image.data().len() as f64;
        let per_light = known_noise.unwrap_or(spectrum.noise_per_light());
        if per_light * average <= MIN_NOISE * average * average {
            return Self {
                anchor: psf.clone(),
                noise: None,
                change,
            };
        }
        let spectrum = spectrum.with_noise(per_light);
        let anchor = if pinhole_px > 0.0 {
            psf.clone()
        } else {
            in_pass_band(psf, &transform, &spectrum)
        };
        let smooth = transform.smoothed(anchor.image().data(), SMOOTHING_PX);
        let values = smooth.iter().zip(&spectrum.local_mean);
        let deviation = values.map(|(p, m)| {
            let value = f64::from(*p).max(MIN_VALUE * f64::from(*m)).max(0.0);
            (per_light * value).sqrt() as f32
        });
        let noise = PsfError {
            deviation: deviation.collect(),
            gain: at_each_frequency(&|f| {
                let transfer = pinhole_transfer(pinhole_px, f);
                spectrum.light_part(f, transfer).sqrt() * pinhole_inverse(pinhole_px, f).abs()
            }),
            transform,
        };
        Self {
            noise: Some(noise),
            anchor,
            change,
        }
    }
}

/// The PSF without the noise that lies beyond the optics' cut-off.
fn in_pass_band(psf: &Psf, transform: &PaddedFft, spectrum: &CaptureSpectrum) -> Psf {
    let image = psf.image();
    let mut values = transform.filtered(image.data(), |f| spectrum.light_part(f, 1.0));
    values.iter_mut().for_each(|p| *p = p.max(0.0));
    let image = Image::new(image.rows(), image.columns(), values);
    Psf::new(image.expect("the size of the PSF")).unwrap_or_else(|_| psf.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rowburst_calibrate::psf::without_pinhole;
    use rowburst_core::vecmath::{dot, norm};
    use rowburst_optics::PsfCapture;
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    fn speckle() -> Image {
        let psf = speckle_psf(&SpeckleOptics::demo(), 120, 140, 3).unwrap();
        psf.image().clone()
    }

    fn psf(image: &Image) -> Psf {
        Psf::new(image.clone()).unwrap()
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
        let capture = Capture::new(&psf(&photographed(&speckle(), 100.0)));
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

    /// A simulated PSF has no noise. That of a capture is known, and taking what is outside the pass band away lowers it.
    #[test]
    fn knows_the_noise_of_a_capture() {
        let image = speckle();
        assert!(Capture::new(&psf(&image)).noise.is_none());
        let noisy = photographed(&image, 100.0);
        let capture = Capture::new(&psf(&noisy));
        assert!(distance(capture.anchor.image(), &image) < 0.9 * distance(&noisy, &image));
        check_size(&capture, &image);
    }

    /// The prior of a sharpened PSF has the size of its error, which the power beyond the cut-off does not tell.
    #[test]
    fn knows_the_noise_of_a_sharpened_capture() {
        let image = speckle();
        // The image stands for a capture, and its sharpened version for the truth.
        let sharp = without_pinhole(&photographed(&image, 100.0), 1.5);
        let truth = without_pinhole(&image, 1.5).image;
        let nonnegative = |image: &Image| {
            let value = |y, x| f32::max(image.at(y, x), 0.0);
            psf(&Image::from_fn(image.rows(), image.columns(), value))
        };
        let known = PsfCapture {
            noise_per_light: sharp.noise_per_light,
            pinhole_px: 1.5,
        };
        let captured = nonnegative(&sharp.image).with_capture(Some(known));
        check_size(&Capture::new(&captured), nonnegative(&truth).image());
    }

    fn distance(a: &Image, b: &Image) -> f64 {
        let pairs = a.data().iter().zip(b.data());
        norm(&pairs.map(|(a, b)| a - b).collect::<Vec<_>>())
    }

    /// Draws of the noise of `capture` are as large as its distance from `truth`.
    fn check_size(capture: &Capture, truth: &Image) {
        let noise = capture.noise.as_ref().expect("noise");
        let mut rng = rand_pcg::Pcg64::seed_from_u64(2);
        let z: Vec<f32> = (0..noise.unknowns())
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        let ratio = norm(&noise.apply(&z)) / distance(capture.anchor.image(), truth);
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }
}
