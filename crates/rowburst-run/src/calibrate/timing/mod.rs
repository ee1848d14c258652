//! The numbers and the report of a camera's timing.

#![allow(missing_docs, reason = "the fields are the keys of timing.json")]

mod report;

pub use report::write_report;

use crate::short;
use rowburst::Image;
use rowburst::calibrate::timing::{Lamp, Timing};
use serde::Serialize;

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
    pub fn new(timing: &Timing, frames: &[Image], light: &Lamp) -> Self {
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
