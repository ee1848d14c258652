//! `rowburst.reconstruct`.

use crate::array::{finite_image, path_of, video};
use crate::camera::PyCamera;
use crate::error::{subject, to_py_err};
use crate::experiment::PyExperiment;
use crate::frame::{corrections_of, frame_of};
use crate::interrupt::{Answer, OnProgress, PyCancel, Reporter, interruptibly_with};
use crate::operator::{Gram, model_of};
use crate::options::{
    Constants, iterations_from, options_from, prior_from, self_calibration_from, tau_from,
    tuning_of,
};
use crate::psf::psfs_of;
use crate::result::{PyProgress, PyReconstruction};
use crate::run_files::{Asked, RunFiles};
use crate::threads::checked_count;
use crate::whole::{Number, Whole, is_bool, optional, optional_real, real_pairs};
use numpy::{PyArray1, PyArray4, PyArrayMethods};
use pyo3::prelude::*;
use rowburst::error::Subject;
use rowburst::guide::{Guide, GuideExposure};
use rowburst::measurement::Corrections;
use rowburst::reconstruct::{Model, Options};
use rowburst::solve::StopReason;
use rowburst::{Camera, Cancel, Error, ErrorKind, Parameter, Result, Video};
use rowburst_io::{ForeignFiles, OutputFolder};
use rowburst_run::inputs::{checked_truth, read_truth};
use rowburst_run::options::{parse_guide_model, parse_time_budget};
use rowburst_run::{
    Bias, ChunkedTask, ColourTask, CompletedTask, Event, GuideTask, MovieStyle, Output, RunRecord,
    Setup, Task, TraceRequest, merge_planes, run_chunked, solve, solve_with_model,
};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Instant;

/// A frame, and what it is compared with.
struct FrameInputs<'a, 'py> {
    frame: &'a Bound<'py, PyAny>,
    truth: Option<&'a Bound<'py, PyAny>>,
    direct: Option<&'a Bound<'py, PyAny>>,
    time_budget_s: Option<f64>,
    seed: Whole,
    /// See [`frame_of`].
    bias: Option<Bias>,
}

/// The video of a frame.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, *, prior="auto", tau=None, noise_sigma=None,
    time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None,
    direct=None, progress=None, seed=Whole::of(0), experiment=None, self_calibrate="auto", keep_all_pixels=false,
    debias=false, threads=None, tuning=None, corrected=false, guide=None, guide_exposures_us=None, guide_model=None,
    files=None),
    text_signature = "(frame, camera, psf, *, prior='auto', tau=None, noise_sigma=None, time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None, direct=None, progress=None, seed=0, experiment=None, self_calibrate='auto', keep_all_pixels=False, debias=False, threads=None, tuning=None, corrected=False, guide=None, guide_exposures_us=None, guide_model=None, files=None)")]
#[allow(clippy::too_many_arguments)]
pub fn reconstruct(
    py: Python<'_>,
    frame: &Bound<'_, PyAny>,
    camera: &PyCamera,
    psf: &Bound<'_, PyAny>,
    prior: &str,
    tau: Option<&Bound<'_, PyAny>>,
    noise_sigma: Option<Number>,
    time_budget_s: Option<Number>,
    max_iterations: Option<Whole>,
    dark: Option<&Bound<'_, PyAny>>,
    flat: Option<&Bound<'_, PyAny>>,
    bad_pixels: Option<&Bound<'_, PyAny>>,
    truth: Option<&Bound<'_, PyAny>>,
    direct: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    seed: Whole,
    experiment: Option<&PyExperiment>,
    self_calibrate: &str,
    keep_all_pixels: bool,
    debias: bool,
    threads: Option<Whole>,
    tuning: Option<Constants>,
    corrected: bool,
    guide: Option<Vec<Bound<'_, PyAny>>>,
    guide_exposures_us: Option<Vec<(Number, Number)>>,
    guide_model: Option<&str>,
    files: Option<RunFiles>,
) -> PyResult<PyReconstruction> {
    let began = Instant::now();
    let thread_count = threads_from(threads)?;
    let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
    let time_budget_s = optional_real(time_budget_s, "time_budget_s")?;
    let guide_exposures_us = guide_exposures_us
        .map(|pairs| real_pairs(pairs, "guide_exposures_us"))
        .transpose()?;
    let record = match (files, experiment.and_then(|e| e.file.as_ref())) {
        (Some(files), Some(experiment)) => {
            let text = tau.map(|tau| tau.str()?.extract::<String>()).transpose()?;
            let asked = Asked {
                prior,
                tau: text.as_deref(),
                noise_sigma,
                self_calibrate,
                keep_all_pixels,
                max_iterations: optional(max_iterations.clone(), "max_iterations")?,
                time_budget_s,
                debias,
                seed: seed.clone().named("seed")? as u64,
                guide_model,
            };
            Some(files.record(experiment, &asked)?)
        }
        _ => None,
    };
    let options = Options {
        self_calibration: self_calibration_from(self_calibrate)?,
        tuning: tuning_of(tuning)?,
        ..options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?
    };
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let setup = setup_of(camera.grey()?, psf, corrections, options, experiment)?;
    let inputs = FrameInputs {
        frame,
        truth,
        direct,
        time_budget_s,
        seed,
        bias: corrected.then_some(Bias::Subtracted),
    };
    let mut task = task_of(setup, &inputs)?;
    task.guide = match guide {
        Some(pictures) => guide_from(&pictures, guide_exposures_us, guide_model)?,
        None => guide_of(experiment, guide_exposures_us, guide_model)?,
    };
    let run = Run {
        thread_count,
        debias,
        progress,
        began,
        record,
        ..Run::new()
    };
    run.start(py, task)
}

