//! The record of a recording: `NAME.json` beside `NAME.tif`.

use crate::settings::{Fingerprint, Settings};
use rowburst_io::CAPTURE_KIND;
use serde::{Deserialize, Serialize};

/// A page of the recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Page of the file, from 0.
    pub page: usize,
    /// Number of the frame as the source counts.
    pub number: u64,
    /// Time in microseconds on the clock of the source.
    pub time_us: Option<u64>,
    /// What is wrong with the frame; absent where it is whole.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub incomplete: Option<String>,
    /// Part of its pixels that are saturated.
    pub saturated_fraction: f64,
    /// Mean count; absent in records before 0.2.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mean_counts: Option<f64>,
}

/// Frames that are not in the file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Lost {
    /// Number of the first one.
    pub first: u64,
    /// Number of the last one.
    pub last: u64,
    /// Why.
    pub reason: String,
}

/// Everything that is known of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CaptureRecord {
    /// [`CAPTURE_KIND`].
    pub kind: String,
    /// Version of the program.
    pub version: String,
    /// What the frames are: `frame`, `darks`, `flats`, `psf`, `timing` or `record`.
    pub purpose: String,
    /// The file of the frames.
    pub file: String,
    /// Rows and columns of every frame.
    pub size: Option<(usize, usize)>,
    /// Settings of the camera at the start.
    pub settings: Settings,
    /// What tells whether captures belong together.
    pub fingerprint: Fingerprint,
    /// Frames that were asked for; `None`: until the end.
    pub requested: Option<usize>,
    /// Frames in the file.
    pub written: usize,
    /// Frames that never arrived or could not be written.
    pub dropped: u64,
    /// Frames that arrived in part.
    pub incomplete: u64,
    /// Why the recording ended: `complete`, `end of the source`, `interrupted`, or an error.
    pub ended: String,
    /// Warnings, with remedies.
    pub warnings: Vec<String>,
    /// Pages of the file.
    pub frames: Vec<FrameRecord>,
    /// Frames that are not in it.
    pub lost: Vec<Lost>,
    /// Time of the recording's start, in seconds since 1970.
    pub started_unix_s: u64,
}

impl CaptureRecord {
    /// The record of an empty recording.
    pub(crate) fn new(purpose: &str, file: String, settings: Settings) -> Self {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        Self {
            kind: CAPTURE_KIND.into(),
            version: env!("CARGO_PKG_VERSION").into(),
            purpose: purpose.into(),
            file,
            size: None,
            fingerprint: settings.fingerprint(),
            settings,
            requested: None,
            written: 0,
            dropped: 0,
            incomplete: 0,
            ended: String::new(),
            warnings: Vec::new(),
            frames: Vec::new(),
            lost: Vec::new(),
            started_unix_s: now.map_or(0, |time| time.as_secs()),
        }
    }

    /// The largest part of a frame's pixels that are saturated.
    pub fn worst_saturation(&self) -> f64 {
        let parts = self.frames.iter().map(|f| f.saturated_fraction);
        parts.fold(0.0, f64::max)
    }
}
