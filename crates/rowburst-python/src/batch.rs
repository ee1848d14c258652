//! `rowburst._rowburst._Batch`: a recording on its way into an archive.

use crate::array::{mask_of_dask_frames, with_masked};
use crate::camera::PyCamera;
use crate::error::{Arguments, to_py_err};
use crate::frame::corrections_of;
use crate::frames::{ArrayFrames, PyFrames};
use crate::log;
use crate::operator::{Gram, model_of};
use crate::options::{Constants, options_from, self_calibration_from, tuning_of};
use crate::psf::psfs_of;
use crate::task::threads_from;
use crate::threads::{self, Threads, detached};
use crate::whole::{Number, Whole, optional_real};
use numpy::PyArray3;
use pyo3::prelude::*;
use rowburst::reconstruct::{Model, Options};
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_batch::{
    Batch, BatchFiles, BatchInputs, Event, FrameRow, RetryPolicy, Status, ThreadAllocation,
    load_batch, name_correction_file,
};
use rowburst_io::{Calibration, Capture, Experiment, Frames, read_metadata};
use rowburst_run::options::UserOptions;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A batch, begun or taken up again; any number of processes may have the same one.
#[pyclass(name = "_Batch", module = "rowburst._rowburst", frozen)]
pub struct PyBatch {
    batch: Batch,
    /// The threads of its runs, if it has some of its own.
    thread_count: Option<usize>,
}

/// A frame that is through.
type FrameRowTuple = (
    usize,
    String,
    bool,
    Option<f64>,
    Option<String>,
    f64,
    String,
);

fn to_tuple(row: &FrameRow) -> FrameRowTuple {
    (
        row.frame,
        row.name.clone(),
        row.status == Status::Done,
        row.residual_over_sigma,
        row.fit.clone(),
        row.seconds,
        row.message.clone(),
    )
}