/// A set-up whose operator and Gram blocks all frames share.
#[pyclass(name = "_Reconstructor", module = "rowburst._rowburst", frozen)]
pub struct PyReconstructor {
    setup: Setup,
    /// The threads of these frames alone, if they have some.
    thread_count: Option<usize>,
    /// Whether bias, dark and flat are applied to its frames already.
    is_corrected: bool,
    /// The pictures of the experiment.
    guide: Option<GuideTask>,
    model: Model,
}

#[pymethods]
impl PyReconstructor {
    #[new]
    #[pyo3(signature = (camera, psf, *, prior="auto", tau=None, noise_sigma=None, max_iterations=None, dark=None,
        flat=None, bad_pixels=None, experiment=None, self_calibrate="auto", keep_all_pixels=false, threads=None,
        tuning=None, corrected=false))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
        prior: &str,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<Number>,
        max_iterations: Option<Whole>,
        dark: Option<&Bound<'_, PyAny>>,
        flat: Option<&Bound<'_, PyAny>>,
        bad_pixels: Option<&Bound<'_, PyAny>>,
        experiment: Option<&PyExperiment>,
        self_calibrate: &str,
        keep_all_pixels: bool,
        threads: Option<Whole>,
        tuning: Option<Constants>,
        corrected: bool,
    ) -> PyResult<Self> {
        let thread_count = threads_from(threads)?;
        let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
        let options = Options {
            self_calibration: self_calibration_from(self_calibrate)?,
            tuning: tuning_of(tuning)?,
            ..options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?
        };
        let corrections = corrections_of(dark, flat, bad_pixels)?;
        let setup = setup_of(camera.grey()?, psf, corrections, options, experiment)?;
        crate::memory::check(&setup.camera, Model::cached_gram_bytes(&setup.camera))?;
        let model = model_of(py, &setup.camera, &setup.psfs, thread_count, Gram::Cached)?;
        Ok(Self {
            guide: guide_of(experiment, None, None)?,
            setup,
            thread_count,
            is_corrected: corrected,
            model,
        })
    }

    /// Checks the values that replace those of the set-up.
    #[pyo3(signature = (*, prior=None, tau=None, noise_sigma=None, max_iterations=None))]
    fn check(
        &self,
        prior: Option<&str>,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<Number>,
        max_iterations: Option<Whole>,
    ) -> PyResult<()> {
        let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
        let options = self.options(prior, tau, noise_sigma, max_iterations)?;
        options.check().map_err(to_py_err)?;
        let bins = self.setup.camera.video_shape().bins;
        match options.prior {
            Some(prior) => prior.check_bins(bins).map_err(to_py_err),
            None => Ok(()),
        }
    }

    /// The video of a frame. `cancel` ends it from another thread; `prior`, `tau`, `noise_sigma` and `max_iterations`
    /// replace those of the set-up. With `raw` the bias is in the frame, of whatever numbers it is.
    #[pyo3(signature = (frame, *, truth=None, direct=None, progress=None, seed=Whole::of(0), time_budget_s=None,
        debias=false, cancel=None, prior=None, tau=None, noise_sigma=None, max_iterations=None, raw=false))]
    #[allow(clippy::too_many_arguments)]
    fn reconstruct(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, PyAny>,
        truth: Option<&Bound<'_, PyAny>>,
        direct: Option<&Bound<'_, PyAny>>,
        progress: Option<Py<PyAny>>,
        seed: Whole,
        time_budget_s: Option<Number>,
        debias: bool,
        cancel: Option<&PyCancel>,
        prior: Option<&str>,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<Number>,
        max_iterations: Option<Whole>,
        raw: bool,
    ) -> PyResult<PyReconstruction> {
        let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
        let inputs = FrameInputs {
            frame,
            truth,
            direct,
            time_budget_s: optional_real(time_budget_s, "time_budget_s")?,
            seed,
            bias: if self.is_corrected {
                Some(Bias::Subtracted)
            } else {
                raw.then_some(Bias::Contained)
            },
        };
        let began = Instant::now();
        let setup = Setup {
            options: self.options(prior, tau, noise_sigma, max_iterations)?,
            ..self.setup.clone()
        };
        let task = Task {
            guide: self.guide.clone(),
            ..task_of(setup, &inputs)?
        };
        let run = Run {
            model: Some(self.model.clone()),
            thread_count: self.thread_count,
            debias,
            progress,
            began,
            cancel: cancel.map(|c| c.cancel.clone()).unwrap_or_default(),
            record: None,
        };
        run.start(py, task)
    }
}

