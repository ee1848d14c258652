//! Whether a PSF belongs to its frame: a speckle pattern explains the frame better than itself turned by 180°, which is
//! just as fine and bright but not the pattern that the light has passed. A pattern that does not is that of another
//! diffuser, or turned, and no self-calibration mends it (docs/design/020).

use super::choose::Observer;
use super::frame_data::FrameData;
use super::held_out_check::HeldOutCheck;
use super::{Model, Prior, Problem, RunResult, SelfCalibration};
use rowburst_optics::{Image, PatchSet, Psf};
use tracing::info;

/// Held-out error over that with the PSF turned above which the PSF does not belong to the frame. Without a PSF of its own a
/// frame has 0.92 to 1.04; with one that is 5 % too large, turned by 2° or decorrelated to 0.8 at most 0.82.
const MAX_ERROR_RATIO: f64 = 0.88;
/// Correlation with itself turned above which a PSF cannot be told from it.
const MAX_SYMMETRY: f64 = 0.5;

impl Problem {
    /// Whether the PSF belongs to another frame than this, whose check with `prior` gave `check`. It is not looked for where
    /// the correction is asked for by name.
    pub(super) fn has_foreign_psf(
        &mut self,
        check: &HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        let psfs = self.data.psfs();
        if self.options.self_calibration == SelfCalibration::On
            || symmetry(psfs.central().image()) > MAX_SYMMETRY
        {
            return Ok(false);
        }
        let model = Model::new(&self.camera, turned(psfs)).with_cancel(self.data.cancel());
        let mut data = FrameData::new(&model, &self.measurement.without(&self.excluded));
        std::mem::swap(&mut self.data, &mut data);
        let (is_dense, last_check) = (self.is_dense, self.last_check.take());
        let turned = self.held_out_check(prior, observer);
        self.data = data;
        (self.is_dense, self.last_check) = (is_dense, last_check);
        let turned = turned?;
        let ratio = check.held_out_rms / turned.held_out_rms;
        info!("held-out error over that with the PSF turned by 180°: {ratio:.3}");
        Ok(ratio > MAX_ERROR_RATIO)
    }
}

/// The PSFs, each turned by 180°.
fn turned(psfs: &PatchSet) -> PatchSet {
    let turned = psfs.psfs().iter().map(|psf| {
        Psf::new(turned_image(psf.image())).expect("the values of a PSF in another order")
    });
    PatchSet::new(turned.collect(), psfs.offsets_px().to_vec()).expect("as many as before")
}

fn turned_image(image: &Image) -> Image {
    let (rows, columns) = (image.rows(), image.columns());
    Image::from_fn(rows, columns, |y, x| image.at(rows - 1 - y, columns - 1 - x))
}

/// Correlation of `image` with itself turned by 180°.
fn symmetry(image: &Image) -> f64 {
    let values = image.data();
    let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
    let centred = |v: &f32| f64::from(*v) - mean;
    let pairs = values.iter().zip(values.iter().rev());
    let covariance: f64 = pairs.map(|(a, b)| centred(a) * centred(b)).sum();
    let variance: f64 = values.iter().map(|v| centred(v).powi(2)).sum();
    if variance > 0.0 { covariance / variance } else { 1.0 }
}
