//! The numbers of `result.json`.
//!
//! Fields are the keys of the file; the README explains them.
#![allow(missing_docs, reason = "the fields are the keys of result.json")]

use crate::format::{percent, short};
use crate::guide::GuideNumbers;
use crate::record::RunRecord;
use crate::traces::{DebiasNumbers, StandardErrorNumbers, TraceNumbers};
use rowburst::design::count::ChangeCount;
use rowburst::reconstruct::{Calibration, Candidate, FitStatistics};
use rowburst_io::FromMetadata;
use rowburst_report::Iteration;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;

/// The content of `result.json`.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ReconstructionSummary {
    #[cfg_attr(test, schemars(extend("const" = crate::RESULT_SCHEMA_VERSION)))]
    pub schema_version: u32,
    pub version: &'static str,
    pub prior: String,
    pub prior_choice: PriorChoice,
    pub tau: f64,
    pub tau_rule: &'static str,
    pub noise_sigma: f64,
    pub noise_sigma_source: &'static str,
    /// Noise and error of the model together; `noise_sigma` where the model explains the frame.
    pub effective_sigma: f64,
    pub residual_over_sigma: f64,
    pub objective: f64,
    /// Upper bound of the objective's excess over its minimum, relative to its lower bound; null without a bound.
    pub objective_excess: Option<f64>,
    /// The bound as a sentence.
    pub certificate: String,
    /// Fraction of the voxels that are in the support at the end.
    pub support_fraction: f64,
    pub iterations: usize,
    pub stop_reason: &'static str,
    /// Time of the solver, without the set-up.
    pub seconds: f64,
    pub setup_seconds: f64,
    /// Peak of the whole process; null where the system does not report it.
    pub peak_memory_bytes: Option<u64>,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    /// The row of the sensor at which the first row of the video lies: below 0 where the field is larger than the sensor.
    pub first_row: i64,
    /// The same of the columns.
    pub first_column: i64,
    pub frame_rate_hz: f64,
    /// Start of the first bin, in microseconds from the start of exposure of the row that is read first.
    pub start_us: f64,
    /// From the trigger to the start of exposure of the row that is read first; null where it is not known.
    pub trigger_delay_us: Option<f64>,
    pub metadata: MetadataNumbers,
    pub bad_pixels: usize,
    pub saturated_pixels: usize,
    /// The correction of PSF and camera by the frame; null where they were used as given.
    pub self_calibration: Option<CalibrationNumbers>,
    /// Part of the pixels that are foreign and were left out.
    pub excluded_fraction: f64,
    /// Part of the light of the frame that is smooth stray light and was taken away.
    pub stray_light_fraction: f64,
    /// Part of the voxels that the frame observes.
    pub coverage_fraction: f64,
    pub threads: usize,
    /// Instruction set of the vector loops. Results of different sets agree to rounding, not to the bit.
    pub simd: &'static str,
    /// Seed of the simulation in a demo, else 0. A reconstruction does not depend on it.
    pub seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    /// How many numbers of an instant speak about the change of a dense scene; null for sparse ones, and for instants
    /// of more than 2048 pixels.
    pub change_count: Option<ChangeNumbers>,
    /// The guide of a second camera; null without one.
    pub guide: Option<GuideNumbers>,
    /// The verdict: `good`, `suspicious` or `bad`.
    pub fit: &'static str,
    pub fit_reason: String,
    pub fit_statistics: FitNumbers,
    /// Traces of the requested regions and of the brightest spots.
    pub traces: Vec<TraceNumbers>,
    pub trace_errors: StandardErrorNumbers,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub debias: Option<DebiasNumbers>,
    /// The recorded iterations of the run that gave the video.
    pub history: Vec<HistoryPoint>,
    pub warnings: Vec<String>,
    /// Camera, options and inputs, by which the run can be repeated; null for arrays in memory.
    pub run: Option<RunRecord>,
}

/// Values from the metadata of the frame's file.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct MetadataNumbers {
    /// Sources of metadata that were found.
    pub sources: Vec<String>,
    /// Keys that the experiment file leaves open, with their values from the metadata.
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

/// The correction of PSF and camera by the frame.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct CalibrationNumbers {
    /// The parameters that were found, by their names.
    #[serde(flatten)]
    pub parameters: BTreeMap<&'static str, ParameterNumbers>,
    /// Stray light of each row of the frame; null where rows have none of their own.
    pub row_offsets_counts: Option<Vec<f64>>,
    /// Rms change of the PSF's pixels by its refinement over the PSF's rms; null where it was not refined.
    pub psf_refinement: Option<f64>,
    /// Root mean square of the held-out residuals over σ before; null where the correction was read from the PSF alone.
    pub held_out_before: Option<f64>,
    /// The same after.
    pub held_out_after: Option<f64>,
}

/// A parameter that was found.
#[derive(Debug, Clone, Copy, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ParameterNumbers {
    pub value: f64,
    /// Its standard error.
    pub error: f64,
}

