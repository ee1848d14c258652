//! The task of reconstructing one frame.

use crate::guide::GuideTask;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::Options;
use rowburst::{Camera, Cancel, Image, PatchSet, Video};
use rowburst_io::FromMetadata;
use std::path::PathBuf;
use std::time::Duration;

/// A frame with all inputs of its reconstruction, as values.
pub struct Task {
    /// The camera.
    pub camera: Camera,
    /// The PSF, or one PSF for each patch of the field.
    pub psfs: PatchSet,
    /// The corrected frame.
    pub measurement: Measurement,
    /// The options of the reconstruction. With a time budget and no prior, the prior is
    /// [`rowburst::Prior::STANDARD`].
    pub options: Options,
    /// Limit of the time for set-up and solver together; `None`: no limit.
    pub budget: Option<Duration>,
    /// The true video, for PSNR and SSIM.
    pub truth: Option<Video>,
    /// The file that `truth` was read from.
    pub truth_file: Option<PathBuf>,
    /// A frame of the scene without the diffuser, for the report.
    pub direct: Option<Image>,
    /// Pictures of the scene by a second camera.
    pub guide: Option<GuideTask>,
    /// Seed of the simulation that made the frame; only reported.
    pub seed: u64,
    /// The values of the camera that came from the metadata of the frame's file.
    pub from_metadata: FromMetadata,
    /// Stops the run, its set-up included.
    pub cancel: Cancel,
}
