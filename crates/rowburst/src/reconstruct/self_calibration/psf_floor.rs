//! The even light under a captured PSF that the capture itself shows.
//!
//! Light that a diffuser has bent is speckled or gathers in caustics. Where a capture is darkest and shows noise alone, no
//! such light falls: what it has there is the black level of its camera, and lies under all of the PSF. Taken for light
//! it spreads every place of the scene over the whole sensor. A sparse video then does not explain the frame. A dense
//! one does, and is wrong (docs/design/026).

use super::parameters::ModelParameter;
use super::{Calibration, FoundParameter};
use rowburst_calibrate::psf::{even_floor, noise_of};
use rowburst_optics::{Image, PatchSet, Psf, PsfCapture};

/// Floor over the mean of the PSF above which it is taken away: less may be light that lenses scatter.
const MIN_FLOOR: f64 = 0.1;
/// Relative difference up to which two values of single precision are the same.
const SAME_VALUE: f64 = 1e-5;

impl Calibration {
    /// The PSF without its floor, for frames of so many pixels; `None`: it shows none, or there are several PSFs.
    pub(in crate::reconstruct) fn of_psf_floor(psfs: &PatchSet, pixels: usize) -> Option<Self> {
        let [psf] = psfs.psfs() else {
            return None;
        };
        let floor = shown_floor(psf).filter(|floor| floor.value > MIN_FLOOR)?;
        Some(Self {
            psfs: PatchSet::from(&without(psf, floor.value)?),
            parameters: vec![floor],
            row_offsets: Vec::new(),
            psf_refinement: None,
            gain: vec![1.0; pixels],
            offset: vec![0.0; pixels],
            held_out: None,
            residual_before: None,
        })
    }

    /// The correction `next`, which was found with this floor taken away, together with the floor.
    #[must_use]
    pub(in crate::reconstruct) fn followed_by(&self, mut next: Self) -> Self {
        for first in &self.parameters {
            let mut found = next.parameters.iter_mut();
            match found.find(|p| p.parameter == first.parameter) {
                // The second floor counts in means of the PSF without the first.
                Some(second) => {
                    let rest = 1.0 - first.value;
                    second.value = first.value + rest * second.value;
                    second.standard_error =
                        first.standard_error.hypot(rest * second.standard_error);
                }
                None => next.parameters.push(*first),
            }
        }
        next
    }
}

/// The PSF without a floor, which is over its mean; `None`: nothing is left.
fn without(psf: &Psf, floor: f64) -> Option<Psf> {
    let image = psf.image();
    let level = (floor / image.data().len() as f64) as f32;
    let values = image.data().iter().map(|p| (p - level).max(0.0)).collect();
    let image = Image::new(image.rows(), image.columns(), values).ok()?;
    let capture = psf.capture().map(|capture| PsfCapture {
        noise_per_light: capture.noise_per_light / (1.0 - floor),
        ..capture
    });
    Psf::new(image).ok().map(|psf| psf.with_capture(capture))
}

/// The floor of a PSF over its mean; `None` where no part of it is unlit.
fn shown_floor(psf: &Psf) -> Option<FoundParameter> {
    let image = psf.image();
    let mean = 1.0 / image.data().len() as f64;
    even_floor(image).map(|level| {
        // The noise of a pixel, and that of rounding to the steps of the capture.
        let values = image.data().iter().map(|p| f64::from(*p));
        let brighter = values.filter(|p| *p > (1.0 + SAME_VALUE) * level);
        let step = brighter.fold(f64::INFINITY, f64::min) - level;
        let rounding = step / 12_f64.sqrt();
        FoundParameter {
            parameter: ModelParameter::Floor,
            value: level / mean,
            standard_error: noise_of(image).hypot(rounding) / mean,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_pcg::Pcg64;
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    /// Speckle in a disc, in counts of a camera of 8 bits.
    fn capture(black_level: f32) -> Psf {
        let speckle = speckle_psf(&SpeckleOptics::demo(), 120, 140, 3).unwrap();
        let brightest = speckle.image().max();
        let image = Image::from_fn(120, 140, |y, x| {
            let radius = (y as f32 - 60.0).hypot(x as f32 - 70.0);
            let light = if radius < 50.0 {
                255.0 * speckle.image().at(y, x) / brightest
            } else {
                0.0
            };
            light.round() + black_level
        });
        Psf::new(image).unwrap()
    }

    #[test]
    fn an_even_floor_is_found_in_the_dark_part_of_a_capture() {
        let (with, without) = (capture(6.0), capture(0.0));
        let found = Calibration::of_psf_floor(&PatchSet::from(&with), 1).unwrap();
        let error = found.psfs.central().image().data().iter();
        let error = error
            .zip(without.image().data())
            .map(|(a, b)| (a - b).abs());
        assert!(error.fold(0.0, f32::max) < 1e-3 * without.image().max());
    }

    #[test]
    fn a_psf_without_a_floor_stays() {
        let uncorrected = |psf: &Psf| Calibration::of_psf_floor(&PatchSet::from(psf), 1).is_none();
        assert!(uncorrected(&capture(0.0)));
        // Speckle that fills the image has dark places, but no unlit ones.
        let speckle = speckle_psf(&SpeckleOptics::demo(), 120, 140, 3).unwrap();
        let lifted = Image::from_fn(120, 140, |y, x| {
            speckle.image().at(y, x) + 0.2 / (120.0 * 140.0)
        });
        assert!(uncorrected(&Psf::new(lifted).unwrap()));
    }

    /// Light that falls off towards the edges is no floor, though its darkest part shows noise alone.
    #[test]
    fn a_smooth_halo_stays() {
        let core = capture(0.0);
        let noise = StandardNormal.sample_iter(Pcg64::seed_from_u64(1));
        let noise: Vec<f32> = noise.take(120 * 140).collect();
        let image = Image::from_fn(120, 140, |y, x| {
            let radius = (y as f32 - 60.0).hypot(x as f32 - 70.0);
            let halo = (-0.5 * (radius / 45.0).powi(2)).exp();
            (core.image().at(y, x) * 120.0 * 140.0 + 2.0 * halo + 0.01 * noise[y * 140 + x])
                .max(0.0)
        });
        let psf = Psf::new(image).unwrap();
        assert!(Calibration::of_psf_floor(&PatchSet::from(&psf), 1).is_none());
    }

    #[test]
    fn a_second_floor_counts_from_the_first() {
        let floor = |value| FoundParameter {
            parameter: ModelParameter::Floor,
            value,
            standard_error: 0.01,
        };
        let mut first = Calibration::of_psf_floor(&PatchSet::from(&capture(6.0)), 1).unwrap();
        first.parameters = vec![floor(0.5)];
        let mut next = first.clone();
        next.parameters = vec![floor(0.2)];
        let together = first.followed_by(next.clone());
        assert!((together.parameters[0].value - 0.6).abs() < 1e-12);
        next.parameters.clear();
        assert_eq!(first.followed_by(next).parameters, [floor(0.5)]);
    }
}
