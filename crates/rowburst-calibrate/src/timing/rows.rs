//! From frames to one number per row.

use super::TimingParams;
use rowburst_core::error::Subject;
use rowburst_core::{Error, ErrorKind, Parameter, Result};
use rowburst_optics::Image;

/// Mean of each row of each frame, over the mean of its frame.
pub(super) struct RowSignals {
    /// `[frame][row]`.
    pub frames: Vec<Vec<f64>>,
    /// Mean of each frame in counts, after the correction.
    pub mean_counts: Vec<f64>,
    /// Part of the pixels that are saturated, in the worst row of all frames.
    pub saturated: f64,
}

/// Fewest rows that a fit is made of.
const MIN_ROWS: usize = 16;

/// Takes `dark` away, divides by `flat`, and means over the columns.
pub(super) fn row_signals(frames: &[Image], params: &TimingParams) -> Result<RowSignals> {
    let (rows, columns) = checked_size(frames, params)?;
    let response = response(params, rows, columns)?;
    let mut signals = RowSignals {
        frames: Vec::new(),
        mean_counts: Vec::new(),
        saturated: 0.0,
    };
    for (i, frame) in frames.iter().enumerate() {
        if let Some(end) = params.saturation_counts {
            signals.saturated = signals.saturated.max(saturated_fraction(frame, end));
        }
        let means = row_means(frame, params.dark.as_ref(), response.as_deref());
        if let Some(y) = means.iter().position(|m| m.is_nan()) {
            return Err(Error::input(
                Parameter::Flat,
                format!("no light in row {y}"),
                "every row of the flat is lit",
                "Record the flat under even light.",
            )
            .with_kind(ErrorKind::NoSignal));
        }
        let mean = means.iter().sum::<f64>() / rows as f64;
        if mean.is_nan() || mean <= 0.0 {
            return Err(Error::input(
                frame_subject(i),
                format!("a mean of {mean:.1} counts above the dark"),
                "the light brightens the frame",
                "Check that the lamp lights the sensor and that the dark frame is dark.",
            )
            .with_kind(ErrorKind::NoSignal));
        }
        signals
            .frames
            .push(means.iter().map(|m| m / mean).collect());
        signals.mean_counts.push(mean);
    }
    Ok(signals)
}

/// Frame `i` in messages.
fn frame_subject(i: usize) -> Subject {
    Subject::element(Parameter::Frames, "frame", i)
}

/// Rows and columns of the frames; all images must have this size and finite pixels.
fn checked_size(frames: &[Image], params: &TimingParams) -> Result<(usize, usize)> {
    let Some(first) = frames.first() else {
        return Err(Error::input(
            Parameter::Frames,
            "none",
            "row times are read from at least one frame",
            "Give a frame of the blinking light.",
        )
        .with_kind(ErrorKind::Missing));
    };
    let (rows, columns) = (first.rows(), first.columns());
    if rows < MIN_ROWS {
        return Err(Error::input(
            frame_subject(0),
            format!("{rows} rows"),
            format!("at least {MIN_ROWS} rows are needed"),
            "Read the whole sensor, not a narrow window.",
        ));
    }
    let all = frames
        .iter()
        .enumerate()
        .map(|(i, f)| (frame_subject(i), f));
    let extra = [
        (Parameter::Dark, &params.dark),
        (Parameter::Flat, &params.flat),
    ];
    let extra = extra
        .into_iter()
        .filter_map(|(parameter, image)| Some((parameter.into(), image.as_ref()?)));
    for (subject, image) in all.chain(extra) {
        if (image.rows(), image.columns()) != (rows, columns) {
            return Err(Error::input(
                subject,
                format!("{}×{} pixels", image.rows(), image.columns()),
                format!("all frames have one size, that of frame 1: {rows}×{columns}"),
                "Record all frames with one setting of the camera.",
            )
            .with_kind(ErrorKind::Shape));
        }
        if let Some((y, x)) = image.first_non_finite() {
            return Err(Error::input(
                subject,
                format!("{} at row {y}, column {x}", image.at(y, x)),
                "every pixel of a frame is a finite number",
                "Record it again, or replace the pixel by the mean of its neighbours.",
            )
            .with_kind(ErrorKind::NotFinite));
        }
    }
    Ok((rows, columns))
}

/// Part of the pixels that read `end` counts or more, in the worst row.
fn saturated_fraction(frame: &Image, end: f64) -> f64 {
    (0..frame.rows())
        .map(|y| {
            let full = frame.row(y).iter().filter(|&&p| f64::from(p) >= end);
            full.count() as f64 / frame.columns() as f64
        })
        .fold(0.0, f64::max)
}

/// Mean of each row, corrected for dark and response; NaN for a row without response.
fn row_means(frame: &Image, dark: Option<&Image>, response: Option<&[f64]>) -> Vec<f64> {
    let columns = frame.columns();
    (0..frame.rows())
        .map(|y| {
            let dark = dark.map(|d| d.row(y));
            let (mut sum, mut weight) = (0.0, 0.0);
            for (x, &pixel) in frame.row(y).iter().enumerate() {
                sum += f64::from(pixel) - dark.map_or(0.0, |d| f64::from(d[x]));
                weight += response.map_or(1.0, |r| r[y * columns + x]);
            }
            if weight > 0.0 { sum / weight } else { f64::NAN }
        })
        .collect()
}

/// Response of each pixel, the mean 1; what lies below zero is not used.
fn response(params: &TimingParams, rows: usize, columns: usize) -> Result<Option<Vec<f64>>> {
    let Some(flat) = &params.flat else {
        return Ok(None);
    };
    let dark = |i: usize| params.dark.as_ref().map_or(0.0, |d| f64::from(d.data()[i]));
    let pixels: Vec<f64> = (0..rows * columns)
        .map(|i| (f64::from(flat.data()[i]) - dark(i)).max(0.0))
        .collect();
    let mean = pixels.iter().sum::<f64>() / pixels.len() as f64;
    if mean <= 0.0 {
        return Err(Error::input(
            Parameter::Flat,
            "a flat that is no brighter than the dark",
            "the flat is lit evenly and the dark is not lit",
            "Check that dark and flat are not swapped.",
        )
        .with_kind(ErrorKind::NoSignal));
    }
    Ok(Some(pixels.iter().map(|p| p / mean).collect()))
}
