//! A request to reconstruct a frame: what is read from files, and how it runs.

use crate::artifacts::{Artifacts, Output, Summary};
use crate::chunked::{ChunkedTask, run_chunked};
use crate::colour::ColourTask;
use crate::event::{Event, Observer};
use crate::guide::GuideTask;
use crate::inputs::{read_capture, read_truth};
use crate::memory::check_memory;
use crate::options::UserOptions;
use crate::options::parse_self_calibration;
use crate::setup::{Frame, Setup};
use crate::solve::solve;
use crate::task::Task;
use crate::traces::TraceRequest;
use rowburst::solve::StopReason;
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_io::{Calibration, Experiment, read_metadata};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The reconstruction of one frame, as values that have been checked.
pub enum Request {
    /// The whole video, in memory.
    Whole {
        /// The frame with its inputs.
        task: Box<Task>,
        /// The requested traces.
        traces: TraceRequest,
        /// Replaces the video by the refitted one.
        debias: bool,
    },
    /// A video too large for memory, in chunks of bins.
    Chunked(Box<ChunkedTask>),
    /// A raw colour frame, by planes.
    Colour(Box<ColourTask>),
}

/// The files of a request and its options.
#[derive(Default)]
pub struct RequestParams<'a> {
    /// Files that replace those of the experiment.
    pub calibration: Calibration,
    /// The options of the reconstruction.
    pub options: UserOptions<'a>,
    /// The true video.
    pub truth: Option<&'a Path>,
    /// A frame of the scene without the diffuser.
    pub direct: Option<&'a Path>,
    /// Pictures of the scene by a second camera, at unknown times; empty: those of the experiment file.
    pub guides: &'a [PathBuf],
    /// What the scene does with their light; see [`parse_guide_model`](crate::options::parse_guide_model).
    pub guide_model: Option<&'a str>,
    /// Regions of the field whose traces are requested; see [`TraceRequest::read`].
    pub regions: &'a [String],
    /// Files of photodiodes that are compared with the traces.
    pub photodiodes: &'a [PathBuf],
    /// Bins to reconstruct; `None`: all.
    pub bins: Option<Range<usize>>,
    /// Reconstructs in chunks of this many bins, or as many as fit where it is 0.
    pub bins_per_chunk: Option<usize>,
    /// Replaces the video by the refitted one.
    pub debias: bool,
    /// Seed of the simulation that made the frame; only reported.
    pub seed: u64,
    /// Stops the run, reading and set-up included.
    pub cancel: Cancel,
}

/// Reads an experiment file. Metadata of the frame's file fills the keys that are left open, which a note says.
///
/// # Errors
/// Those of [`Experiment::read_with`].
pub fn read_experiment(path: &Path, frame: &Path, observer: Observer) -> Result<Experiment> {
    let experiment = Experiment::read_with(path, &read_metadata(frame))?;
    if let Some(from_metadata) = experiment.from_metadata.summary_line() {
        let _ = observer(Event::Note(&from_metadata));
    }
    Ok(experiment)
}

impl Request {
    /// Reads and checks all inputs of the reconstruction of the file `frame`.
    ///
    /// # Errors
    /// A file that cannot be read, inputs that contradict each other, or too little memory.
    pub fn read(
        experiment: &Experiment,
        frame: &Path,
        params: RequestParams,
        observer: Observer,
    ) -> Result<Self> {
        if experiment.bayer.is_some() {
            refuse_colour(&params)?;
        }
        let cancel = &params.cancel;
        let setup = Setup::read(
            experiment,
            params.calibration,
            &params.options,
            cancel,
            observer,
        )?;
        cancel.check()?;
        let frame = Frame::read(frame)?;
        cancel.check()?;
        if let Some(mosaic) = experiment.bayer {
            let task = ColourTask {
                setup,
                mosaic,
                frame,
                seed: params.seed,
                debias: params.debias,
            };
            task.check()?;
            check_memory(&experiment.path, &task.first_plane()?, 0)?;
            return Ok(Self::Colour(Box::new(task)));
        }
        let mut task = setup.task(&frame, params.bins)?;
        if let Some(bins_per_chunk) = params.bins_per_chunk {
            let task = ChunkedTask::new(task, bins_per_chunk)?;
            return Ok(Self::Chunked(Box::new(task)));
        }
        check_memory(&experiment.path, &task.camera, 0)?;
        let truth = params.truth.map(|path| read_truth(path, &task.camera));
        task.truth = truth.transpose()?;
        cancel.check()?;
        task.truth_file = params.truth.map(Path::to_path_buf);
        let direct = params.direct.map(read_capture).transpose()?;
        task.direct = direct.map(|capture| capture.image);
        task.guide = GuideTask::read(params.guides, experiment, params.guide_model, cancel)?;
        task.seed = params.seed;
        let shape = task.camera.video_shape();
        Ok(Self::Whole {
            task: Box::new(task),
            traces: TraceRequest::read(params.regions, params.photodiodes, shape)?,
            debias: params.debias,
        })
    }

    /// Reconstructs the frame and writes the folder of `output`. `process_start` is the start of the program, the zero of
    /// the convergence curve's time axis.
    ///
    /// # Errors
    /// Those of [`solve`] and [`run_chunked`], and failed writes.
    pub fn run(
        self,
        output: &Output,
        process_start: Instant,
        observer: Observer,
    ) -> Result<Artifacts> {
        match self {
            Self::Whole {
                task,
                traces,
                debias,
            } => {
                let mut completed = solve(*task, process_start, observer)?;
                let cancel = completed.task.cancel.clone();
                let stop_reason = completed.reconstruction.stop_reason;
                let is_stopped = stop_reason == StopReason::Interrupted || cancel.is_cancelled();
                let traces = if is_stopped {
                    completed.traces(traces.without_errors(), false)
                } else {
                    completed.evaluate(traces, debias)
                };
                let _ = observer(Event::Writing);
                let summary = if is_stopped {
                    completed.write_stopped(&traces, output)?
                } else {
                    completed.write_until(&traces, output, &cancel)?
                };
                let lines = traces.summary_lines();
                Ok(Artifacts::new(
                    output,
                    Summary::Whole(summary.into()),
                    lines,
                ))
            }
            Self::Chunked(task) => run_chunked(&task, output, observer),
            Self::Colour(task) => task.run(output, process_start, observer),
        }
    }
}

/// Refuses what belongs to one grey video.
fn refuse_colour(params: &RequestParams) -> Result<()> {
    let self_calibration = parse_self_calibration(params.options.self_calibrate)?;
    let given = [
        (Parameter::Truth, params.truth.is_some()),
        (Parameter::Direct, params.direct.is_some()),
        (Parameter::Guide, !params.guides.is_empty()),
        (Parameter::Region, !params.regions.is_empty()),
        (Parameter::Photodiode, !params.photodiodes.is_empty()),
        (Parameter::Bins, params.bins.is_some()),
        (Parameter::PartBins, params.bins_per_chunk.is_some()),
        (Parameter::SelfCalibrate, self_calibration.is_on()),
    ];
    match given.iter().find(|(_, given)| *given) {
        None => Ok(()),
        Some((parameter, _)) => Err(Error::input(
            *parameter,
            "a raw Bayer frame",
            "its four planes are reconstructed separately, and the option is for one video",
            "Leave it out.",
        )
        .with_kind(ErrorKind::Unsupported)),
    }
}
