//! A sweep: one run for each combination of values, and one table that compares them.

use crate::format::short;
use crate::summary::ReconstructionSummary;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// A combination: an option and its value each.
pub type SweepPoint = Vec<(&'static str, String)>;

/// What a run of a point gave; `None` where it does not apply.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SweepRow {
    /// The point, as `tau=0.1 prior=tv`.
    pub point: String,
    /// The folder of the result, or the archive.
    pub output: String,
    /// The prior that was used.
    pub prior: Option<String>,
    /// The weight of the prior at the end.
    pub tau: Option<f64>,
    /// Rms of the residual over σ.
    pub residual_over_sigma: Option<f64>,
    /// Against the truth, where there is one.
    pub psnr_db: Option<f64>,
    /// Against the truth, where there is one.
    pub ssim: Option<f64>,
    /// Of one frame, or how many of all frames are good.
    pub fit: Option<String>,
    /// Time of the whole run.
    pub seconds: f64,
    /// Why there is nothing.
    pub error: Option<String>,
}

impl SweepRow {
    /// The row of a run that gave `summary`.
    #[must_use]
    pub fn with_summary(self, summary: &ReconstructionSummary) -> Self {
        Self {
            prior: Some(summary.prior.clone()),
            tau: Some(summary.tau),
            residual_over_sigma: Some(summary.residual_over_sigma),
            psnr_db: summary.psnr_db,
            ssim: summary.ssim,
            fit: Some(summary.fit.to_string()),
            ..self
        }
    }
}

/// A point in words.
pub fn sweep_label(point: &SweepPoint) -> String {
    let parts: Vec<String> = point.iter().map(|(k, v)| format!("{k}={v}")).collect();
    parts.join(" ")
}

/// Where the results of the point with this label go: a folder of `output` that every file system can name.
pub fn sweep_path(output: &Path, label: &str, end: &str) -> PathBuf {
    let safe = |c: char| match c {
        c if c.is_ascii_alphanumeric() || "=.+-".contains(c) => c,
        '*' => 'x',
        _ => '_',
    };
    let name: String = label.chars().map(safe).collect();
    output.join(name + end)
}

/// The text of `sweep.csv`.
pub fn sweep_csv(rows: &[SweepRow]) -> String {
    let mut text =
        String::from("point,prior,tau,residual_over_sigma,psnr_db,ssim,fit,seconds,output,error\n");
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    let number = |value: Option<f64>| value.map_or(String::new(), |v| v.to_string());
    for row in rows {
        let text_cell = |value: &Option<String>| value.as_deref().map_or(String::new(), quoted);
        let cells = [
            quoted(&row.point),
            text_cell(&row.prior),
            number(row.tau),
            number(row.residual_over_sigma),
            number(row.psnr_db),
            number(row.ssim),
            text_cell(&row.fit),
            row.seconds.to_string(),
            quoted(&row.output),
            text_cell(&row.error),
        ];
        text += &(cells.join(",") + "\n");
    }
    text
}

/// The table for a person, with a heading.
pub fn sweep_lines(rows: &[SweepRow]) -> Vec<String> {
    let number = |value: Option<f64>| value.map_or("-".into(), short);
    let mut table =
        vec![["point", "tau", "residual/σ", "PSNR dB", "fit", "seconds"].map(String::from)];
    table.extend(rows.iter().map(|row| {
        [
            row.point.clone(),
            number(row.tau),
            number(row.residual_over_sigma),
            row.psnr_db.map_or("-".into(), |v| format!("{v:.2}")),
            match &row.error {
                Some(error) => format!("failed: {error}"),
                None => row.fit.clone().unwrap_or_default(),
            },
            short(row.seconds),
        ]
    }));
    let width = |column: usize| table.iter().map(|r| r[column].chars().count()).max();
    let widths: Vec<usize> = (0..4).map(|c| width(c).unwrap_or(0)).collect();
    let line = |row: &[String; 6]| {
        let padded: Vec<String> = widths
            .iter()
            .zip(row)
            .map(|(&w, cell)| format!("{cell:w$}"))
            .collect();
        format!("{}  {:>8}  {}", padded.join("  "), row[5], row[4])
    };
    table.iter().map(line).collect()
}
