//! Slips that are in range and still wrong: units, files in the wrong place, bits that do not belong to the counts.

use crate::format::short;
use rowburst::camera::CameraParams;
use rowburst::{Camera, Error, ErrorKind, Image, Parameter, PatchSet, Result, Shutter};
use rowburst_io::{Capture, SampleFormat};

/// Shortest row time and exposure of a camera in µs; shorter are of another unit.
const MIN_TIME_US: f64 = 0.05;
/// Row time in µs from which there is a warning: slower than any rolling shutter known.
const LONG_ROW_TIME_US: f64 = 2000.0;
/// Smallest and largest pitch of a pixel in µm, binned ones included.
const PITCHES_UM: [f64; 2] = [0.2, 500.0];
/// Smallest and largest number of electrons for a count.
const GAINS: [f64; 2] = [1e-3, 1e4];
/// Correlation of frame and PSF from which they are one picture.
const SAME_PICTURE: f64 = 0.999;
/// Part of the pixels above the full well that contradicts it.
const MANY_ABOVE_FULL_WELL: f64 = 0.5;
/// Counts over the full well that no spread of the pixels explains.
const FAR_ABOVE_FULL_WELL: f64 = 1.2;

/// Checks the numbers of a camera. Returns warnings of those that are possible and unlikely.
///
/// # Errors
/// A number of which the unit is another than that of its name.
pub fn check_camera(params: &CameraParams) -> Result<Vec<String>> {
    let mut warnings = Vec::new();
    let is_global = params.shutter == Shutter::Global;
    let times = [
        (Parameter::RowTimeUs, params.row_time_us, !is_global),
        (Parameter::ExposureUs, params.exposure_us, true),
    ];
    for (parameter, value, counts) in times {
        if counts && value > 0.0 && value < MIN_TIME_US {
            return Err(other_unit(
                parameter,
                value,
                format!("cameras have {MIN_TIME_US} µs or more"),
                ("seconds", 1e6),
                ("milliseconds", 1e3),
            ));
        }
    }
    if !is_global && params.row_time_us > LONG_ROW_TIME_US {
        warnings.push(format!(
            "row_time_us = {}: {} ms for a row; are these nanoseconds?",
            params.row_time_us,
            short(1e-3 * params.row_time_us)
        ));
    }
    let sensor = &params.sensor;
    if let Some(pitch) = sensor.pixel_pitch_um.filter(|p| *p > 0.0) {
        let rule = format!("pixels have {} to {} µm", PITCHES_UM[0], PITCHES_UM[1]);
        if pitch < PITCHES_UM[0] {
            let (metres, millimetres) = (("metres", 1e6), ("millimetres", 1e3));
            return Err(other_unit(
                Parameter::PixelPitchUm,
                pitch,
                rule,
                metres,
                millimetres,
            ));
        }
        if pitch > PITCHES_UM[1] {
            let nanometres = ("nanometres", 1e-3);
            return Err(other_unit(
                Parameter::PixelPitchUm,
                pitch,
                rule,
                nanometres,
                nanometres,
            ));
        }
    }
    if let Some(gain) = sensor.gain_electrons_per_count.filter(|g| *g > 0.0)
        && !(GAINS[0]..=GAINS[1]).contains(&gain)
    {
        return Err(Error::input(
            Parameter::GainElectronsPerCount,
            typed(gain),
            format!("a count stands for {} to {} electrons", GAINS[0], GAINS[1]),
            "Read it from the data sheet, in electrons per count, or calibrate the sensor.",
        )
        .with_kind(ErrorKind::Invalid));
    }
    Ok(warnings)
}

/// The error of a value in another unit: the first of the two that makes it plausible.
fn other_unit(
    parameter: Parameter,
    value: f64,
    rule: String,
    large: (&str, f64),
    small: (&str, f64),
) -> Error {
    let (unit, factor) = if value * small.1 >= 1.0 { small } else { large };
    Error::input(
        parameter,
        format!("{}, which looks like {unit}", typed(value)),
        rule,
        format!("Are these {unit}? Then write {}.", rounded(value * factor)),
    )
    .with_kind(ErrorKind::Invalid)
}

