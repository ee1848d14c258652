//! Whether the model belongs to the frame at all. No self-calibration mends the PSF of another diffuser, a turned frame or
//! another shutter, and the searches for what is wrong with PSF, camera and pixels would take many times as long as a run.
//!
//! A speckle pattern explains its frame better than its mirror images and itself turned by 180°, which are as fine and as
//! bright but not what the light has passed. A pattern that does not is not the frame's. A shutter is not the frame's where
//! it does not explain the frame and one of another kind does (docs/design/020).

use super::Observer;
use super::fit;
use super::frame_data::FrameData;
use super::held_out_check::HeldOutCheck;
use super::{Model, Prior, Problem, RunResult};
use rowburst_optics::camera::CameraParams;
use rowburst_optics::{Camera, Image, PatchSet, Psf, Shutter};
use rowburst_solve::DataTerm;
use rowburst_solve::admm::{Progress, VideoOfIteration};
use tracing::info;

/// Held-out error over that with a PSF that is not the frame's, above which the PSF itself is not the frame's; smaller gives
/// up PSFs that can be mended.
const MAX_ERROR_RATIO: f64 = 0.88;
/// The same, below which the other images need not be tried; larger may miss that the PSF is not the frame's.
const CLEAR_ERROR_RATIO: f64 = 0.7;
/// The same for the scale of most held-out residuals, below which the PSF is the frame's; larger keeps PSFs of other frames.
/// Foreign pixels raise the error, and hardly this scale.
const CLEAR_SCALE_RATIO: f64 = 0.25;
/// Correlation with its image above which a PSF cannot be told from it.
const MAX_SYMMETRY: f64 = 0.5;
/// Held-out error with a rolling shutter over that with a global one, which has a single bin, below which the frame is of a
/// rolling one; larger takes a PSF that can be mended for that.
const MAX_GLOBAL_RATIO: f64 = 0.1;
/// The images of a PSF that are tried: mirrored along y and along x.
const IMAGES: [(bool, bool); 3] = [(true, true), (false, true), (true, false)];

impl Problem {
    /// Whether the frame is turned by 90° or transposed. It is not looked for where a correction of the model is asked for
    /// by name.
    pub(super) fn has_turned_frame(&self) -> bool {
        let is_turned = !self.options.self_calibration.is_on()
            && fit::is_turned(
                self.data.measurements(),
                self.data.weights(),
                &self.camera,
                &self.bands,
            );
        if is_turned {
            info!("the frame is turned: nothing else is looked for");
        }
        is_turned
    }

