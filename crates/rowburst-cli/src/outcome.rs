//! `result.json`: the numbers of a run.

use serde::Serialize;
use std::io::Write;

/// Everything that `result.json` says.
#[derive(Debug, Clone, Serialize)]
pub struct Outcome {
    pub version: &'static str,
    pub prior: String,
    pub tau: f64,
    pub tau_rule: &'static str,
    pub noise_sigma: f64,
    pub noise_sigma_source: &'static str,
    pub residual_over_sigma: f64,
    pub objective: f64,
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
    pub bad_pixels: usize,
    pub saturated_pixels: usize,
    pub threads: usize,
    /// Of the simulation in a demo; 0 else: nothing in a reconstruction is random.
    pub seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim: Option<f64>,
    pub warnings: Vec<String>,
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

/// Writes a line of results to standard output; a reader that has gone away is no error.
pub fn say(line: impl std::fmt::Display) {
    let _ = writeln!(std::io::stdout(), "{line}");
}
