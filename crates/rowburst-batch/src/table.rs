//! The table of a batch: a line for each frame that is through.

use crate::clock::Clock;
use rowburst::error::Subject;
use rowburst::reconstruct::{Reconstruction, Verdict};
use rowburst::{Error, Result};
use rowburst_io::Frames;
use serde::{Deserialize, Serialize};

/// What became of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// Its video is in the archive.
    Done,
    /// It cannot be read or reconstructed; the archive has NaN there.
    Failed,
}

/// A frame that is through.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRow {
    /// Its index in the recording and in the archive.
    pub frame: usize,
    /// Its file, or page.
    pub name: String,
    /// What became of it.
    pub status: Status,
    /// Prior of the video.
    pub prior: Option<String>,
    /// Weight of the prior.
    pub tau: Option<f64>,
    /// Noise of a pixel of weight 1, in counts.
    pub noise_sigma: Option<f64>,
    /// Rms of the residual over σ.
    pub residual_over_sigma: Option<f64>,
    /// good, suspicious or bad.
    pub fit: Option<String>,
    /// Iterations of the solver.
    pub iterations: Option<usize>,
    /// Why it stopped.
    pub stop_reason: Option<String>,
    /// Saturated pixels, which were left out.
    pub saturated_pixels: Option<usize>,
    /// Noise of the sensor and error of the model together, in counts.
    #[serde(default)]
    pub effective_sigma: Option<f64>,
    /// Part of the pixels that are foreign and were left out.
    #[serde(default)]
    pub excluded_fraction: Option<f64>,
    /// From reading to the video, on its threads.
    pub seconds: f64,
    /// What is wrong, if anything.
    pub message: String,
}

impl FrameRow {
    /// The line of a video.
    pub(crate) fn done(
        frame: usize,
        name: String,
        found: &Reconstruction,
        saturated: usize,
        seconds: f64,
    ) -> Self {
        let is_good = found.fit.verdict == Verdict::Good;
        Self {
            frame,
            name,
            status: Status::Done,
            prior: Some(found.prior.to_string()),
            tau: Some(found.tau),
            noise_sigma: Some(found.sigma),
            residual_over_sigma: Some(found.residual_over_sigma),
            fit: Some(found.fit.verdict.name().into()),
            iterations: Some(found.iterations),
            stop_reason: Some(found.stop_reason.name().into()),
            saturated_pixels: Some(saturated),
            effective_sigma: Some(found.effective_sigma),
            excluded_fraction: Some(found.excluded_fraction()),
            seconds,
            message: if is_good {
                String::new()
            } else {
                found.fit.reason.clone()
            },
        }
    }

    /// The line of a frame that gives no video.
    pub(crate) fn failed(frame: usize, name: String, message: String, seconds: f64) -> Self {
        Self {
            frame,
            name,
            status: Status::Failed,
            prior: None,
            tau: None,
            noise_sigma: None,
            residual_over_sigma: None,
            fit: None,
            iterations: None,
            stop_reason: None,
            saturated_pixels: None,
            effective_sigma: None,
            excluded_fraction: None,
            seconds,
            message,
        }
    }
}

/// A line as it stands in `frames.csv`.
#[derive(Serialize)]
struct Line<'a> {
    frame: usize,
    name: &'a str,
    number: u64,
    start_us: Option<f64>,
    status: Status,
    prior: Option<&'a str>,
    tau: Option<f64>,
    noise_sigma: Option<f64>,
    residual_over_sigma: Option<f64>,
    fit: Option<&'a str>,
    iterations: Option<usize>,
    stop_reason: Option<&'a str>,
    saturated_pixels: Option<usize>,
    effective_sigma: Option<f64>,
    excluded_fraction: Option<f64>,
    seconds: String,
    message: &'a str,
}

/// `frames.csv`: a header and a line for each row.
pub(crate) fn csv_of(
    rows: &[FrameRow],
    frames: &dyn Frames,
    clock: Option<Clock>,
) -> Result<Vec<u8>> {
    let starts = clock.map(|clock| clock.starts_us(frames));
    let mut writer = csv::Writer::from_writer(Vec::new());
    let fault = |e: csv::Error| Error::work(Subject::named("frames.csv"), e, "Report this.");
    for row in rows {
        let line = Line {
            frame: row.frame,
            name: &row.name,
            number: frames.number(row.frame),
            start_us: starts.as_ref().map(|starts| starts[row.frame]),
            status: row.status,
            prior: row.prior.as_deref(),
            tau: row.tau,
            noise_sigma: row.noise_sigma,
            residual_over_sigma: row.residual_over_sigma,
            fit: row.fit.as_deref(),
            iterations: row.iterations,
            stop_reason: row.stop_reason.as_deref(),
            saturated_pixels: row.saturated_pixels,
            effective_sigma: row.effective_sigma,
            excluded_fraction: row.excluded_fraction,
            seconds: format!("{:.3}", row.seconds),
            message: &row.message,
        };
        writer.serialize(line).map_err(fault)?;
    }
    writer
        .into_inner()
        .map_err(|e| Error::work(Subject::named("frames.csv"), e, "Report this."))
}
