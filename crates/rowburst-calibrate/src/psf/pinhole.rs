//! The pinhole that stands for a point source, and the PSF without its blur.
//!
//! The image of a pinhole is a disc, so a capture is the PSF convolved with it, and its spectrum that of the PSF times
//!
//! ```text
//! H(f) = 2 J₁(π d f) / (π d f),    d the diameter of the disc
//! ```
//!
//! Dividing by `H` amplifies noise where `H` is small; a Wiener filter takes it away where there is more noise than light.

use super::power::{CaptureSpectrum, PaddedFft};
use rowburst_optics::Image;
use std::f64::consts::PI;

/// Transfer function below which a frequency is lost; smaller amplifies errors of the diameter.
const MIN_TRANSFER: f64 = 0.08;
/// Diameter times frequency at the first zero of the transfer function.
const FIRST_ZERO: f64 = 1.2197;

/// Transfer function of a disc of `diameter_px` at `frequency` in cycles per pixel.
pub fn pinhole_transfer(diameter_px: f64, frequency: f64) -> f64 {
    let phase = PI * diameter_px * frequency;
    if phase < 1e-6 {
        1.0
    } else {
        2.0 * libm::j1(phase) / phase
    }
}

/// The inverse of [`pinhole_transfer`], 0 where the frequency is lost.
pub fn pinhole_inverse(diameter_px: f64, frequency: f64) -> f64 {
    let transfer = pinhole_transfer(diameter_px, frequency);
    if transfer.abs() < MIN_TRANSFER {
        0.0
    } else {
        1.0 / transfer
    }
}

/// A capture without the blur of its pinhole.
#[derive(Debug, Clone, PartialEq)]
pub struct SharpenedCapture {
    /// The light, negative where noise made it so.
    pub image: Image,
    /// Variance of the noise of the capture over its light, in the units of the image.
    pub noise_per_light: f64,
    /// Largest diameter in pixels of a pinhole's image that loses no detail of this PSF.
    pub max_pinhole_px: f64,
}

/// `light` without the blur of a pinhole whose image is `diameter_px` wide; 0: as it is.
pub fn without_pinhole(light: &Image, diameter_px: f64) -> SharpenedCapture {
    let transform = PaddedFft::new(light.rows(), light.columns());
    let spectrum = CaptureSpectrum::new(&transform, light.data(), None);
    // The spectrum is that of the capture, which has passed the pinhole.
    let gain = |f: f64| spectrum.light_part(f, 1.0) * pinhole_inverse(diameter_px, f);
    let image = if diameter_px > 0.0 {
        let values = transform.filtered(light.data(), gain);
        Image::new(light.rows(), light.columns(), values).expect("the size of the light")
    } else {
        light.clone()
    };
    SharpenedCapture {
        image,
        noise_per_light: spectrum.noise_per_light(),
        max_pinhole_px: FIRST_ZERO / spectrum.cut_off(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    /// `image` convolved with a disc in space: samples of a fine grid, by shifts of the finely sampled image.
    fn through_disc(fine: &Image, factor: usize, radius: f64) -> Image {
        let reach = radius.ceil() as isize * factor as isize;
        let mut shifts = Vec::new();
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                if (dy as f64).hypot(dx as f64) <= radius * factor as f64 {
                    shifts.push((dy, dx));
                }
            }
        }
        let clamped = |at: isize, length: usize| at.clamp(0, length as isize - 1) as usize;
        Image::from_fn(fine.rows() / factor, fine.columns() / factor, |y, x| {
            let sum: f64 = shifts
                .iter()
                .map(|(dy, dx)| {
                    let y = clamped((y * factor) as isize + dy, fine.rows());
                    let x = clamped((x * factor) as isize + dx, fine.columns());
                    f64::from(fine.at(y, x))
                })
                .sum();
            (sum / shifts.len() as f64) as f32
        })
    }

    fn distance(a: &Image, b: &Image) -> f64 {
        let pairs = a.data().iter().zip(b.data());
        let square: f64 = pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum();
        let size: f64 = b.data().iter().map(|b| f64::from(*b).powi(2)).sum();
        (square / size).sqrt()
    }

    /// Speckle at an eighth of a pixel, and each eighth value of it.
    fn speckle() -> (Image, Image) {
        let optics = SpeckleOptics {
            pixel_pitch_um: SpeckleOptics::demo().pixel_pitch_um / 8.0,
            ..SpeckleOptics::demo()
        };
        let fine = speckle_psf(&optics, 8 * 96, 8 * 96, 3)
            .unwrap()
            .image()
            .clone();
        let coarse = Image::from_fn(96, 96, |y, x| fine.at(8 * y, 8 * x));
        (fine, coarse)
    }

    /// A pinhole of 2 px makes a PSF wrong by more than a tenth; without its blur less than a fifth of that is left, and with
    /// noise less than 0.6 of the error.
    #[test]
    fn removes_the_blur_of_a_pinhole() {
        let (fine, truth) = speckle();
        let capture = through_disc(&fine, 8, 1.0);
        let blurred = distance(&capture, &truth);
        let sharp = without_pinhole(&capture, 2.0);
        let left = distance(&sharp.image, &truth);
        assert!(blurred > 0.1 && left < 0.2 * blurred, "{blurred} {left}");
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        let mean = capture.data().iter().map(|p| f64::from(*p)).sum::<f64>() / 96f64.powi(2);
        let unit = 100.0 / mean;
        let mut noisy = capture.clone();
        for p in noisy.data_mut() {
            let electrons = unit * f64::from(*p);
            let noise: f64 = StandardNormal.sample(&mut rng);
            *p = ((electrons + electrons.sqrt() * noise) / unit) as f32;
        }
        let sharp = without_pinhole(&noisy, 2.0);
        let left = distance(&sharp.image, &truth);
        assert!(left < 0.6 * distance(&noisy, &truth), "{left}");
        let ratio = sharp.noise_per_light * unit;
        assert!((0.8..1.2).contains(&ratio), "{ratio}");
    }

    /// The transfer function is that of a disc: its moments, and its first zero.
    #[test]
    fn transfer_is_that_of_a_disc() {
        // The variance along an axis is d²/16.
        let f = 1e-3;
        let expected = 1.0 - 2.0 * (PI * f).powi(2) * 9.0 / 16.0;
        assert!((pinhole_transfer(3.0, f) - expected).abs() < 1e-9);
        assert!(pinhole_transfer(3.0, FIRST_ZERO / 3.0).abs() < 1e-4);
        assert_eq!(pinhole_transfer(0.0, 0.3), 1.0);
        assert_eq!(pinhole_inverse(3.0, FIRST_ZERO / 3.0), 0.0);
    }
}