impl CalibrationNumbers {
    /// The numbers of `calibration`.
    pub fn new(calibration: &Calibration) -> Self {
        let parameters = calibration.parameters.iter().map(|found| {
            let numbers = ParameterNumbers {
                value: found.value,
                error: found.standard_error,
            };
            (found.parameter.name(), numbers)
        });
        let rows = &calibration.row_offsets;
        Self {
            parameters: parameters.collect(),
            row_offsets_counts: (!rows.is_empty()).then(|| rows.clone()),
            psf_refinement: calibration.psf_refinement,
            held_out_before: calibration.held_out.map(|errors| errors.before),
            held_out_after: calibration.held_out.map(|errors| errors.after),
        }
    }

    /// The evidence for it.
    pub fn evidence(&self) -> String {
        match (self.held_out_before, self.held_out_after) {
            (Some(before), Some(after)) => {
                format!("held-out error {before:.2} σ before, {after:.2} σ after")
            }
            _ => "read from the dark part of the PSF".into(),
        }
    }

    /// What was found, as pairs of name and value.
    pub fn lines(&self) -> Vec<(String, String)> {
        let parameters = self.parameters.iter();
        let mut lines: Vec<_> = parameters
            .map(|(name, p)| {
                (
                    name.replace('_', " "),
                    format!("{} ± {}", short(p.value), short(p.error)),
                )
            })
            .collect();
        if let Some(change) = self.psf_refinement {
            lines.push(("PSF refined by".into(), percent(change)));
        }
        if let Some(rows) = &self.row_offsets_counts {
            let rms = (rows.iter().map(|r| r * r).sum::<f64>() / rows.len() as f64).sqrt();
            lines.push((
                "stray light of rows".into(),
                format!("{} counts rms", short(rms)),
            ));
        }
        lines
    }
}

impl fmt::Display for CalibrationNumbers {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let lines = self.lines();
        let found: Vec<String> = lines
            .iter()
            .map(|(name, value)| format!("{name} {value}"))
            .collect();
        write!(f, "{} ({})", found.join(", "), self.evidence())
    }
}

/// How many numbers of an instant speak about the change of a scene.
#[derive(Debug, Clone, Copy, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ChangeNumbers {
    /// Numbers that speak about it.
    pub informative: f64,
    /// Numbers of the instant.
    pub of: usize,
    /// Rms of the video less its mean over time, in counts.
    pub change_rms: f64,
}

impl ChangeNumbers {
    /// The count alone.
    pub(crate) fn count(&self) -> ChangeCount {
        ChangeCount {
            informative: self.informative,
            of: self.of,
        }
    }
}

/// A recorded iteration.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct HistoryPoint {
    pub iteration: usize,
    /// Time since the start of the process, without comparisons with the truth and calls of the observer.
    pub seconds: f64,
    pub residual_over_sigma: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
}

impl HistoryPoint {
    /// Makes a point of the history. `start_offset_s` is the time from the start of the process to the start
    /// of the solver, in seconds.
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
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PriorChoice {
    pub reason: String,
    /// Null where the prior was not chosen.
    pub held_out_pixels: Option<usize>,
    pub candidates: Vec<PriorCandidate>,
}

/// A prior that was tried.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PriorCandidate {
    pub prior: String,
    /// Factor on the `τ` of the discrepancy principle.
    pub tau_factor: f64,
    /// The same value under the key of 0.1, for programs that read it.
    #[serde(rename = "strength")]
    pub old_tau_factor: f64,
    /// Root mean square of the residual over σ at held-out pixels.
    pub held_out_error: f64,
    /// How far its square lies below that of the best candidate before it, in standard errors of the paired differences.
    pub gain_in_standard_errors: Option<f64>,
    #[serde(rename = "given_up")]
    pub stopped_early: bool,
}

impl From<&Candidate> for PriorCandidate {
    fn from(candidate: &Candidate) -> Self {
        Self {
            prior: candidate.prior.to_string(),
            tau_factor: candidate.tau_factor,
            old_tau_factor: candidate.tau_factor,
            held_out_error: candidate.error,
            gain_in_standard_errors: candidate.gain,
            stopped_early: candidate.stopped_early,
        }
    }
}

/// The statistics of the fit, on which the verdict rests; see [`FitStatistics`].
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct FitNumbers {
    pub chi_squared: f64,
    pub chi_squared_error: f64,
    pub residual_over_frame: f64,
    /// Degrees of freedom of the video over the number of measurements.
    pub freedom: f64,
    /// Noise of the frequencies that the optics do not pass, over σ; null where the frame is too small.
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
    /// Null where it cannot be tested, since instants read several rows.
    pub mirrored: Option<f64>,
    /// Null where the PSF passes the finest detail, or rows and columns are too few.
    pub fine_ratio: Option<f64>,
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
            fine_ratio: s.fine_ratio,
            tests_timing: s.tests_timing,
        }
    }
}

/// Peak memory of this process in bytes; `None` on systems other than Linux.
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib * 1024)
}
