//! The numbers and the report of a camera's timing.

#![allow(missing_docs, reason = "the fields are the keys of timing.json")]

mod report;

use report::write_report;

use crate::artifacts::json_of;
use crate::short;
use rowburst::calibrate::timing::{Lamp, Timing, TimingParams, calibrate};
use rowburst::error::Subject;
use rowburst::{Camera, Error, Image, Parameter, Result, Shutter};
use rowburst_io::{Experiment, OutputFolder, write_npy_i64};
use serde::Serialize;
use std::path::Path;

/// Frames of a light, with all that is known of it and of the camera.
pub struct TimingInputs {
    /// The frames, all of one setting of the camera.
    pub frames: Vec<Image>,
    /// The light.
    pub light: Lamp,
    /// A frame without light.
    pub dark: Option<Image>,
    /// A frame of even light.
    pub flat: Option<Image>,
    /// The count at which the kind of the frames' numbers ends. The camera's takes precedence.
    pub saturation_limit: Option<f64>,
    /// The camera; its row time (within 30 %) resolves aliases.
    pub camera: Option<Camera>,
}

/// The timing of a camera.
pub struct TimingCalibration {
    pub timing: Timing,
    /// The content of `timing.json`.
    pub summary: TimingSummary,
    /// Rows of the frames in a row of the camera.
    pub binning: usize,
    /// The experiment with the timing, where one was given.
    experiment: Option<Experiment>,
}

impl TimingInputs {
    /// Calibrates the timing. A copy of `experiment` takes it over.
    ///
    /// # Errors
    /// Those of [`calibrate`].
    pub fn calibrate(&self, experiment: Option<&Experiment>) -> Result<TimingCalibration> {
        let camera = self.camera.as_ref();
        let known = camera
            .zip(self.frames.first())
            .map(|(camera, frame)| KnownRowTime::new(camera, frame.rows()));
        let of_sensor = camera.and_then(|c| c.sensor().saturation_counts());
        let params = TimingParams {
            dark: self.dark.clone(),
            flat: self.flat.clone(),
            saturation_counts: of_sensor.or(self.saturation_limit),
            expected_row_time_us: known.as_ref().and_then(|k| k.row_time_us),
            ..TimingParams::default()
        };
        let mut timing = calibrate(&self.frames, &self.light, &params)?;
        let binning = known.as_ref().map_or(1, |k| k.binning);
        timing.warnings.extend(known.and_then(|k| k.warning));
        let experiment = experiment.map(|given| with_timing(given.clone(), &mut timing, binning));
        Ok(TimingCalibration {
            summary: TimingSummary::new(&timing, &self.frames, &self.light),
            timing,
            binning,
            experiment,
        })
    }
}

/// `experiment` with `timing`, of frames that have `binning` rows in a row of the experiment. Warns of what is left open.
fn with_timing(mut experiment: Experiment, timing: &mut Timing, binning: usize) -> Experiment {
    experiment.params.row_time_us = timing.row_time_us * binning as f64;
    if let Some((exposure, _)) = timing.exposure_us {
        experiment.params.exposure_us = exposure;
    }
    let before = &experiment.params.shutter;
    match timing.shutters.as_slice() {
        [only] => experiment.params.shutter = only.clone(),
        several if several.contains(before) => {}
        _ => timing.warnings.push(format!(
            "the shutter of the experiment, {}, is not among those that fit the light: it was kept; decide which is right and correct it",
            before.name()
        )),
    }
    experiment
}

impl TimingCalibration {
    /// Writes the report, the experiment file and `timing.json`, which is last: where it is, the result is whole.
    /// `reproduce` is the command that repeats the calibration.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write(&self, folder: &OutputFolder, reproduce: Option<&str>) -> Result<()> {
        folder.remove("timing.json")?;
        write_report(folder, &self.timing, self.experiment.is_some(), reproduce)?;
        if let Some(experiment) = &self.experiment {
            write_experiment(folder, experiment.clone())?;
        }
        folder.remove_stale()?;
        let json = json_of(&self.summary);
        folder.write_bytes("timing.json", format!("{json}\n").as_bytes())
    }
}

/// Writes `experiment.toml`, and the order of a custom shutter beside it.
fn write_experiment(folder: &OutputFolder, mut experiment: Experiment) -> Result<()> {
    experiment.camera()?;
    experiment.row_order = None;
    if let Shutter::Custom(order) = &experiment.params.shutter {
        let order: Vec<i64> = order.iter().map(|&k| k as i64).collect();
        folder.write(ROW_ORDER, |w| write_npy_i64(w, &[order.len()], &order))?;
        experiment.row_order = Some(folder.path().join(ROW_ORDER));
    }
    let text = experiment.to_toml(folder.path());
    folder.write_bytes("experiment.toml", text.as_bytes())
}

/// The file of the order of a custom shutter.
const ROW_ORDER: &str = "row_order.npy";

/// Everything that `timing.json` says.
#[derive(Debug, Serialize)]
pub struct TimingSummary {
    pub version: &'static str,
    pub row_time_us: f64,
    pub row_time_us_error: f64,
    pub shutters: Vec<&'static str>,
    pub exposure_us: Option<f64>,
    pub exposure_us_error: Option<f64>,
    pub exposure_basis: String,
    pub readout_ms: f64,
    /// Periods of the light during the readout; null for a course from a file.
    pub periods: Option<f64>,
    /// Of each frame, the part of a period since the light's maximum when row time 0 ends;
    /// null for a course from a file.
    pub phases: Option<Vec<f64>>,
    /// The same moment on the clock of the file; null for a light of known frequency.
    pub time_offsets_us: Option<Vec<f64>>,
    pub modulation_depth: f64,
    pub explained_variance: f64,
    pub candidates: Vec<CandidateSummary>,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    pub warnings: Vec<String>,
    /// The light that would decide between the shutters left; null where one is left.
    pub advice: Option<String>,
}

