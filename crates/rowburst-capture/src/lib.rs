//! From a camera to files: frames with their settings, recorded whole, judged, and put in a folder that leads through
//! the experiment.
//!
//! ```text
//! play:PATH, a camera ─▶ Source ─▶ Delivery (frame, dropped, incomplete) ─▶ Recorder ─▶ NAME.tif, NAME.json
//!                          └────▶ Settings (properties, origin) ─▶ experiment.toml, findings
//! NAME.json ─▶ Fingerprint ─▶ Project::status
//! ```
//!
//! A [`Source`] gives frames of 16-bit counts, `y` the axis that the shutter scans. A frame that was dropped or is
//! incomplete is a value, not an error. A [`Recorder`] writes beside and renames: a recording is whole or not there.

mod correlation;
mod experiment;
mod exposure;
mod guide;
mod open;
mod play;
mod project;
mod record;
mod recorder;
mod settings;
mod source;

pub use correlation::{CaptureCorrelation, correlation_of_captures};
pub use experiment::experiment_text;
pub use exposure::{Exposure, HISTOGRAM_BINS};
pub use open::{Driver, open_source};
pub use play::Playback;
pub use project::{PROJECT_FILE, Project, Step, StepState, create_project};
pub use record::{CaptureRecord, FrameRecord, Lost};
pub use recorder::{Ended, Recorder, record};
pub use settings::{Fingerprint, Property, Settings};
pub use source::{Control, Delivery, Frame, Source};
