//! A PSF as a function of how its capture differs from it.
//!
//! ```text
//! p = N[max(0, P_blurred(M⁻¹ d) − floor·⟨P⟩)],   M = R(rotation) (1 + [[scale + anisotropy, shear], [shear, scale − anisotropy]])
//! ```
//!
//! `P` is the captured PSF, `d` a displacement and `N` scales to a sum of 1. The blur is a Gaussian whose variance may
//! be negative: the capture is then sharpened. Values between pixels are those of the quintic spline through the PSF
//! at half pixels, found by Fourier transform (Unser, IEEE Signal Proc. Mag. 16(6), 22, 1999). Beyond the capture it
//! continues as its mirror image.

use super::parameters::{ModelParameter, Parameters};
use rayon::prelude::*;
use rowburst_core::fft::{Fft2, smooth_length};
use rowburst_optics::{Image, Psf};
use rustfft::num_complex::Complex32;
use std::f64::consts::{PI, TAU};

/// Pixels of the mirror image on each side of the capture; larger admits larger corrections.
const BORDER: usize = 16;
/// Grid points of the spline for each pixel; larger is more exact and takes more memory.
const UPSAMPLING: usize = 2;
/// Largest amplification of a frequency by a negative blur, as a logarithm; larger amplifies noise.
const MAX_SHARPENING: f64 = 2.0;

/// Largest floor over the brightest value; larger leaves no light.
const MAX_FLOOR: f64 = 0.5;

/// A captured PSF, and what it becomes with other parameters.
pub(super) struct PsfModel {
    capture: Psf,
    /// Side of the square that is transformed.
    side: usize,
    /// Spectrum of the capture with its mirror image.
    spectrum: Vec<Complex32>,
    /// Spline coefficients for the last blur.
    spline: Option<Spline>,
}

/// Coefficients of a quintic spline on a periodic square grid.
struct Spline {
    blur: f64,
    side: usize,
    coefficients: Vec<f32>,
}

impl PsfModel {
    pub fn new(capture: &Psf) -> Self {
        let image = capture.image();
        let side = smooth_length(image.rows().max(image.columns()) + 2 * BORDER);
        let mut spectrum = vec![Complex32::default(); side * side];
        for (y, line) in spectrum.chunks_exact_mut(side).enumerate() {
            for (x, value) in line.iter_mut().enumerate() {
                for (row, row_weight) in continued(y, image.rows(), side) {
                    for (column, weight) in continued(x, image.columns(), side) {
                        value.re += (row_weight * weight) as f32 * image.at(row, column);
                    }
                }
            }
        }
        Fft2::new(side).forward(&mut spectrum);
        Self {
            capture: capture.clone(),
            side,
            spectrum,
            spline: None,
        }
    }

    /// The PSF with `parameters`.
    pub fn psf(&mut self, parameters: &Parameters) -> Psf {
        let capture = self.capture.clone();
        let image = capture.image();
        let mean = 1.0 / image.data().len() as f64;
        let largest = MAX_FLOOR * f64::from(image.max());
        let floor = (parameters[ModelParameter::Floor] * mean).min(largest);
        let mut values = if parameters.moves_psf() {
            self.warped(parameters)
        } else {
            image.data().to_vec()
        };
        for value in &mut values {
            *value = (f64::from(*value) - floor).max(0.0) as f32;
        }
        let image = Image::new(image.rows(), image.columns(), values);
        Psf::new(image.expect("the size of the capture")).expect("light above the floor")
    }

    /// The capture after blur and distortion.
    fn warped(&mut self, parameters: &Parameters) -> Vec<f32> {
        let blur = parameters[ModelParameter::Blur];
        if self.spline.as_ref().is_none_or(|s| s.blur != blur) {
            self.spline = Some(self.spline_of(blur));
        }
        let spline = self.spline.as_ref().expect("set above");
        let (rows, columns) = (self.capture.image().rows(), self.capture.image().columns());
        let (centre_y, centre_x) = ((rows / 2) as f64, (columns / 2) as f64);
        let inverse = inverse(distortion(parameters));
        let mut values = vec![0.0; rows * columns];
        let lines = values.par_chunks_exact_mut(columns).enumerate();
        lines.for_each(|(y, line)| {
            let dy = y as f64 - centre_y;
            for (x, value) in line.iter_mut().enumerate() {
                let dx = x as f64 - centre_x;
                let from_y = inverse[0][0] * dy + inverse[0][1] * dx + centre_y;
                let from_x = inverse[1][0] * dy + inverse[1][1] * dx + centre_x;
                *value = spline.at(from_y * UPSAMPLING as f64, from_x * UPSAMPLING as f64);
            }
        });
        values
    }

