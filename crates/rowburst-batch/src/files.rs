//! A plan from files and what is typed, for the command line and for Python.

use crate::clock::Clock;
use crate::inputs::BatchInputs;
use crate::measurement::CORRECTIONS;
use rowburst::reconstruct::{Model, Options, Prior};
use rowburst::{Camera, Error, Result};
use rowburst_io::{Calibration, Experiment, FromMetadata, Metadata, open_recording, read_metadata};
use rowburst_run::inputs::{
    check_memory, naming_file, psf_path, read_corrections, read_psfs, resolve_calibration,
};
use rowburst_run::options::{
    parse_self_calibration, parse_time_budget, resolve_prior, resolve_tau,
};
use rowburst_zarr::{is_zarr, open_zarr_recording};
use std::path::Path;

/// The files of a batch, and what is asked for beside them.
pub struct BatchFiles<'a> {
    /// The experiment file.
    pub experiment: &'a Path,
    /// The recording.
    pub frames: &'a Path,
    /// Files that stand in for those of the experiment.
    pub calibration: Calibration,
    /// Name of the prior, instead of the experiment's.
    pub prior: Option<&'a str>,
    /// Rule for `τ`, instead of the experiment's.
    pub tau: Option<&'a str>,
    /// Noise in counts.
    pub noise_sigma: Option<f64>,
    /// When the recording corrects PSF and camera: `off`, `auto` or `on`; `None` is `auto`.
    pub self_calibrate: Option<&'a str>,
    /// Uses every pixel that is not marked as bad.
    pub keep_all_pixels: bool,
    /// Most iterations of a frame.
    pub max_iterations: Option<usize>,
    /// Seconds for each frame.
    pub time_budget_s: Option<f64>,
    /// From frame to frame, instead of the experiment's.
    pub frame_period_us: Option<f64>,
    /// Version of the program.
    pub version: &'a str,
}

/// A plan with the files that it is from.
pub struct LoadedBatch {
    /// What is to be done.
    pub inputs: BatchInputs,
    /// Where its corrections lie.
    pub calibration: Calibration,
    /// What is to be said of the PSF.
    pub note: Option<String>,
    /// What of the experiment came from the frames' metadata.
    pub from_metadata: FromMetadata,
}

/// Reads the files of a batch.
///
/// # Errors
/// Files that are missing or damaged, and choices that are none.
pub fn load_batch(files: &BatchFiles) -> Result<LoadedBatch> {
    let metadata = if is_zarr(files.frames) {
        Metadata::default()
    } else {
        read_metadata(files.frames)
    };
    let mut experiment = Experiment::read_with(files.experiment, &metadata)?;
    if let Some(mosaic) = experiment.bayer {
        return Err(Error::input(
            files.experiment.display().to_string(),
            format!("bayer = \"{}\"", mosaic.name()),
            "a batch makes grey videos",
            "Reconstruct frames one by one; each gives a video in colour.",
        ));
    }
    let camera = experiment.camera()?;
    let budget = parse_time_budget(files.time_budget_s)?;
    drop_short_period(&mut experiment, &camera);
    let options = Options {
        // A choice takes a run for each candidate: a budget has no time for it.
        prior: resolve_prior(files.prior, &experiment)?.or(budget.map(|_| Prior::STANDARD)),
        tau: resolve_tau(files.tau, &experiment)?,
        noise_sigma: files.noise_sigma,
        max_iterations: files.max_iterations,
        keep_all_pixels: files.keep_all_pixels,
        self_calibration: parse_self_calibration(files.self_calibrate)?,
        is_preview: budget.is_some(),
    };
    let own_period = files.frame_period_us;
    let frame_period_us = own_period.or(experiment.recording.frame_period_us);
    let calibration = resolve_calibration(files.calibration.clone(), &experiment);
    let psf_path = psf_path(&calibration, &experiment)?;
    let frames = if is_zarr(files.frames) {
        open_zarr_recording(files.frames)?
    } else {
        open_recording(files.frames)?
    };
    // The frames' files say where they end.
    let corrections = read_corrections(&calibration, None)?;
    let (psfs, note) = read_psfs(psf_path, &camera, corrections.dark.as_ref())?;
    check_memory(files.experiment, &camera)?;
    let inputs = BatchInputs {
        model: Model::new(&camera, psfs).with_cached_gram(),
        corrections,
        options,
        budget,
        frames,
        frame_period_us,
        version: files.version.into(),
    };
    Ok(LoadedBatch {
        inputs,
        calibration,
        note,
        from_metadata: experiment.from_metadata,
    })
}

/// A frame period of the metadata that is shorter than the readout is none of this shutter's.
fn drop_short_period(experiment: &mut Experiment, camera: &Camera) {
    let key = "frame_period_us";
    let from_metadata = &mut experiment.from_metadata;
    let Some(at) = from_metadata
        .values
        .iter()
        .position(|(name, _)| name == key)
    else {
        return;
    };
    let Some(period) = experiment.recording.frame_period_us else {
        return;
    };
    if let Err(error) = Clock::new(camera, period) {
        from_metadata.values.remove(at);
        from_metadata
            .warnings
            .push(format!("{key} of the metadata is not used: {error}"));
        experiment.recording.frame_period_us = None;
    }
}

/// Names the file in an error of a dark, a flat or a mask.
pub fn name_correction_file(error: Error, frames: &Path, calibration: &Calibration) -> Error {
    match &error {
        Error::Input { subject, .. } if CORRECTIONS.contains(&subject.as_str()) => {
            naming_file(error, frames, calibration)
        }
        _ => error,
    }
}
