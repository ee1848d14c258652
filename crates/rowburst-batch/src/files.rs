//! A plan from files and what is typed, for the command line and for Python.

use crate::clock::Clock;
use crate::inputs::BatchInputs;
use crate::measurement::is_of_correction;
use rowburst::reconstruct::{Model, Options, Prior};
use rowburst::{Cancel, Error, ErrorKind, Result};
use rowburst_io::{Calibration, Experiment, FromMetadata, Metadata, open_recording, read_metadata};
use rowburst_run::check_memory;
use rowburst_run::inputs::naming_file;
use rowburst_run::options::UserOptions;
use rowburst_run::{Event, Observer, Setup};
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
    /// The options of the reconstruction; the time budget is that of each frame.
    pub options: UserOptions<'a>,
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
    /// What of the experiment came from the frames' metadata.
    pub from_metadata: FromMetadata,
}

/// Reads the files of a batch, until it is cancelled. `observer` hears the notes on them.
///
/// # Errors
/// Files that are missing or damaged, choices that are none, too little memory, and a request to stop.
pub fn load_batch(files: &BatchFiles, cancel: &Cancel, observer: Observer) -> Result<LoadedBatch> {
    let metadata = if is_zarr(files.frames) {
        Metadata::default()
    } else {
        read_metadata(files.frames)
    };
    let mut experiment = Experiment::read_with(files.experiment, &metadata)?;
    if let Some(mosaic) = experiment.bayer {
        return Err(Error::input(
            files.experiment,
            format!("bayer = \"{}\"", mosaic.name()),
            "a batch makes grey videos",
            "Reconstruct frames one by one; each gives a video in colour.",
        )
        .with_kind(ErrorKind::Unsupported));
    }
    drop_short_period(&mut experiment)?;
    let setup = Setup::read(
        &experiment,
        files.calibration.clone(),
        &files.options,
        cancel,
        observer,
    )?;
    if let Some(from_metadata) = setup.from_metadata.summary_line() {
        let _ = observer(Event::Note(&from_metadata));
    }
    let frames = if is_zarr(files.frames) {
        open_zarr_recording(files.frames)?
    } else {
        open_recording(files.frames)?
    };
    let kept = Model::cached_gram_bytes(&setup.camera);
    check_memory(files.experiment, &setup.camera, kept)?;
    let budget = setup.budget;
    let own_period = files.frame_period_us;
    let model = Model::new(&setup.camera, setup.psfs)
        .with_cancel(cancel)
        .with_cached_gram();
    cancel.check()?;
    let inputs = BatchInputs {
        model,
        corrections: setup.corrections,
        options: Options {
            // A choice takes a run for each candidate: a budget has no time for it.
            prior: setup.options.prior.or(budget.map(|_| Prior::STANDARD)),
            is_preview: budget.is_some(),
            ..setup.options
        },
        budget,
        frames,
        frame_period_us: own_period.or(experiment.recording.frame_period_us),
        version: files.version.into(),
    };
    Ok(LoadedBatch {
        inputs,
        calibration: setup.calibration,
        from_metadata: setup.from_metadata,
    })
}

/// A frame period of the metadata that is shorter than the readout is none of this shutter's.
fn drop_short_period(experiment: &mut Experiment) -> Result<()> {
    let camera = experiment.camera()?;
    let key = "frame_period_us";
    let from_metadata = &mut experiment.from_metadata;
    let Some(at) = from_metadata
        .values
        .iter()
        .position(|(name, _)| name == key)
    else {
        return Ok(());
    };
    let Some(period) = experiment.recording.frame_period_us else {
        return Ok(());
    };
    if let Err(error) = Clock::new(&camera, period) {
        from_metadata.values.remove(at);
        from_metadata
            .warnings
            .push(format!("{key} of the metadata is not used: {error}"));
        experiment.recording.frame_period_us = None;
    }
    Ok(())
}

/// Names the file in an error of a dark, a flat or a mask.
pub fn name_correction_file(error: Error, frames: &Path, calibration: &Calibration) -> Error {
    if is_of_correction(&error) {
        return naming_file(error, frames, calibration);
    }
    error
}