/// As a person types it.
fn typed(value: f64) -> String {
    if (1e-3..1e6).contains(&value) {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

/// Without the digits that a product of decimal numbers adds.
fn rounded(value: f64) -> f64 {
    format!("{value:.6e}").parse().unwrap_or(value)
}

/// Checks a frame against camera and PSF. Returns warnings.
///
/// # Errors
/// A mask or the PSF in place of the frame, and counts beyond those of the camera.
pub fn check_frame(frame: &Capture, camera: &Camera, psfs: &PatchSet) -> Result<Vec<String>> {
    let image = &frame.image;
    if image.first_non_finite().is_some() {
        // The correction says so.
        return Ok(Vec::new());
    }
    refuse_mask(image)?;
    if let Some(psf) = psfs
        .psfs()
        .iter()
        .find(|psf| is_same_picture(image, psf.image()))
    {
        return Err(Error::input(
            Parameter::Psf,
            format!("the frame itself, {}×{} pixels", psf.image().rows(), psf.image().columns()),
            "the PSF is another capture than the frame: that of a point source",
            "Give the point source's capture as the PSF, or make it with the calibration of the PSF.",
        )
        .with_kind(ErrorKind::Conflict));
    }
    let mut warnings = Vec::new();
    let sensor = camera.sensor();
    if let SampleFormat::Counts { bits } = frame.format {
        refuse_impossible_counts(image, camera)?;
        if let Some(depth) = sensor.bit_depth.filter(|depth| *depth > bits) {
            warnings.push(format!(
                "the frame has {bits}-bit counts and the camera {depth} bits: a converted picture has other counts than the sensor, and gain, bias and read noise do not hold; save the raw frame"
            ));
        }
    }
    let is_working_grid = (image.rows(), image.columns()) == (camera.rows(), camera.columns());
    if sensor.binning > 1 && is_working_grid {
        warnings.push(format!(
            "binning = {} and a frame of {}×{} pixels, which is taken as binned already: leave binning out if it is not, or set rows and columns to those after binning",
            sensor.binning,
            image.rows(),
            image.columns()
        ));
    }
    Ok(warnings)
}

/// Part of the pixels from which those of the larger value make a mask; a frame of a few lit pixels has two values, too.
const MIN_MASK: f64 = 0.01;

/// Refuses a picture of two values.
fn refuse_mask(image: &Image) -> Result<()> {
    let (low, high) = (image.min(), image.max());
    let has_third = image.data().iter().any(|&v| v != low && v != high);
    let marked = image.data().iter().filter(|v| **v == high).count();
    if low == high || has_third || (marked as f64) < MIN_MASK * image.data().len() as f64 {
        return Ok(());
    }
    Err(Error::input(
        Parameter::Frame,
        format!("only the values {low} and {high}"),
        "a frame holds a speckle pattern of many values",
        "Is this a mask, or a frame after a threshold? Give the raw frame.",
    )
    .with_kind(ErrorKind::NoSignal))
}

/// Refuses counts that the converter or the full well of the camera cannot give.
fn refuse_impossible_counts(image: &Image, camera: &Camera) -> Result<()> {
    let (sensor, brightest) = (camera.sensor(), f64::from(image.max()));
    if let Some(depth) = sensor.bit_depth {
        let end = f64::from(depth).exp2() - 1.0;
        if brightest > end {
            let bits = (brightest + 1.0).log2().ceil();
            return Err(Error::input(
                Parameter::Frame,
                format!("counts up to {brightest}"),
                format!("bit_depth = {depth} ends at {end}"),
                format!(
                    "Set bit_depth to {bits} or more, or divide the counts if the file has them shifted to the left."
                ),
            )
            .with_kind(ErrorKind::Conflict));
        }
    }
    let Some(full) = sensor.full_well_counts else {
        return Ok(());
    };
    let above = image
        .data()
        .iter()
        .filter(|&&v| f64::from(v) >= full)
        .count();
    if above as f64 > MANY_ABOVE_FULL_WELL * image.data().len() as f64
        && brightest > FAR_ABOVE_FULL_WELL * full
    {
        return Err(Error::input(
            Parameter::Frame,
            format!("{above} of {} pixels above the full well, up to {brightest} counts", image.data().len()),
            format!("full_well_counts = {full} is where pixels saturate"),
            "Is the full well in electrons or of another gain? Divide it by the gain, or leave it out.",
        )
        .with_kind(ErrorKind::Conflict));
    }
    Ok(())
}

/// Whether two pictures of one size are the same but for offset and scale.
fn is_same_picture(a: &Image, b: &Image) -> bool {
    if (a.rows(), a.columns()) != (b.rows(), b.columns()) {
        return false;
    }
    let mean = |image: &Image| {
        let sum: f64 = image.data().iter().map(|&v| f64::from(v)).sum();
        sum / image.data().len() as f64
    };
    let (mean_a, mean_b) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (&a, &b) in a.data().iter().zip(b.data()) {
        let (a, b) = (f64::from(a) - mean_a, f64::from(b) - mean_b);
        ab += a * b;
        aa += a * a;
        bb += b * b;
    }
    ab > SAME_PICTURE * (aa * bb).sqrt() && aa > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::Sensor;

    fn params() -> CameraParams {
        CameraParams {
            rows: 8,
            columns: 8,
            shutter: Shutter::TopDown,
            row_time_us: 9.6,
            exposure_us: 9.6,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        }
    }

    fn message(params: &CameraParams) -> String {
        check_camera(params).unwrap_err().to_string()
    }

    #[test]
    fn units_are_named() {
        assert!(check_camera(&params()).unwrap().is_empty());
        for (row_time_us, words) in [
            (9.6e-6, "seconds? Then write 9.6."),
            (9.6e-3, "milliseconds? Then write 9.6."),
        ] {
            let text = message(&CameraParams {
                row_time_us,
                ..params()
            });
            assert!(
                text.contains(words) && text.contains("row_time_us"),
                "{text}"
            );
        }
        let pitch = |pitch| CameraParams {
            sensor: Sensor {
                pixel_pitch_um: Some(pitch),
                ..Sensor::default()
            },
            ..params()
        };
        for (value, words) in [
            (6.5e-6, "metres? Then write 6.5."),
            (6.5e-3, "millimetres? Then write 6.5."),
            (6500.0, "nanometres? Then write 6.5."),
        ] {
            let text = message(&pitch(value));
            assert!(text.contains(words), "{text}");
        }
        let slow = check_camera(&CameraParams {
            row_time_us: 9600.0,
            ..params()
        })
        .unwrap();
        assert!(slow[0].contains("nanoseconds"), "{slow:?}");
        // A global shutter has no row time.
        let global = CameraParams {
            shutter: Shutter::Global,
            row_time_us: 1e-9,
            ..params()
        };
        assert!(check_camera(&global).is_ok());
    }
}