/// A readout order, as `timing.json` lists it.
#[derive(Debug, Serialize)]
pub struct CandidateSummary {
    pub shutter: &'static str,
    pub row_time_us: f64,
    pub chi2_per_freedom: f64,
    pub chi2_excess: f64,
    pub left: bool,
}

impl TimingSummary {
    /// The numbers of `timing`, found from `frames` of `light`.
    fn new(timing: &Timing, frames: &[Image], light: &Lamp) -> Self {
        let periodic = matches!(light, Lamp::Periodic { .. });
        let phases = timing.phases.clone();
        Self {
            version: env!("CARGO_PKG_VERSION"),
            row_time_us: timing.row_time_us,
            row_time_us_error: timing.row_time_us_error,
            shutters: timing.shutters.iter().map(|s| s.name()).collect(),
            exposure_us: timing.exposure_us.map(|e| e.0),
            exposure_us_error: timing.exposure_us.map(|e| e.1),
            exposure_basis: timing.exposure_basis.clone(),
            readout_ms: timing.readout_ms,
            periods: timing.periods,
            phases: periodic.then(|| phases.clone()),
            time_offsets_us: (!periodic).then_some(phases),
            modulation_depth: timing.modulation_depth,
            explained_variance: timing.explained,
            candidates: timing
                .candidates
                .iter()
                .map(|c| CandidateSummary {
                    shutter: c.shutter.name(),
                    row_time_us: c.row_time_us,
                    chi2_per_freedom: c.chi2,
                    chi2_excess: c.excess,
                    left: c.is_consistent,
                })
                .collect(),
            frames: frames.len(),
            rows: frames[0].rows(),
            columns: frames[0].columns(),
            warnings: timing.warnings.clone(),
            advice: timing.advice.clone(),
        }
    }
}

/// The shutters that fit the light.
pub fn shutter_names(timing: &Timing) -> String {
    let names: Vec<&str> = timing.shutters.iter().map(|s| s.name()).collect();
    names.join(" or ")
}

/// The row time with its error.
pub fn row_time(timing: &Timing) -> String {
    with_error(timing.row_time_us, timing.row_time_us_error)
}

/// A value with the digits that its error leaves.
fn with_error(value: f64, error: f64) -> String {
    if !error.is_finite() {
        return format!("{} µs", short(value));
    }
    let digits = (1.0 - error.max(1e-9).log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{value:.digits$} ± {error:.digits$} µs")
}

/// The exposure with its error.
pub fn exposure(timing: &Timing) -> String {
    match timing.exposure_us {
        Some((value, error)) => with_error(value, error),
        None => "not shown".into(),
    }
}

/// What a camera says of the row time of frames.
struct KnownRowTime {
    /// Rows of the frames in a row of the camera.
    binning: usize,
    /// The row time of the frames; `None` for a global shutter.
    row_time_us: Option<f64>,
    /// A warning where frames and camera differ in rows.
    warning: Option<String>,
}

impl KnownRowTime {
    /// Of frames of `rows` rows.
    fn new(camera: &Camera, rows: usize) -> Self {
        let (mut binning, mut warning) = (1, None);
        let camera_binning = camera.sensor().binning;
        if rows == camera.rows() * camera_binning {
            binning = camera_binning;
        } else if rows != camera.rows() {
            warning = Some(format!(
                "the frames have {rows} rows, the experiment {}: the row time is taken to be that of both",
                camera.rows()
            ));
        }
        let is_rolling = !matches!(camera.shutter(), Shutter::Global);
        Self {
            binning,
            row_time_us: is_rolling.then(|| camera.params().row_time_us / binning as f64),
            warning,
        }
    }
}

/// Lines `time_us,value`; empty ones, those that begin with # and a heading are passed over.
///
/// # Errors
/// A file that cannot be read, or a line that has not two numbers.
pub fn read_waveform(path: &Path) -> Result<Vec<(f64, f64)>> {
    let text = std::fs::read_to_string(path).map_err(|error| {
        Error::input(
            Subject::from(path).of(Parameter::Signal),
            format!("a file that cannot be read ({error})"),
            "the waveform of the light is a text file",
            "Check the path and the permissions.",
        )
    })?;
    let mut points = Vec::new();
    for (i, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let number = |part: Option<&str>| part.and_then(|p| p.trim().parse::<f64>().ok());
        let mut parts = line.split([',', ';', '\t']);
        let pair = (number(parts.next()), number(parts.next()), parts.next());
        match pair {
            (Some(time), Some(value), None) => points.push((time, value)),
            _ if points.is_empty() && line.starts_with(|c: char| c.is_alphabetic()) => {}
            _ => {
                return Err(Error::input(
                    Subject::line(path, i + 1).of(Parameter::Signal),
                    format!("\"{line}\""),
                    "a line has two numbers, time_us,value",
                    "Write the time in microseconds, a comma and the light, with a point for decimals.",
                ));
            }
        }
    }
    Ok(points)
}