impl PyReconstructor {
    /// The options of the set-up with other values of some.
    fn options(
        &self,
        prior: Option<&str>,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<f64>,
        max_iterations: Option<Whole>,
    ) -> PyResult<Options> {
        let options = self.setup.options;
        Ok(Options {
            prior: prior.map_or(Ok(options.prior), prior_from)?,
            tau: tau.map_or(Ok(options.tau), |tau| tau_from(Some(tau)))?,
            noise_sigma: noise_sigma.or(options.noise_sigma),
            max_iterations: iterations_from(max_iterations)?.or(options.max_iterations),
            ..options
        })
    }
}

/// The pictures of an experiment.
fn guide_of(
    experiment: Option<&PyExperiment>,
    exposures_us: Option<Vec<(f64, f64)>>,
    model: Option<&str>,
) -> PyResult<Option<GuideTask>> {
    if exposures_us.is_some() {
        let rule = "they are those of the pictures of guide=";
        let remedy = "Give guide=, or leave them out: those of an experiment are in its file.";
        return Err(to_py_err(Error::input(
            subject("guide_exposures_us"),
            "exposures without pictures",
            rule,
            remedy,
        )));
    }
    let model = parse_guide_model(model).map_err(to_py_err)?;
    let guides = experiment.map(|e| e.guides.clone()).unwrap_or_default();
    Ok((!guides.is_empty()).then_some(GuideTask { guides, model }))
}

