//! A frame of the recording, corrected; a panic is an error of this frame alone.

use crate::inputs::BatchInputs;
use rowburst::error::Subject;
use rowburst::measurement::Measurement;
use rowburst::{Error, Parameter, Result};
use rowburst_io::Capture;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Whether `error` is about a dark, a flat or a mask rather than about a frame.
pub fn is_of_correction(error: &Error) -> bool {
    matches!(
        error.parameter(),
        Some(Parameter::Dark | Parameter::Flat | Parameter::BadPixels)
    )
}

/// Reads and corrects a frame.
pub(crate) fn read_measurement(
    inputs: &BatchInputs,
    frame: usize,
) -> Result<(Capture, Measurement)> {
    catch_panic(|| {
        let capture = inputs.frames.read(frame)?;
        let measurement = inputs.measurement(&capture)?;
        Ok((capture, measurement))
    })
}

/// What `work` returns, or its panic as an error: a frame that breaks the program is one frame
/// lost.
pub(crate) fn catch_panic<T>(work: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or(panic.downcast_ref::<&str>().copied());
        Err(Error::work(
            Subject::named("the program"),
            text.unwrap_or("a panic"),
            "Report this frame.",
        ))
    })
}
