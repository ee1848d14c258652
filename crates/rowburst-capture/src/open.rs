//! Opens a source by its name.

use crate::play::Playback;
use crate::source::Source;
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Result};

/// Opens a source by its name: `play:PATH` plays a recording, see [`Playback::open`].
///
/// # Errors
/// A kind of source that does not exist, and those of the source.
pub fn open_source(name: &str) -> Result<Box<dyn Source>> {
    match name.split_once(':') {
        Some(("play", recording)) => Ok(Box::new(Playback::open(recording)?)),
        _ => Err(Error::input(
            Subject::named("the source"),
            format!("\"{name}\""),
            "a source is play:PATH, a recording that is played back",
            "Record with the camera's own program and play its file back, or read the camera from Python \
             (rowburst.capture.from_mmcore).",
        )
        .with_kind(ErrorKind::Unknown)),
    }
}