/// The pictures of a second camera, with the middle of the exposure and its length in µs where they are known; `None`
/// without any.
fn guide_from(
    pictures: &[Bound<'_, PyAny>],
    exposures_us: Option<Vec<(f64, f64)>>,
    model: Option<&str>,
) -> PyResult<Option<GuideTask>> {
    let exposures_us = exposures_us.unwrap_or_default();
    if !exposures_us.is_empty() && exposures_us.len() != pictures.len() {
        return Err(to_py_err(Error::input(
            Parameter::Guide,
            format!(
                "{} exposures for {} pictures",
                exposures_us.len(),
                pictures.len()
            ),
            "there is an exposure for each picture, or none",
            "Give a pair of time and exposure, in µs, for each picture.",
        )));
    }
    let mut exposures = exposures_us.into_iter();
    let guides = pictures.iter().map(|picture| {
        Ok(Guide {
            image: finite_image(picture, "guide")?,
            exposure: exposures
                .next()
                .map(|(time_us, exposure_us)| GuideExposure {
                    time_us,
                    exposure_us,
                }),
        })
    });
    let guides: Vec<Guide> = guides.collect::<PyResult<_>>()?;
    let model = parse_guide_model(model).map_err(to_py_err)?;
    Ok((!guides.is_empty()).then_some(GuideTask { guides, model }))
}

/// What the frames of a camera share.
pub fn setup_of(
    camera: &Camera,
    psf: &Bound<'_, PyAny>,
    corrections: Corrections,
    options: Options,
    experiment: Option<&PyExperiment>,
) -> PyResult<Setup> {
    let psfs = psfs_of(psf, camera, corrections.dark.as_ref())?;
    Ok(Setup {
        corrections,
        options,
        from_metadata: experiment
            .map(|e| e.from_metadata.clone())
            .unwrap_or_default(),
        ..Setup::new(camera.clone(), psfs)
    })
}

/// The threads of a caller alone, if it asks for some.
pub fn threads_from(threads: Option<Whole>) -> PyResult<Option<usize>> {
    optional(threads, "threads")?.map(checked_count).transpose()
}

/// A frame of `setup` as a task.
fn task_of(setup: Setup, inputs: &FrameInputs<'_, '_>) -> PyResult<Task> {
    let seed = inputs.seed.clone().named("seed")? as u64;
    let budget = parse_time_budget(inputs.time_budget_s).map_err(to_py_err)?;
    let (frame, setup) = frame_of(inputs.frame, Setup { budget, ..setup }, inputs.bias)?;
    let mut task = setup.task(&frame, None).map_err(to_py_err)?;
    crate::memory::check(&task.camera, 0)?;
    let truth = inputs.truth.map(|value| truth_of(value, &task.camera));
    task.truth = truth.transpose()?;
    let direct = inputs.direct.map(|v| finite_image(v, "direct"));
    task.direct = direct.transpose()?;
    Ok(Task { seed, ..task })
}

/// The true video; the name of a file is read.
fn truth_of(value: &Bound<'_, PyAny>, camera: &Camera) -> PyResult<Video> {
    let truth = match path_of(value) {
        Some(path) => value.py().detach(|| read_truth(&path, camera)),
        None => checked_truth(video(value, "truth")?, Parameter::Truth.into(), camera),
    };
    truth.map_err(to_py_err)
}

/// How a frame is reconstructed.
struct Run {
    /// That of several frames.
    model: Option<Model>,
    thread_count: Option<usize>,
    debias: bool,
    progress: Option<Py<PyAny>>,
    began: Instant,
    cancel: Cancel,
    record: Option<RunRecord>,
}

impl Run {
    fn new() -> Self {
        Self {
            model: None,
            thread_count: None,
            debias: false,
            progress: None,
            began: Instant::now(),
            cancel: Cancel::default(),
            record: None,
        }
    }

    /// Reconstructs the frame of `task`.
    fn start(self, py: Python<'_>, task: Task) -> PyResult<PyReconstruction> {
        let Self {
            model,
            thread_count,
            debias,
            progress,
            began,
            cancel,
            record,
        } = self;
        let watcher = Watcher {
            thread_count,
            progress,
            began,
            cancel,
        };
        let found = watcher.observe(py, move |watch| {
            let task = Task {
                cancel: watch.reporter.cancel().clone(),
                ..task
            };
            let completed = match model {
                Some(model) => {
                    solve_with_model(&model, task, began, &mut |event| watch.answer(event))?
                }
                None => solve(task, began, &mut |event| watch.answer(event))?,
            };
            Ok(watch.result(completed, debias))
        })?;
        Ok(found.with_record(record))
    }
}

/// Shows the events of a run to the progress function.
struct Watch<'r, T> {
    reporter: &'r Reporter<PyProgress, T>,
    began: Instant,
}

impl<T> Watch<'_, T> {
    fn answer(&self, event: Event) -> ControlFlow<StopReason> {
        let Event::Iteration {
            progress, metrics, ..
        } = event
        else {
            return ControlFlow::Continue(());
        };
        let level = metrics.residual_over_sigma;
        let seconds = self.began.elapsed().as_secs_f64();
        let iteration = || PyProgress::new(progress, level, seconds);
        match self.reporter.ask(iteration) {
            Answer::Continue => ControlFlow::Continue(()),
            Answer::Finish | Answer::Abandon => ControlFlow::Break(StopReason::Interrupted),
        }
    }

    /// Ends the work where nobody waits for the result any more.
    fn check_wanted(&self) -> Result<()> {
        if self.reporter.is_abandoned() {
            let remedy = "Call it again.";
            return Err(
                Error::work(Subject::named("reconstruction"), "stopped", remedy)
                    .with_kind(ErrorKind::Cancelled),
            );
        }
        Ok(())
    }

    /// Refits the video where that is asked for; traces alone are left to the first question for them.
    fn result(&self, mut completed: CompletedTask, debias: bool) -> PyReconstruction {
        let refits = debias && !self.reporter.is_abandoned();
        let estimate = refits.then(|| completed.reconstruction.video.clone());
        let traces = refits.then(|| completed.evaluate(TraceRequest::default(), true));
        PyReconstruction::new(completed, estimate, traces, rayon::current_num_threads())
    }
}