#[pymethods]
impl PyBatch {
    #[new]
    #[pyo3(signature = (experiment, frames, out, *, psf=None, dark=None, flat=None,
        bad_pixels=None, prior=None, tau=None, noise_sigma=None, max_iterations=None,
        frame_period_us=None, self_calibrate="auto", keep_all_pixels=false))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        experiment: PathBuf,
        frames: PathBuf,
        out: PathBuf,
        psf: Option<PathBuf>,
        dark: Option<PathBuf>,
        flat: Option<PathBuf>,
        bad_pixels: Option<PathBuf>,
        prior: Option<String>,
        tau: Option<String>,
        noise_sigma: Option<Number>,
        max_iterations: Option<usize>,
        frame_period_us: Option<Number>,
        self_calibrate: &str,
        keep_all_pixels: bool,
    ) -> PyResult<Self> {
        let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
        let frame_period_us = optional_real(frame_period_us, "frame_period_us")?;
        refuse_guides(&experiment, &frames).map_err(to_py_err)?;
        let files = BatchFiles {
            experiment: &experiment,
            frames: &frames,
            calibration: Calibration {
                psf,
                dark,
                flat,
                bad_pixels,
            },
            options: UserOptions {
                prior: prior.as_deref(),
                tau: tau.as_deref(),
                noise_sigma,
                self_calibrate: Some(self_calibrate),
                keep_all_pixels,
                max_iterations,
                time_budget_s: None,
            },
            frame_period_us,
            version: env!("CARGO_PKG_VERSION"),
        };
        let open = |cancel: &Cancel| -> Result<Batch> {
            let loaded = load_batch(&files, cancel, &mut |_| ControlFlow::Continue(()))?;
            Batch::open(loaded.inputs, &out)
                .map_err(|e| name_correction_file(e, &frames, &loaded.calibration))
        };
        let batch = interruptibly(py, open)?.map_err(to_py_err)?;
        Ok(Self {
            batch,
            thread_count: None,
        })
    }

    /// The batch of a recording in memory or on disk, with the calibration as values.
    #[staticmethod]
    #[pyo3(signature = (camera, psf, frames, out, *, dark=None, flat=None, bad_pixels=None, prior="auto", tau=None,
        noise_sigma=None, max_iterations=None, frame_period_us=None, self_calibrate="auto", keep_all_pixels=false,
        tuning=None, threads=None))]
    #[allow(clippy::too_many_arguments)]
    fn of_values(
        py: Python<'_>,
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
        frames: &Bound<'_, PyAny>,
        out: PathBuf,
        dark: Option<&Bound<'_, PyAny>>,
        flat: Option<&Bound<'_, PyAny>>,
        bad_pixels: Option<&Bound<'_, PyAny>>,
        prior: &str,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<Number>,
        max_iterations: Option<Whole>,
        frame_period_us: Option<Number>,
        self_calibrate: &str,
        keep_all_pixels: bool,
        tuning: Option<Constants>,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let thread_count = threads_from(threads)?;
        let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
        let frame_period_us = optional_real(frame_period_us, "frame_period_us")?;
        let options = Options {
            self_calibration: self_calibration_from(self_calibrate)?,
            tuning: tuning_of(tuning)?,
            ..options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?
        };
        let mut corrections = corrections_of(dark, flat, bad_pixels)?;
        let camera = camera.grey()?;
        let psfs = psfs_of(psf, camera, corrections.dark.as_ref())?;
        let mask = mask_of_dask_frames(frames)?;
        let has_known_mask = mask.is_some();
        corrections.bad_pixels = with_masked(corrections.bad_pixels.take(), mask);
        let frames: Box<dyn Frames> = match frames.cast::<PyFrames>() {
            Ok(recording) => Box::new(SharedFrames(Arc::clone(&recording.get().frames))),
            Err(_) => Box::new(ArrayFrames {
                count: frames.len()?,
                array: frames.clone().unbind(),
                has_bias: corrections.dark.is_none()
                    && camera.sensor().bias_counts.is_some_and(|bias| bias > 0.0),
                has_known_mask,
            }),
        };
        crate::memory::check(camera, Model::cached_gram_bytes(camera))?;
        let inputs = BatchInputs {
            model: model_of(py, camera, &psfs, None, Gram::Cached)?,
            corrections,
            options,
            budget: None,
            frames,
            frame_period_us,
            version: env!("CARGO_PKG_VERSION").into(),
        };
        let batch = detached(py, || Batch::open(inputs, &out))?.map_err(to_py_err)?;
        Ok(Self {
            batch,
            thread_count,
        })
    }

    /// Number of frames in the recording.
    #[getter]
    fn count(&self) -> usize {
        self.batch.inputs().frames.count()
    }

    /// The frames of `first..end` that are not through.
    #[pyo3(signature = (first, end, retry_failed=false))]
    fn left(
        &self,
        py: Python<'_>,
        first: usize,
        end: usize,
        retry_failed: bool,
    ) -> PyResult<Vec<usize>> {
        let retry = match retry_failed {
            true => RetryPolicy::RetryFailed,
            false => RetryPolicy::SkipFailed,
        };
        let end = end.min(self.count());
        detached(py, || self.batch.pending(first..end, retry))?.map_err(to_py_err)
    }

    /// The prior of all frames and how it came about; chosen now where it is not yet.
    fn prior(&self, py: Python<'_>) -> PyResult<(String, String)> {
        let prior = interruptibly(py, |cancel| self.batch.prior(cancel, &|_| ()))?;
        let prior = prior.map_err(to_py_err)?;
        let prior = prior.expect("nobody stopped it, or an exception was raised");
        Ok((prior.prior, prior.reason))
    }

    /// What the recording has corrected of PSF and camera, as JSON; `None`: they are used as given.
    fn self_calibration(&self) -> Option<String> {
        let (found, _) = self.batch.self_calibration()?;
        Some(found.to_string())
    }

    /// Makes the videos of `frames`, with `threads` threads or those of the batch; a line for each frame.
    #[pyo3(signature = (frames, threads=None))]
    fn run(
        &self,
        py: Python<'_>,
        frames: Vec<usize>,
        threads: Option<Whole>,
    ) -> PyResult<Vec<FrameRowTuple>> {
        let threads = threads_from(threads)?.or(self.thread_count);
        let count = self.count();
        if let Some(bad) = frames.iter().find(|&&frame| frame >= count) {
            let rule = format!("the recording has the frames 0 to {}", count - 1);
            let error = rowburst::Error::input(Parameter::Frames, bad, rule, "Count them from 0.");
            return Err(to_py_err(error));
        }
        threads::check_process()?;
        let threads = threads.unwrap_or_else(threads::threads);
        let rows = Mutex::new(Vec::new());
        let ran = interruptibly(py, |cancel| -> Result<()> {
            let Some(prior) = self.batch.prior(cancel, &|_| ())? else {
                return Ok(());
            };
            let allocation =
                ThreadAllocation::new(threads, frames.len(), &self.batch.inputs().model, None);
            self.batch
                .run(&frames, &prior, allocation, &Arguments, cancel, &|event| {
                    if let Event::FrameFinished(row) = event
                        && let Ok(mut rows) = rows.lock()
                    {
                        rows.push(to_tuple(row));
                    }
                })
        })?;
        ran.map_err(to_py_err)?;
        Ok(rows.into_inner().unwrap_or_default())
    }

    /// Lines of all frames that are through, whoever made them.
    fn rows(&self, py: Python<'_>) -> PyResult<Vec<FrameRowTuple>> {
        let rows = detached(py, || self.batch.rows())?.map_err(to_py_err)?;
        Ok(rows.iter().map(to_tuple).collect())
    }

    /// Writes the table of all frames that are through; its path.
    fn write_table(&self, py: Python<'_>) -> PyResult<PathBuf> {
        detached(py, || self.batch.write_table())?.map_err(to_py_err)
    }

    /// The video of a frame as the archive has it; NaN where it has none.
    fn video<'py>(&self, py: Python<'py>, frame: usize) -> PyResult<Bound<'py, PyArray3<f32>>> {
        if frame >= self.count() {
            let rule = format!("the recording has {} frames", self.count());
            let error = rowburst::Error::input(Parameter::Frame, frame, rule, "Count them from 0.");
            return Err(to_py_err(error));
        }
        let video = detached(py, || self.batch.video(frame))?.map_err(to_py_err)?;
        crate::array::from_video(py, video)
    }
}

