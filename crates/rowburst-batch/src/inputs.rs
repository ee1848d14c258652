//! What a batch is to do.

use crate::identity::hash_psfs;
use rowburst::Result;
use rowburst::measurement::{Corrections, Measurement};
use rowburst::reconstruct::{ALGORITHM_REVISION, Model, Options};
use rowburst_io::hash_image;
use rowburst_io::{Capture, Frames};
use rowburst_run::{Bias, check_frame, correct_capture};
use std::collections::BTreeMap;
use std::time::Duration;

/// Experiment, recording and recipe: values, wherever they come from.
pub struct BatchInputs {
    /// Camera and PSF.
    pub model: Model,
    /// Dark, flat and bad pixels. The level of saturation is that of each frame's file.
    pub corrections: Corrections,
    /// How to reconstruct. Where its prior is left open one is chosen for the whole recording.
    pub options: Options,
    /// For each frame. Frames are then done one after another, each from the end of the last one:
    /// a preview, whose videos depend on how fast the machine is.
    pub budget: Option<Duration>,
    /// The recording.
    pub frames: Box<dyn Frames>,
    /// From the start of a frame to that of the next, where it is known.
    pub frame_period_us: Option<f64>,
    /// Version of the program: another may give other numbers.
    pub version: String,
}

impl BatchInputs {
    /// The measurement that a frame is.
    ///
    /// # Errors
    /// Those of [`check_frame`] and [`correct_capture`].
    pub fn measurement(&self, capture: &Capture) -> Result<Measurement> {
        let camera = self.model.camera();
        check_frame(capture, camera, self.model.psfs())?;
        correct_capture(capture, Bias::Contained, camera, &self.corrections)
    }

    /// All that decides what the videos are, by name; long ones as hashes.
    pub(crate) fn identity(&self) -> BTreeMap<String, String> {
        let camera = self.model.camera();
        let params = camera.params();
        let image = |image: &Option<_>| image.as_ref().map_or("none".into(), hash_image);
        let options = &self.options;
        let or_auto = |value: Option<String>| value.unwrap_or("auto".into());
        let parts = [
            ("program version", self.version.clone()),
            ("numbers of the algorithm", ALGORITHM_REVISION.to_string()),
            ("rows", params.rows.to_string()),
            ("columns", params.columns.to_string()),
            ("shutter", format!("{:?}", params.shutter)),
            ("row_time_us", params.row_time_us.to_string()),
            ("exposure_us", params.exposure_us.to_string()),
            ("bins_per_row", params.bins_per_row.to_string()),
            ("field", format!("{:?}", camera.field())),
            ("sensor", format!("{:?}", params.sensor)),
            ("PSF", hash_psfs(self.model.psfs())),
            ("dark", image(&self.corrections.dark)),
            ("flat", image(&self.corrections.flat)),
            ("bad pixels", image(&self.corrections.bad_pixels)),
            ("prior", or_auto(options.prior.map(|p| p.to_string()))),
            ("tau", format!("{:?}", options.tau)),
            (
                "noise sigma",
                or_auto(options.noise_sigma.map(|s| s.to_string())),
            ),
            ("self-calibration", options.self_calibration.to_string()),
            ("keep all pixels", options.keep_all_pixels.to_string()),
            (
                "most iterations",
                or_auto(options.max_iterations.map(|n| n.to_string())),
            ),
            (
                "time budget",
                self.budget
                    .map_or("none".into(), |b| format!("{} s", b.as_secs_f64())),
            ),
            ("number of frames", self.frames.count().to_string()),
        ];
        let tuning = options.tuning.changes().into_iter();
        let tuning = tuning.map(|(name, value)| (format!("tuning {name}"), value.to_string()));
        let parts = parts.into_iter().map(|(k, v)| (k.to_string(), v));
        parts.chain(tuning).collect()
    }
}
