//! `result.json`: the numbers of a run.
//! Keys are those of the file; the README says what they mean.
#![allow(missing_docs)]

use crate::traces::{DebiasNumbers, ErrorNumbers, TraceNumbers};
use rowburst::reconstruct::{Candidate, FitStatistics};
use rowburst_io::FromMetadata;
use rowburst_report::Iteration;
use serde::Serialize;
use std::collections::BTreeMap;

/// Everything that `result.json` says.
#[derive(Debug, Clone, Serialize)]
pub struct ReconstructionSummary {
    pub version: &'static str,
    pub prior: String,
    pub prior_choice: PriorChoice,
    pub tau: f64,
    pub tau_rule: &'static str,
    pub noise_sigma: f64,
    pub noise_sigma_source: &'static str,
    pub residual_over_sigma: f64,
    pub objective: f64,
    /// The objective is at most this part above its minimum; null where nothing is known.
    pub objective_excess: Option<f64>,
    /// The same as a sentence.
    pub certificate: String,
    /// Part of the voxels that were allowed to be lit at the end.
    pub support_fraction: f64,
    pub iterations: usize,
    pub stop_reason: &'static str,
    /// Solving alone.
    pub seconds: f64,
    pub setup_seconds: f64,
    /// Of the whole process; null where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    pub frame_rate_hz: f64,
    pub metadata: MetadataNumbers,
    pub bad_pixels: usize,
    pub saturated_pixels: usize,
    pub threads: usize,
    /// Instruction set of the vector loops: results agree between them to rounding, not to the bit.
    pub simd: &'static str,
    /// Of the simulation in a demo; 0 else: nothing in a reconstruction is random.
    pub seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// good, suspicious or bad.
    pub fit: &'static str,
    pub fit_reason: String,
    pub fit_statistics: FitNumbers,
    /// Of the regions that were asked for and the brightest spots.
    pub traces: Vec<TraceNumbers>,
    pub trace_errors: ErrorNumbers,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub debias: Option<DebiasNumbers>,
    /// The course of the run that gave the video.
    pub history: Vec<HistoryPoint>,
    pub warnings: Vec<String>,
}

/// What came from the metadata of the frame's file.
#[derive(Debug, Clone, Serialize)]
pub struct MetadataNumbers {
    /// Where there was any.
    pub sources: Vec<String>,
    /// Keys that the experiment file leaves open, with the values that were taken.
    pub taken: BTreeMap<String, String>,
}

impl From<&FromMetadata> for MetadataNumbers {
    fn from(from_metadata: &FromMetadata) -> Self {
        Self {
            sources: from_metadata.sources.clone(),
            taken: from_metadata.values.iter().cloned().collect(),
        }
    }
}

/// The video after an iteration.
#[derive(Debug, Clone, Serialize)]
pub struct HistoryPoint {
    pub iteration: usize,
    /// Since the start of the process, without the comparisons with the truth.
    pub seconds: f64,
    pub residual_over_sigma: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
}

impl HistoryPoint {
    /// `start_offset_s`: seconds from the start of the process to that of the solver's clock.
    pub fn new(point: &Iteration, start_offset_s: f64) -> Self {
        Self {
            iteration: point.iteration,
            seconds: start_offset_s + point.seconds,
            residual_over_sigma: point.residual_over_sigma,
            psnr_db: point.psnr_db,
        }
    }
}

/// How the prior was chosen.
#[derive(Debug, Clone, Serialize)]
pub struct PriorChoice {
    pub reason: String,
    /// Null where there was no choice.
    pub held_out_pixels: Option<usize>,
    pub candidates: Vec<PriorCandidate>,
}

/// A prior that was tried.
#[derive(Debug, Clone, Serialize)]
pub struct PriorCandidate {
    pub prior: String,
    /// τ over that of the discrepancy principle.
    pub strength: f64,
    /// Rms of the residual over σ at pixels that the solver had not seen.
    pub held_out_error: f64,
    pub given_up: bool,
}

impl From<&Candidate> for PriorCandidate {
    fn from(candidate: &Candidate) -> Self {
        Self {
            prior: candidate.prior.to_string(),
            strength: candidate.tau_factor,
            held_out_error: candidate.error,
            given_up: candidate.given_up,
        }
    }
}

/// What the verdict on the fit rests on; see `rowburst::reconstruct::FitStatistics`.
#[derive(Debug, Clone, Serialize)]
pub struct FitNumbers {
    pub chi_squared: f64,
    pub chi_squared_error: f64,
    pub residual_over_frame: f64,
    /// Values that the fit has chosen freely over measurements.
    pub freedom: f64,
    /// Noise over σ; null where the frame is too small to tell.
    pub noise_floor: Option<f64>,
    pub passed_level: Option<f64>,
    pub correlation_x: f64,
    pub correlation_y: f64,
    pub correlation_with_model: f64,
    pub misfit_instants: usize,
    pub worst_instant: usize,
    pub worst_instant_chi_squared: f64,
    pub misfit_columns: usize,
    pub worst_column: usize,
    pub worst_column_chi_squared: f64,
    pub lone_pixels: usize,
    pub residual_trend: f64,
    /// Null where instants read several rows.
    pub mirrored: Option<f64>,
    pub tests_timing: bool,
}

impl From<&FitStatistics> for FitNumbers {
    fn from(s: &FitStatistics) -> Self {
        Self {
            chi_squared: s.chi_squared,
            chi_squared_error: s.chi_squared_error,
            residual_over_frame: s.residual_over_frame,
            freedom: s.freedom,
            noise_floor: s.noise_floor,
            passed_level: s.passed_level,
            correlation_x: s.correlation_x,
            correlation_y: s.correlation_y,
            correlation_with_model: s.correlation_with_model,
            misfit_instants: s.misfit_instants.0,
            worst_instant: s.worst_instant.0,
            worst_instant_chi_squared: s.worst_instant.1,
            misfit_columns: s.misfit_columns.0,
            worst_column: s.worst_column.0,
            worst_column_chi_squared: s.worst_column.1,
            lone_pixels: s.lone_pixels,
            residual_trend: s.residual_trend,
            mirrored: s.mirrored,
            tests_timing: s.tests_timing,
        }
    }
}

/// Largest memory that this process has held, in bytes (Linux).
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib * 1024)
}

/// A number with a sensible number of digits.
pub fn short(value: f64) -> String {
    if value == 0.0 || (1e-3..1e5).contains(&value.abs()) {
        let digits = (3.0 - value.abs().max(1e-3).log10().floor()).clamp(0.0, 6.0) as usize;
        format!("{value:.digits$}")
    } else {
        format!("{value:.3e}")
    }
}