    fn spline_of(&self, blur: f64) -> Spline {
        let (small, side) = (self.side, UPSAMPLING * self.side);
        let mut coefficients = vec![Complex32::default(); side * side];
        // Both transforms transpose, and all factors are symmetric in the two frequencies.
        let position = |k: usize| if 2 * k < small { k } else { k + side - small };
        let frequency = |k: usize| {
            let signed = if 2 * k < small {
                k as f64
            } else {
                k as f64 - small as f64
            };
            signed / small as f64
        };
        let gain = 1.0 / (small * small) as f64;
        for k in 0..small {
            for l in 0..small {
                let (f, g) = (frequency(k), frequency(l));
                let exponent = (-2.0 * PI * PI * blur * (f * f + g * g)).min(MAX_SHARPENING);
                let basis =
                    spline_spectrum(f / UPSAMPLING as f64) * spline_spectrum(g / UPSAMPLING as f64);
                let factor = (gain * exponent.exp() / basis) as f32;
                coefficients[position(k) * side + position(l)] =
                    self.spectrum[k * small + l] * factor;
            }
        }
        Fft2::new(side).inverse(&mut coefficients);
        Spline {
            blur,
            side,
            coefficients: coefficients.iter().map(|c| c.re).collect(),
        }
    }
}

impl Spline {
    /// The value at `(y, x)` in grid points.
    fn at(&self, y: f64, x: f64) -> f32 {
        let (first_y, weights_y) = taps(y);
        let (first_x, weights_x) = taps(x);
        let wrap =
            |first: isize, k: usize| (first + k as isize).rem_euclid(self.side as isize) as usize;
        let columns: [usize; 6] = std::array::from_fn(|k| wrap(first_x, k));
        let mut sum = 0.0;
        for (k, weight) in weights_y.iter().enumerate() {
            let line = &self.coefficients[wrap(first_y, k) * self.side..][..self.side];
            let values = columns.iter().zip(&weights_x);
            sum += weight * values.map(|(&x, w)| w * line[x]).sum::<f32>();
        }
        sum
    }
}

/// The first grid point of the six that a value at `position` depends on, and their weights.
fn taps(position: f64) -> (isize, [f32; 6]) {
    let first = position.floor() - 2.0;
    let weights = std::array::from_fn(|k| quintic_b_spline(position - first - k as f64) as f32);
    (first as isize, weights)
}

/// The central B-spline of degree five.
fn quintic_b_spline(x: f64) -> f64 {
    let x = x.abs();
    if x < 1.0 {
        11.0 / 20.0 - x.powi(2) / 2.0 + x.powi(4) / 4.0 - x.powi(5) / 12.0
    } else if x < 2.0 {
        17.0 / 40.0 + 5.0 * x / 8.0 - 7.0 * x.powi(2) / 4.0 + 5.0 * x.powi(3) / 4.0
            - 3.0 * x.powi(4) / 8.0
            + x.powi(5) / 24.0
    } else {
        (3.0 - x).max(0.0).powi(5) / 120.0
    }
}

/// Spectrum of the quintic B-spline at the grid points, at `frequency` cycles per grid point.
fn spline_spectrum(frequency: f64) -> f64 {
    let angle = TAU * frequency;
    (66.0 + 52.0 * angle.cos() + 2.0 * (2.0 * angle).cos()) / 120.0
}

/// `M` on displacements `(dy, dx)`.
fn distortion(parameters: &Parameters) -> [[f64; 2]; 2] {
    let [scale, anisotropy, shear] = [
        ModelParameter::Scale,
        ModelParameter::Anisotropy,
        ModelParameter::Shear,
    ]
    .map(|p| parameters[p]);
    let (sin, cos) = parameters[ModelParameter::Rotation].to_radians().sin_cos();
    let (a, b) = (1.0 + scale + anisotropy, 1.0 + scale - anisotropy);
    [
        [cos * a + sin * shear, cos * shear + sin * b],
        [-sin * a + cos * shear, -sin * shear + cos * b],
    ]
}