/// Refuses the pictures of a second camera, which belong to one frame.
fn refuse_guides(experiment: &Path, frames: &Path) -> Result<()> {
    let guides = Experiment::read_with(experiment, &read_metadata(frames))?.guides;
    if guides.is_empty() {
        return Ok(());
    }
    let error = Error::input(
        Parameter::Guide,
        format!("[[guide]] in the experiment, {} of them", guides.len()),
        "a guide belongs to one frame, and a batch does not take it",
        "Call rb.reconstruct for the frame of these pictures, or take [[guide]] out of the experiment file.",
    );
    Err(error.with_kind(ErrorKind::Unsupported).within(experiment))
}

/// A recording that Python holds as well.
struct SharedFrames(Arc<dyn Frames>);

impl Frames for SharedFrames {
    fn path(&self) -> &Path {
        self.0.path()
    }

    fn count(&self) -> usize {
        self.0.count()
    }

    fn name(&self, index: usize) -> String {
        self.0.name(index)
    }

    fn number(&self, index: usize) -> u64 {
        self.0.number(index)
    }

    fn read(&self, index: usize) -> Result<Capture> {
        self.0.read(index)
    }
}

/// Does `work` on a thread of its own; Ctrl-C cancels it and is raised when it has ended.
fn interruptibly<T: Send>(py: Python<'_>, work: impl FnOnce(&Cancel) -> T + Send) -> PyResult<T> {
    /// Between two looks for Ctrl-C.
    const POLL_INTERVAL: Duration = Duration::from_millis(20);
    let pool = Threads::borrow(None)?;
    log::begin(py)?;
    let cancel = Cancel::default();
    let mut interruption = None;
    let done = py.detach(|| {
        std::thread::scope(|scope| {
            let worker = scope.spawn(|| pool.install(|| work(&cancel)));
            while !worker.is_finished() {
                std::thread::park_timeout(POLL_INTERVAL);
                if interruption.is_none()
                    && let Err(error) = Python::attach(|py| {
                        log::flush(py)?;
                        py.check_signals()
                    })
                {
                    interruption = Some(error);
                    cancel.cancel();
                }
            }
            worker.join()
        })
    });
    if interruption.is_none() {
        log::flush(py)?;
    }
    match (interruption, done) {
        (Some(error), _) => Err(error),
        (None, Ok(done)) => Ok(done),
        (None, Err(panic)) => std::panic::resume_unwind(panic),
    }
}
