//! Opens a source by its name.

use crate::play::Playback;
use crate::source::Source;
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Result};

/// A kind of camera that a program was built with.
#[derive(Debug, Clone, Copy)]
pub struct Driver {
    /// What stands before the colon of its sources, such as `genicam`.
    pub scheme: &'static str,
    /// Opens the source of what stands behind the colon.
    pub open: fn(&str) -> Result<Box<dyn Source>>,
    /// Looks for cameras; name and description of each source.
    pub list: fn() -> Result<Vec<(String, String)>>,
}

/// Schemes of drivers that a program may be built without, and how it is built with them.
const OPTIONAL: [(&str, &str); 1] = [(
    "genicam",
    "Build it with them: cargo install --locked rowburst-cli --features genicam (Python: maturin build --features genicam). \
     Or read the camera from Python (rowburst.capture.from_arrays).",
)];

/// Opens a source by its name: `play:PATH` plays a recording, see [`Playback::open`]; others by `drivers`.
///
/// # Errors
/// A kind of source that does not exist or that the program was built without, and those of the source.
pub fn open_source(name: &str, drivers: &[Driver]) -> Result<Box<dyn Source>> {
    let (scheme, rest) = name.split_once(':').unwrap_or((name, ""));
    if scheme == "play" && name.contains(':') {
        return Ok(Box::new(Playback::open(rest)?));
    }
    if let Some(driver) = drivers.iter().find(|driver| driver.scheme == scheme) {
        return (driver.open)(rest);
    }
    let unknown = |rule: &'static str, remedy: &'static str| {
        let found = format!("\"{name}\"");
        let error = Error::input(Subject::named("the source"), found, rule, remedy);
        error.with_kind(ErrorKind::Unknown)
    };
    if let Some((_, remedy)) = OPTIONAL.iter().find(|(known, _)| *known == scheme) {
        return Err(unknown(
            "this program was built without such cameras",
            remedy,
        ));
    }
    Err(unknown(
        "a source is play:PATH, a recording that is played back, or genicam:ADDRESS, a camera on the network",
        "Record with the camera's own program and play its file back, or read the camera from Python \
         (rowburst.capture.from_mmcore).",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_without_a_driver_says_so() {
        let error = open_source("genicam:192.168.1.20", &[]).err().unwrap();
        assert!(error.to_string().contains("--features genicam"), "{error}");
        let error = open_source("camera:0", &[]).err().unwrap();
        assert!(error.to_string().contains("play:PATH"), "{error}");
    }
}