fn inverse(m: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let determinant = m[0][0] * m[1][1] - m[0][1] * m[1][0];
    [
        [m[1][1] / determinant, -m[0][1] / determinant],
        [-m[1][0] / determinant, m[0][0] / determinant],
    ]
}

/// Pixels of an image of `length` that make up position `at` of a ring of `side`, with their weights: the image, and
/// between its ends a cross-fade of its mirror images.
fn continued(at: usize, length: usize, side: usize) -> [(usize, f64); 2] {
    let Some(beyond) = at.checked_sub(length) else {
        return [(at, 1.0), (at, 0.0)];
    };
    let phase = PI * (beyond as f64 + 0.5) / (side - length) as f64;
    let weight = (1.0 - phase.cos()) / 2.0;
    let (after_end, before_start) = (length.saturating_sub(1 + beyond), side - 1 - at);
    [
        (after_end, 1.0 - weight),
        (before_start.min(length - 1), weight),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A Gaussian of these variances along two axes, the first turned from y towards x.
    fn gaussian(variances: (f64, f64), degrees: f64) -> Psf {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let value = |y: usize, x: usize| {
            let (dy, dx) = (y as f64 - 20.0, x as f64 - 25.0);
            let (a, b) = (cos * dy + sin * dx, cos * dx - sin * dy);
            (-0.5 * (a * a / variances.0 + b * b / variances.1)).exp() as f32
        };
        Psf::new(Image::from_fn(41, 51, value)).unwrap()
    }

    fn with(pairs: &[(ModelParameter, f64)]) -> Parameters {
        let mut parameters = Parameters::default();
        pairs.iter().for_each(|(p, value)| parameters[*p] = *value);
        parameters
    }

    /// Each parameter against the formula for Gaussians.
    #[test]
    fn moves_gaussians_as_their_formula() {
        let cases = [
            (
                with(&[(ModelParameter::Blur, 1e-12)]),
                gaussian((9.0, 4.0), 0.0),
            ),
            (
                with(&[(ModelParameter::Scale, 0.05)]),
                gaussian((9.9225, 4.41), 0.0),
            ),
            (
                with(&[(ModelParameter::Anisotropy, 0.05)]),
                gaussian((9.9225, 3.61), 0.0),
            ),
            (
                with(&[(ModelParameter::Blur, 0.5)]),
                gaussian((9.5, 4.5), 0.0),
            ),
            (
                with(&[(ModelParameter::Blur, -0.5)]),
                gaussian((8.5, 3.5), 0.0),
            ),
            (
                with(&[(ModelParameter::Rotation, 3.0)]),
                gaussian((9.0, 4.0), -3.0),
            ),
            (
                with(&[
                    (ModelParameter::Rotation, 3.0),
                    (ModelParameter::Scale, 0.05),
                ]),
                gaussian((9.9225, 4.41), -3.0),
            ),
        ];
        let capture = gaussian((9.0, 4.0), 0.0);
        let mut model = PsfModel::new(&capture);
        for (parameters, expected) in cases {
            let found = model.psf(&parameters);
            let limit = 2e-4 * expected.image().max();
            for (found, expected) in found.image().data().iter().zip(expected.image().data()) {
                assert!(
                    (found - expected).abs() < limit,
                    "{parameters:?}: {found} {expected}"
                );
            }
        }
    }

    /// A floor is even light under the capture, in units of its mean.
    #[test]
    fn takes_a_floor_away() {
        let expected = gaussian((9.0, 4.0), 0.0);
        let floor = 0.25 / (41.0 * 51.0) as f32;
        let mut image = expected.image().clone();
        image.data_mut().iter_mut().for_each(|p| *p += floor);
        let mut model = PsfModel::new(&Psf::new(image).unwrap());
        // The floor holds a fifth of the light.
        let found = model.psf(&with(&[(ModelParameter::Floor, 0.2)]));
        for (found, expected) in found.image().data().iter().zip(expected.image().data()) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
    }
}
