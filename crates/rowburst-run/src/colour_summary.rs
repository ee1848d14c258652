//! The numbers of a raw colour frame.
#![allow(missing_docs, reason = "the fields are the keys of result.json")]

use crate::record::RunRecord;
use crate::summary::MetadataNumbers;
use serde::Serialize;

/// The content of `result.json` of a raw colour frame.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ColourSummary {
    #[cfg_attr(test, schemars(extend("const" = crate::RESULT_SCHEMA_VERSION)))]
    pub schema_version: u32,
    pub version: &'static str,
    pub bayer: &'static str,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    pub frame_rate_hz: f64,
    /// Start of the first bin of the plane that begins first; see [`PlaneNumbers::start_us`].
    pub start_us: f64,
    /// See [`crate::ReconstructionSummary::trigger_delay_us`].
    pub trigger_delay_us: Option<f64>,
    pub metadata: MetadataNumbers,
    pub planes: Vec<PlaneNumbers>,
    pub warnings: Vec<String>,
    /// See [`crate::ReconstructionSummary::run`].
    pub run: Option<RunRecord>,
}

/// A plane, whose own `result.json` says more.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PlaneNumbers {
    pub name: String,
    pub folder: String,
    /// Start of the plane's first bin, in microseconds from the start of exposure of the sensor's row that is read first.
    pub start_us: f64,
    pub prior: String,
    pub tau: f64,
    pub residual_over_sigma: f64,
    /// Part of the plane's pixels that are foreign and were left out.
    pub excluded_fraction: f64,
    pub fit: &'static str,
    pub seconds: f64,
}