/// Does work on a thread of its own, and shows its iterations to a progress function.
struct Watcher {
    thread_count: Option<usize>,
    progress: Option<Py<PyAny>>,
    began: Instant,
    cancel: Cancel,
}

impl Watcher {
    fn new(thread_count: Option<usize>, progress: Option<Py<PyAny>>, began: Instant) -> Self {
        Self {
            thread_count,
            progress,
            began,
            cancel: Cancel::default(),
        }
    }

    fn observe<T: Send + 'static>(
        self,
        py: Python<'_>,
        work: impl FnOnce(&Watch<Result<T>>) -> Result<T> + Send + 'static,
    ) -> PyResult<T> {
        let Self {
            thread_count,
            progress,
            began,
            cancel,
        } = self;
        let call = |py: Python<'_>, iteration: PyProgress| {
            progress
                .as_ref()
                .map_or(Ok(Answer::Continue), |f| answer_of(py, f, iteration))
        };
        let on_progress: Option<OnProgress<PyProgress>> = match progress {
            Some(_) => Some(&call),
            None => None,
        };
        let done = interruptibly_with(py, thread_count, cancel, on_progress, move |reporter| {
            work(&Watch { reporter, began })
        })?;
        done.map_err(to_py_err)
    }
}

/// What a progress function answers: `None` goes on; `False`, of Python or numpy, asks for the best so far.
fn answer_of(py: Python<'_>, progress: &Py<PyAny>, iteration: PyProgress) -> PyResult<Answer> {
    let answer = progress.call1(py, (iteration,))?;
    let answer = answer.bind(py);
    let continues = answer.is_none() || !is_bool(answer)? || answer.is_truthy()?;
    Ok(if continues {
        Answer::Continue
    } else {
        Answer::Finish
    })
}

/// A plane's name, its start in microseconds, and its reconstruction.
type PlaneResult = (String, f64, PyReconstruction);

/// The video in colour `[t, y, x, colour]` of a raw Bayer frame, and the planes in the order of their reconstruction.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, *, prior="auto", tau=None, noise_sigma=None, time_budget_s=None,
    max_iterations=None, dark=None, flat=None, bad_pixels=None, progress=None, seed=Whole::of(0), experiment=None,
    keep_all_pixels=false, debias=false, threads=None, tuning=None, corrected=false))]
#[allow(clippy::too_many_arguments, clippy::too_many_lines)]
pub fn _reconstruct_colour<'py>(
    py: Python<'py>,
    frame: &Bound<'py, PyAny>,
    camera: &PyCamera,
    psf: &Bound<'py, PyAny>,
    prior: &str,
    tau: Option<&Bound<'py, PyAny>>,
    noise_sigma: Option<Number>,
    time_budget_s: Option<Number>,
    max_iterations: Option<Whole>,
    dark: Option<&Bound<'py, PyAny>>,
    flat: Option<&Bound<'py, PyAny>>,
    bad_pixels: Option<&Bound<'py, PyAny>>,
    progress: Option<Py<PyAny>>,
    seed: Whole,
    experiment: Option<&PyExperiment>,
    keep_all_pixels: bool,
    debias: bool,
    threads: Option<Whole>,
    tuning: Option<Constants>,
    corrected: bool,
) -> PyResult<(Bound<'py, PyArray4<f32>>, Vec<PlaneResult>)> {
    let began = Instant::now();
    let thread_count = threads_from(threads)?;
    let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
    let time_budget_s = optional_real(time_budget_s, "time_budget_s")?;
    let mosaic = camera.bayer.ok_or_else(|| {
        let rule = "a camera of raw colour frames has a mosaic";
        let remedy = "Give bayer=\"rggb\" to the Camera, or call rowburst.reconstruct.";
        to_py_err(Error::input(Parameter::Bayer, "None", rule, remedy))
    })?;
    let options = Options {
        tuning: tuning_of(tuning)?,
        ..options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?
    };
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let setup = setup_of(&camera.camera, psf, corrections, options, experiment)?;
    let budget = parse_time_budget(time_budget_s).map_err(to_py_err)?;
    let (frame, setup) = frame_of(
        frame,
        Setup { budget, ..setup },
        corrected.then_some(Bias::Subtracted),
    )?;
    let mut task = ColourTask {
        setup,
        mosaic,
        frame,
        seed: seed.named("seed")? as u64,
        debias,
    };
    task.check().map_err(to_py_err)?;
    crate::memory::check(&task.first_plane().map_err(to_py_err)?, 0)?;
    let watcher = Watcher::new(thread_count, progress, began);
    let planes = watcher.observe(py, move |watch| {
        task.setup.cancel = watch.reporter.cancel().clone();
        let mut planes = Vec::new();
        task.reconstruct(began, &mut |event| watch.answer(event), &mut |plane| {
            let result = watch.result(plane.completed, debias);
            planes.push((plane.site, plane.start_us, result));
            watch.check_wanted()
        })?;
        Ok(planes)
    })?;
    let videos: Vec<_> = planes
        .iter()
        .map(|(site, _, result)| (*site, result.copied_video(py)))
        .collect();
    let colours = merge_planes(&videos).ok_or_else(|| {
        let found = "planes of different lengths: there is no video in colour";
        to_py_err(Error::work(
            Parameter::Frame,
            found,
            "Crop the frame to an even number of rows.",
        ))
    })?;
    let shape = videos[0].1.shape();
    let [red, green, blue] = &colours;
    let voxels = red.iter().zip(green).zip(blue);
    let array = PyArray1::from_vec(py, voxels.flat_map(|((r, g), b)| [*r, *g, *b]).collect());
    let array = array.reshape([shape.bins, shape.rows, shape.columns, 3])?;
    let planes = planes
        .into_iter()
        .map(|(site, start, result)| (site.name(), start, result));
    Ok((array, planes.collect()))
}

