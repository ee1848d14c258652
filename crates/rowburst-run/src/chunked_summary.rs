//! The numbers of a video that was reconstructed in chunks.
#![allow(missing_docs, reason = "the fields are the keys of result.json")]

use crate::record::RunRecord;
use crate::summary::MetadataNumbers;
use serde::{Deserialize, Serialize};

/// A completed chunk, in `result.json` and `parts.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ChunkNumbers {
    /// Its first bin in the written video.
    pub first_bin: usize,
    /// The bin after its last one.
    pub end_bin: usize,
    pub iterations: usize,
    pub stop_reason: String,
    pub tau: f64,
    pub residual_over_sigma: f64,
    pub support_fraction: f64,
    pub fit: String,
    pub fit_reason: String,
    pub seconds: f64,
}

/// The content of `result.json` of a video that was reconstructed in chunks.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ChunkedSummary {
    #[cfg_attr(test, schemars(extend("const" = crate::RESULT_SCHEMA_VERSION)))]
    pub schema_version: u32,
    pub version: &'static str,
    pub prior: String,
    pub tau_rule: &'static str,
    pub noise_sigma: f64,
    pub noise_sigma_source: &'static str,
    /// Root mean square over all chunks.
    pub residual_over_sigma: f64,
    /// The worst verdict of the chunks.
    pub fit: &'static str,
    /// How many chunks have this verdict, and the reason of the first one.
    pub fit_reason: String,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    /// See [`crate::ReconstructionSummary::first_row`].
    pub first_row: i64,
    /// See [`crate::ReconstructionSummary::first_column`].
    pub first_column: i64,
    /// The first bin of the video, counted in the whole readout.
    pub first_bin: usize,
    pub frame_rate_hz: f64,
    /// See [`crate::ReconstructionSummary::start_us`].
    pub start_us: f64,
    /// See [`crate::ReconstructionSummary::trigger_delay_us`].
    pub trigger_delay_us: Option<f64>,
    /// Sum of the times of all chunks.
    pub seconds: f64,
    /// `seconds` over the number of bins.
    pub seconds_per_bin: f64,
    pub peak_memory_bytes: Option<u64>,
    pub threads: usize,
    /// See [`crate::ReconstructionSummary::simd`].
    pub simd: &'static str,
    pub bad_pixels: usize,
    pub saturated_pixels: usize,
    pub metadata: MetadataNumbers,
    pub parts: Vec<ChunkNumbers>,
    pub warnings: Vec<String>,
    /// See [`crate::ReconstructionSummary::run`].
    pub run: Option<RunRecord>,
}
