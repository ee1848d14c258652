//! A frame and its corrections, from arrays.

use crate::array::{is_array, masked_capture, masked_image, with_masked};
use crate::error::to_py_err;
use pyo3::prelude::*;
use rowburst::measurement::{Corrections, Measurement};
use rowburst::{Error, Image, Parameter};
use rowburst_io::SampleFormat;
use rowburst_run::{Bias, Frame, Setup, bias_of_array};

/// Dark, flat and bad pixels. Masked pixels of each are bad pixels.
pub fn corrections_of(
    dark: Option<&Bound<'_, PyAny>>,
    flat: Option<&Bound<'_, PyAny>>,
    bad_pixels: Option<&Bound<'_, PyAny>>,
) -> PyResult<Corrections> {
    let mut masked = None;
    let mut read = |value: Option<&Bound<'_, PyAny>>, name: &str| -> PyResult<Option<Image>> {
        let Some(value) = value else { return Ok(None) };
        let (image, mask) = masked_image(value, name)?;
        masked = with_masked(masked.take(), mask);
        Ok(Some(image))
    };
    let dark = read(dark, "dark")?;
    let flat = read(flat, "flat")?;
    let bad_pixels = read(bad_pixels, "bad_pixels")?;
    Ok(Corrections {
        dark,
        flat,
        bad_pixels: with_masked(bad_pixels, masked),
        saturation_counts: None,
    })
}

/// A frame, corrected.
pub fn measured(frame: &Bound<'_, PyAny>, setup: Setup) -> PyResult<Measurement> {
    let (frame, setup) = frame_of(frame, setup, None)?;
    setup.measurement(&frame).map_err(to_py_err)
}

/// A frame with its `bias`. `None`: a file or an array of integers is a raw capture, and from an array of floating-point
/// numbers the bias has been subtracted. The masked pixels of a masked array are bad pixels of the set-up.
pub fn frame_of(
    frame: &Bound<'_, PyAny>,
    mut setup: Setup,
    bias: Option<Bias>,
) -> PyResult<(Frame, Setup)> {
    let (capture, mask) = masked_capture(frame, "frame")?;
    if capture.format == (SampleFormat::Counts { bits: 1 }) {
        return Err(to_py_err(Error::input(
            Parameter::Frame,
            "an array of bool",
            "a frame holds counts or floating-point numbers, and two values are no capture",
            "Give the counts as the camera recorded them.",
        )));
    }
    setup.corrections.bad_pixels = with_masked(setup.corrections.bad_pixels, mask);
    let bias = bias.unwrap_or_else(|| {
        if is_array(frame) {
            bias_of_array(capture.format)
        } else {
            Bias::Contained
        }
    });
    let frame = Frame {
        capture,
        bias,
        file: None,
    };
    Ok((frame, setup))
}
