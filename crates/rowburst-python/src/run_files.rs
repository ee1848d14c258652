//! The record of a run whose inputs are all files, which `rowburst rerun` repeats.

use crate::error::to_py_err;
use pyo3::prelude::*;
use rowburst_io::{Calibration, Experiment};
use rowburst_run::options::UserOptions;
use rowburst_run::{RequestParams, RunRecord};
use std::path::PathBuf;

/// The files of a run, beside its experiment file.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct RunFiles {
    frame: PathBuf,
    psf: Option<PathBuf>,
    dark: Option<PathBuf>,
    flat: Option<PathBuf>,
    bad_pixels: Option<PathBuf>,
    truth: Option<PathBuf>,
    direct: Option<PathBuf>,
    guides: Vec<PathBuf>,
    command: String,
}

/// The options of a run.
pub struct Asked<'a> {
    pub prior: &'a str,
    pub tau: Option<&'a str>,
    pub noise_sigma: Option<f64>,
    pub self_calibrate: &'a str,
    pub keep_all_pixels: bool,
    pub max_iterations: Option<usize>,
    pub time_budget_s: Option<f64>,
    pub debias: bool,
    pub seed: u64,
    pub guide_model: Option<&'a str>,
}

impl RunFiles {
    /// The record of a run that starts now.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn record(self, experiment: &Experiment, asked: &Asked<'_>) -> PyResult<RunRecord> {
        let params = RequestParams {
            calibration: Calibration {
                psf: self.psf,
                dark: self.dark,
                flat: self.flat,
                bad_pixels: self.bad_pixels,
            },
            options: UserOptions {
                prior: Some(asked.prior),
                tau: asked.tau,
                noise_sigma: asked.noise_sigma,
                self_calibrate: Some(asked.self_calibrate),
                keep_all_pixels: asked.keep_all_pixels,
                max_iterations: asked.max_iterations,
                time_budget_s: asked.time_budget_s,
            },
            truth: self.truth.as_deref(),
            direct: self.direct.as_deref(),
            guides: &self.guides,
            guide_model: asked.guide_model,
            debias: asked.debias,
            seed: asked.seed,
            ..RequestParams::default()
        };
        RunRecord::new(experiment, &self.frame, &params, &self.command).map_err(to_py_err)
    }
}