/// Reconstructs a video in chunks of bins, into a folder; the numbers of `result.json`, as its text.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, folder, *, bins_per_chunk=None, bins=None, prior="auto", tau=None,
    noise_sigma=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, progress=None, experiment=None,
    threads=None, tuning=None, corrected=false))]
#[allow(clippy::too_many_arguments)]
pub fn _reconstruct_chunked(
    py: Python<'_>,
    frame: &Bound<'_, PyAny>,
    camera: &PyCamera,
    psf: &Bound<'_, PyAny>,
    folder: PathBuf,
    bins_per_chunk: Option<Whole>,
    bins: Option<(Whole, Whole)>,
    prior: &str,
    tau: Option<&Bound<'_, PyAny>>,
    noise_sigma: Option<Number>,
    max_iterations: Option<Whole>,
    dark: Option<&Bound<'_, PyAny>>,
    flat: Option<&Bound<'_, PyAny>>,
    bad_pixels: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    experiment: Option<&PyExperiment>,
    threads: Option<Whole>,
    tuning: Option<Constants>,
    corrected: bool,
) -> PyResult<String> {
    let began = Instant::now();
    let thread_count = threads_from(threads)?;
    let noise_sigma = optional_real(noise_sigma, "noise_sigma")?;
    let options = Options {
        tuning: tuning_of(tuning)?,
        ..options_from(prior, tau, noise_sigma, max_iterations, false)?
    };
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let setup = setup_of(camera.grey()?, psf, corrections, options, experiment)?;
    let (frame, setup) = frame_of(frame, setup, corrected.then_some(Bias::Subtracted))?;
    let bins = match bins {
        None => None,
        Some((first, end)) => Some(first.named("bins")?..end.named("bins")?),
    };
    let task = setup.task(&frame, bins).map_err(to_py_err)?;
    let bins_per_chunk = optional(bins_per_chunk, "bins_per_chunk")?.unwrap_or(0);
    let watcher = Watcher::new(thread_count, progress, began);
    let artifacts = watcher.observe(py, move |watch| {
        let task = Task {
            cancel: watch.reporter.cancel().clone(),
            ..task
        };
        let task = ChunkedTask::new(task, bins_per_chunk)?;
        let output = Output {
            folder: &OutputFolder::claim(&folder, "reconstruct", ForeignFiles::Accept)?,
            title: "Rowburst",
            reproduce: None,
            movie: MovieStyle::Stamped,
            formats: None,
            record: None,
        };
        run_chunked(&task, &output, &mut |event| watch.answer(event))
    })?;
    Ok(serde_json::to_string(&artifacts.summary).expect("plain numbers and text"))
}