    /// Whether the PSF belongs to another frame than this, whose check with `prior` gave `check`. It is not looked for where
    /// a correction of the model is asked for by name.
    pub(super) fn has_foreign_psf(
        &mut self,
        check: &HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        if self.options.self_calibration.is_on() {
            return Ok(false);
        }
        for image in IMAGES {
            let psfs = mirrored(self.data.psfs(), image);
            let central = self.data.psfs().central().image();
            if correlation(central.data(), psfs.central().image().data()) > MAX_SYMMETRY {
                continue;
            }
            let limit = check.held_out_rms / MAX_ERROR_RATIO;
            let camera = self.camera.clone();
            let (_, with_image) = self.check_with(camera, psfs, limit, prior, observer)?;
            let ratio = check.held_out_rms / with_image.held_out_rms;
            let scale_ratio = check.held_out_scale / with_image.held_out_scale;
            info!(
                "held-out error over that with an image of the PSF: {ratio:.3}, of most pixels {scale_ratio:.3}"
            );
            if ratio < CLEAR_ERROR_RATIO || scale_ratio < CLEAR_SCALE_RATIO {
                return Ok(false);
            }
            if ratio > MAX_ERROR_RATIO {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Whether a shutter of another kind explains the frame, which the camera's does not (`check`); it is then kept for the
    /// verdict.
    /// One that reads the rows in reverse order is not of another kind: it reverses time. It is not looked for where a
    /// correction of the model is asked for by name.
    pub(super) fn has_other_shutter(
        &mut self,
        check: &HeldOutCheck,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        if self.options.self_calibration.is_on() {
            return Ok(false);
        }
        // With the wrong shutter a sparse scene looks dense.
        let prior = self.options.prior.unwrap_or(Prior::STANDARD);
        let kinds: &[Shutter] = match self.camera.shutter() {
            Shutter::TopDown | Shutter::BottomUp => &[Shutter::DualInsideOut],
            Shutter::Global => &[Shutter::DualInsideOut, Shutter::TopDown],
            // A single shutter has twice the bins of a dual one, and explains what a PSF that can be mended does not.
            Shutter::DualInsideOut | Shutter::DualOutsideIn | Shutter::Custom(_) => &[],
        };
        // A part of the readout has row times that no shutter gives alone.
        let whole = Camera::new(self.camera.params().clone());
        if !whole.is_ok_and(|whole| whole == self.camera) {
            return Ok(false);
        }
        for shutter in kinds {
            let params = CameraParams {
                shutter: shutter.clone(),
                ..self.camera.params().clone()
            };
            let Ok(camera) = Camera::new(params) else {
                continue;
            };
            let psfs = self.data.psfs().clone();
            let (is_explained, other) = self.check_with(camera, psfs, 0.0, prior, observer)?;
            let ratio = other.held_out_rms / check.held_out_rms;
            info!("another shutter explains the frame: {is_explained}, error ratio {ratio:.3}");
            let is_global = *self.camera.shutter() == Shutter::Global;
            if is_explained && (!is_global || ratio < MAX_GLOBAL_RATIO) {
                self.other_shutter = Some(shutter.clone());
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// The check with another camera or other PSFs, at most until its held-out error is below `error`, and whether they explain
    /// the frame. All else stays as it is.
    fn check_with(
        &mut self,
        mut camera: Camera,
        psfs: PatchSet,
        error: f64,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(bool, HeldOutCheck), Box<RunResult>> {
        // Its video may have another shape: an observer sees none of it, and it is no result.
        let dark = vec![0.0; self.data.video_shape().voxels()];
        let mut observe = |progress: &Progress| {
            observer(&Progress {
                video: VideoOfIteration::Solved(&dark),
                ..*progress
            })
        };
        let model = Model::new(&camera, psfs).with_cancel(self.data.cancel());
        let mut data = FrameData::new(&model, &self.measurement.without(&self.excluded));
        std::mem::swap(&mut self.data, &mut data);
        std::mem::swap(&mut self.camera, &mut camera);
        let is_dense = std::mem::take(&mut self.is_dense);
        let checked = self.held_out_run(error, prior, &mut observe);
        let checked = checked.map(|(check, _)| (self.is_explained(&check), check));
        (self.data, self.camera) = (data, camera);
        self.is_dense = is_dense;
        checked.map_err(|stopped| match self.last_check.take() {
            Some(mut last) => {
                last.solution.stop_reason = stopped.solution.stop_reason;
                last
            }
            None => stopped,
        })
    }
}

/// The PSFs, each mirrored along y and along x where `along` says so.
fn mirrored(psfs: &PatchSet, along: (bool, bool)) -> PatchSet {
    let images = psfs.psfs().iter().map(|psf| {
        Psf::new(mirrored_image(psf.image(), along)).expect("the values of a PSF in another order")
    });
    PatchSet::new(images.collect(), psfs.offsets_px().to_vec()).expect("as many as before")
}

fn mirrored_image(image: &Image, along: (bool, bool)) -> Image {
    let (rows, columns) = (image.rows(), image.columns());
    let at = |i: usize, count: usize, is_mirrored| if is_mirrored { count - 1 - i } else { i };
    Image::from_fn(rows, columns, |y, x| {
        image.at(at(y, rows, along.0), at(x, columns, along.1))
    })
}

/// Correlation of two images of the same size; 1 where one of them is flat.
fn correlation(a: &[f32], b: &[f32]) -> f64 {
    let centred = |values: &[f32]| -> Vec<f64> {
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
        values.iter().map(|&v| f64::from(v) - mean).collect()
    };
    let (a, b) = (centred(a), centred(b));
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let scale = (product(&a, &a) * product(&b, &b)).sqrt();
    if scale > 0.0 {
        product(&a, &b) / scale
    } else {
        1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_mirrored_along_their_axes() {
        let image = Image::new(2, 2, vec![1.0, 2.0, 3.0, 4.0]).unwrap();
        let data = |along| mirrored_image(&image, along).into_data();
        assert_eq!(data((true, false)), [3.0, 4.0, 1.0, 2.0]);
        assert_eq!(data((false, true)), [2.0, 1.0, 4.0, 3.0]);
        assert_eq!(data((true, true)), [4.0, 3.0, 2.0, 1.0]);
    }

    #[test]
    fn a_symmetric_image_is_like_its_mirror_image() {
        let ring = Image::from_fn(5, 5, |y, x| {
            let r = (y as f32 - 2.0).hypot(x as f32 - 2.0);
            (-r).exp()
        });
        for along in IMAGES {
            let mirrored = mirrored_image(&ring, along);
            assert!(correlation(ring.data(), mirrored.data()) > 0.999);
        }
        let slope = Image::from_fn(5, 5, |y, x| (y + x) as f32);
        let turned = mirrored_image(&slope, (true, true));
        assert!((correlation(slope.data(), turned.data()) + 1.0).abs() < 1e-9);
        assert!((correlation(&[1.0; 4], &[1.0, 2.0, 3.0, 4.0]) - 1.0).abs() < 1e-9);
    }
}
