//! `rowburst.reconstruct`.

use crate::array::{finite_image, is_array, masked_capture, masked_image, video, with_masked};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::experiment::PyExperiment;
use crate::interrupt::{Answer, OnProgress, interruptibly};
use crate::operator::{Gram, model_of};
use crate::psf::psfs_of;
use crate::result::{PyProgress, PyReconstruction};
use crate::threads::pool_of;
use crate::whole::{Whole, is_bool, optional};
use numpy::{PyArray1, PyArray4, PyArrayMethods};
use pyo3::prelude::*;
use rayon::ThreadPool;
use rowburst::camera::CameraParams;
use rowburst::measurement::{Corrections, Measurement, correct};
use rowburst::reconstruct::{Chunked, Model, Options, Prior, SelfCalibration, Tau};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst::{Camera, Error, Image, PatchSet, Sensor};
use rowburst_io::{Capture, FromMetadata, OutputFolder, SampleFormat};
use rowburst_run::inputs::checked_truth;
use rowburst_run::options::{parse_prior, parse_self_calibration, parse_tau, parse_time_budget};
use rowburst_run::{
    ChunkedTask, ColourInputs, IterationMetrics, MovieStyle, Task, TraceRequest, check_raw_frame,
    merge_planes, run_chunked, solve, solve_with_model,
};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

/// What the frames of a camera share: calibration and options.
#[derive(Clone)]
pub struct Setup {
    camera: Camera,
    psfs: PatchSet,
    corrections: Corrections,
    options: Options,
    from_metadata: FromMetadata,
    /// The threads of these frames alone, if they have some.
    pool: Option<Arc<ThreadPool>>,
}

/// A frame, and what it is compared with.
struct FrameInputs<'a, 'py> {
    frame: &'a Bound<'py, PyAny>,
    truth: Option<&'a Bound<'py, PyAny>>,
    direct: Option<&'a Bound<'py, PyAny>>,
    time_budget_s: Option<f64>,
    seed: Whole,
    debias: bool,
}

/// The video of a frame.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, *, prior="auto", tau=None, noise_sigma=None,
    time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None,
    direct=None, progress=None, seed=Whole::of(0), experiment=None, self_calibrate="auto", keep_all_pixels=false,
    debias=false, threads=None),
    text_signature = "(frame, camera, psf, *, prior='auto', tau=None, noise_sigma=None, time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None, direct=None, progress=None, seed=0, experiment=None, self_calibrate='auto', keep_all_pixels=False, debias=False, threads=None)")]
#[allow(clippy::too_many_arguments)]
pub fn reconstruct(
    py: Python<'_>,
    frame: &Bound<'_, PyAny>,
    camera: &PyCamera,
    psf: &Bound<'_, PyAny>,
    prior: &str,
    tau: Option<&Bound<'_, PyAny>>,
    noise_sigma: Option<f64>,
    time_budget_s: Option<f64>,
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
) -> PyResult<PyReconstruction> {
    let began = Instant::now();
    let options = Options {
        self_calibration: self_calibration_from(self_calibrate)?,
        ..options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?
    };
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let setup = Setup::new(camera, psf, corrections, options, experiment, threads)?;
    let inputs = FrameInputs {
        frame,
        truth,
        direct,
        time_budget_s,
        seed,
        debias,
    };
    setup.reconstruct(py, None, &inputs, progress, began)
}

/// A set-up whose operator and Gram blocks all frames share.
#[pyclass(name = "_Reconstructor", module = "rowburst._rowburst", frozen)]
pub struct PyReconstructor {
    setup: Setup,
    model: Model,
}

#[pymethods]
impl PyReconstructor {
    #[new]
    #[pyo3(signature = (camera, psf, *, prior="auto", tau=None, noise_sigma=None, max_iterations=None, dark=None,
        flat=None, bad_pixels=None, experiment=None, self_calibrate="auto", keep_all_pixels=false, threads=None))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
        prior: &str,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<f64>,
        max_iterations: Option<Whole>,
        dark: Option<&Bound<'_, PyAny>>,
        flat: Option<&Bound<'_, PyAny>>,
        bad_pixels: Option<&Bound<'_, PyAny>>,
        experiment: Option<&PyExperiment>,
        self_calibrate: &str,
        keep_all_pixels: bool,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let options = Options {
            self_calibration: self_calibration_from(self_calibrate)?,
            ..options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?
        };
        let corrections = corrections_of(dark, flat, bad_pixels)?;
        let setup = Setup::new(camera, psf, corrections, options, experiment, threads)?;
        crate::memory::check(&setup.camera)?;
        let model = model_of(
            py,
            &setup.camera,
            &setup.psfs,
            setup.pool.clone(),
            Gram::Cached,
        )?;
        Ok(Self { setup, model })
    }

    /// The video of a frame.
    #[pyo3(signature = (frame, *, truth=None, direct=None, progress=None, seed=Whole::of(0), time_budget_s=None,
        debias=false))]
    #[allow(clippy::too_many_arguments)]
    fn reconstruct(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, PyAny>,
        truth: Option<&Bound<'_, PyAny>>,
        direct: Option<&Bound<'_, PyAny>>,
        progress: Option<Py<PyAny>>,
        seed: Whole,
        time_budget_s: Option<f64>,
        debias: bool,
    ) -> PyResult<PyReconstruction> {
        let inputs = FrameInputs {
            frame,
            truth,
            direct,
            time_budget_s,
            seed,
            debias,
        };
        let model = Some(self.model.clone());
        let began = Instant::now();
        self.setup.reconstruct(py, model, &inputs, progress, began)
    }
}

impl Setup {
    fn new(
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
        corrections: Corrections,
        options: Options,
        experiment: Option<&PyExperiment>,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let camera = camera.grey()?.clone();
        Ok(Self {
            psfs: psfs_of(psf, &camera, corrections.dark.as_ref())?,
            camera,
            corrections,
            options,
            from_metadata: experiment
                .map(|e| e.from_metadata.clone())
                .unwrap_or_default(),
            pool: optional(threads, "threads")?.map(pool_of).transpose()?,
        })
    }

    /// The video of a frame, with `model` if the frames share one.
    fn reconstruct(
        &self,
        py: Python<'_>,
        model: Option<Model>,
        inputs: &FrameInputs<'_, '_>,
        progress: Option<Py<PyAny>>,
        began: Instant,
    ) -> PyResult<PyReconstruction> {
        let task = self.task(inputs)?;
        run(
            py,
            task,
            model,
            self.pool.clone(),
            inputs.debias,
            progress,
            began,
        )
    }

    fn task(&self, inputs: &FrameInputs<'_, '_>) -> PyResult<Task> {
        let seed = inputs.seed.clone().named("seed")? as u64;
        let budget = parse_time_budget(inputs.time_budget_s).map_err(to_py_err)?;
        let measurement = measured(inputs.frame, &self.camera, self.corrections.clone())?;
        crate::memory::check(&self.camera)?;
        let truth = inputs.truth.map(|value| {
            let video = video(value, "truth")?;
            checked_truth(video, "truth", &self.camera).map_err(to_py_err)
        });
        let direct = inputs.direct.map(|v| finite_image(v, "direct"));
        Ok(Task {
            camera: self.camera.clone(),
            psfs: self.psfs.clone(),
            measurement,
            options: self.options,
            budget,
            truth: truth.transpose()?,
            truth_file: None,
            direct: direct.transpose()?,
            seed,
            from_metadata: self.from_metadata.clone(),
        })
    }
}

/// Reconstructs a frame, with `model` if several frames share one.
fn run(
    py: Python<'_>,
    task: Task,
    model: Option<Model>,
    pool: Option<Arc<ThreadPool>>,
    debias: bool,
    progress: Option<Py<PyAny>>,
    began: Instant,
) -> PyResult<PyReconstruction> {
    let call = |py: Python<'_>, iteration: PyProgress| {
        progress
            .as_ref()
            .map_or(Ok(Answer::Continue), |f| answer_of(py, f, iteration))
    };
    let on_progress: Option<OnProgress<PyProgress>> = match progress {
        Some(_) => Some(&call),
        None => None,
    };
    let completed = interruptibly(py, pool, on_progress, move |reporter| {
        let mut show = |iteration: &Progress, metrics: &IterationMetrics| {
            let level = metrics.residual_over_sigma;
            let seconds = began.elapsed().as_secs_f64();
            match reporter.ask(|| PyProgress::new(iteration, level, seconds)) {
                Answer::Continue => ControlFlow::Continue(()),
                Answer::Finish | Answer::Abandon => ControlFlow::Break(StopReason::Interrupted),
            }
        };
        let mut completed = match model {
            Some(model) => solve_with_model(&model, task, began, &mut show)?,
            None => solve(task, began, &mut show)?,
        };
        let traces = (debias && !reporter.is_abandoned()).then(|| {
            let mut traces = completed.traces(TraceRequest::default(), true);
            completed.take_debiased(&mut traces);
            traces
        });
        Ok((completed, traces, rayon::current_num_threads()))
    })?;
    let (completed, traces, threads) = completed.map_err(to_py_err)?;
    Ok(PyReconstruction::new(completed, traces, threads))
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

/// The options of frames that use PSF and camera as given.
pub fn options_from(
    prior: &str,
    tau: Option<&Bound<'_, PyAny>>,
    noise_sigma: Option<f64>,
    max_iterations: Option<Whole>,
    keep_all_pixels: bool,
) -> PyResult<Options> {
    Ok(Options {
        self_calibration: SelfCalibration::Off,
        prior: prior_from(prior)?,
        tau: tau_from(tau)?,
        noise_sigma,
        max_iterations: match optional(max_iterations, "max_iterations")? {
            Some(0) => {
                let rule = "a run has at least one iteration";
                let error = Error::input("max_iterations", 0, rule, "Leave it out.");
                return Err(to_py_err(error));
            }
            most => most,
        },
        keep_all_pixels,
        ..Options::default()
    })
}

/// Dark, flat and bad pixels. Masked pixels of each are bad pixels.
pub fn corrections_of(
    dark: Option<&Bound<'_, PyAny>>,
    flat: Option<&Bound<'_, PyAny>>,
    bad_pixels: Option<&Bound<'_, PyAny>>,
) -> PyResult<Corrections> {
    let mut masked = None;
    let mut read = |value: Option<&Bound<'_, PyAny>>, name: &str| -> PyResult<Option<Image>> {
        let Some(value) = value else { return Ok(None) };
        let (image, mask) = masked_image(value, name)?;
        masked = with_masked(masked.take(), mask);
        Ok(Some(image))
    };
    let dark = read(dark, "dark")?;
    let flat = read(flat, "flat")?;
    let bad_pixels = read(bad_pixels, "bad_pixels")?;
    Ok(Corrections {
        dark,
        flat,
        bad_pixels: with_masked(bad_pixels, masked),
        saturation_counts: None,
    })
}

/// The measurement that a frame is: a raw capture, or an array of floating-point numbers from which
/// the bias is already taken.
pub fn measured(
    frame: &Bound<'_, PyAny>,
    camera: &Camera,
    corrections: Corrections,
) -> PyResult<Measurement> {
    let (raw, corrections) = raw_frame(frame, corrections)?;
    let origin = if is_array(frame) {
        Origin::Array
    } else {
        Origin::File
    };
    measurement_of(&raw, origin, camera, corrections).map_err(to_py_err)
}

/// Where a frame comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Origin {
    Array,
    File,
}

/// The pixels of a frame, and its corrections with the masked pixels of a masked array and the end of its numbers.
fn raw_frame(
    frame: &Bound<'_, PyAny>,
    corrections: Corrections,
) -> PyResult<(Capture, Corrections)> {
    let (raw, mask) = masked_capture(frame, "frame")?;
    if raw.format == (SampleFormat::Counts { bits: 1 }) {
        return Err(to_py_err(Error::input(
            "frame",
            "an array of bool",
            "a frame holds counts or floating-point numbers, and two values are no capture",
            "Give the counts as the camera recorded them.",
        )));
    }
    let corrections = Corrections {
        saturation_counts: raw.format.saturation_limit(),
        bad_pixels: with_masked(corrections.bad_pixels, mask),
        ..corrections
    };
    Ok((raw, corrections))
}

fn measurement_of(
    raw: &Capture,
    origin: Origin,
    camera: &Camera,
    mut corrections: Corrections,
) -> rowburst::Result<Measurement> {
    let bias = camera.sensor().bias_counts.filter(|bias| *bias > 0.0);
    let is_free_of_bias =
        origin == Origin::Array && raw.format == SampleFormat::Float && corrections.dark.is_none();
    let corrected = match bias {
        Some(bias) if is_free_of_bias => {
            if let Some(flat) = &mut corrections.flat {
                flat.data_mut().iter_mut().for_each(|p| *p -= bias as f32);
            }
            correct(&raw.image, &without_bias(camera, bias)?, &corrections)
        }
        _ => correct(&raw.image, camera, &corrections),
    };
    corrected.map_err(within_frame)
}

/// The camera of frames from which the bias is taken: it saturates earlier by as much.
fn without_bias(camera: &Camera, bias: f64) -> rowburst::Result<Camera> {
    let params = camera.params().clone();
    let end = params.sensor.saturation_counts();
    Camera::new(CameraParams {
        sensor: Sensor {
            bias_counts: None,
            full_well_counts: end.map(|end| end - bias).filter(|end| *end > 0.0),
            ..params.sensor
        },
        ..params
    })
}

/// Names the frame in an error of the corrections that is none of theirs.
fn within_frame(error: Error) -> Error {
    match &error {
        Error::Input { subject, .. }
            if ["frame", "dark", "flat", "bad_pixels"].contains(&subject.as_str()) =>
        {
            error
        }
        _ => error.within("frame"),
    }
}

pub fn self_calibration_from(name: &str) -> PyResult<SelfCalibration> {
    parse_self_calibration(Some(name)).map_err(to_py_err)
}

pub fn prior_from(name: &str) -> PyResult<Option<Prior>> {
    parse_prior(name).map_err(to_py_err)
}

/// `None` and text as on the command line, or a number.
pub fn tau_from(tau: Option<&Bound<'_, PyAny>>) -> PyResult<Tau> {
    match tau {
        None => Ok(Tau::Auto),
        Some(value) if is_bool(value)? => Err(to_py_err(Error::input(
            "tau",
            value.str()?.to_string(),
            "τ is \"auto\", \"held-out\" or a number above zero",
            "Leave it out for \"auto\".",
        ))),
        Some(value) => match value.extract::<f64>() {
            Ok(number) => Ok(Tau::Given(number)),
            Err(_) => parse_tau(&value.str()?.to_string()).map_err(to_py_err),
        },
    }
}

/// A plane's name, its start in microseconds, and its reconstruction.
type PlaneResult = (String, f64, PyReconstruction);

/// The video in colour `[t, y, x, colour]` of a raw Bayer frame, and the planes in the order of their reconstruction.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, *, prior="auto", tau=None, noise_sigma=None, time_budget_s=None,
    max_iterations=None, dark=None, flat=None, bad_pixels=None, progress=None, seed=Whole::of(0), experiment=None,
    keep_all_pixels=false, debias=false, threads=None))]
#[allow(clippy::too_many_arguments, clippy::too_many_lines)]
pub fn _reconstruct_colour<'py>(
    py: Python<'py>,
    frame: &Bound<'py, PyAny>,
    camera: &PyCamera,
    psf: &Bound<'py, PyAny>,
    prior: &str,
    tau: Option<&Bound<'py, PyAny>>,
    noise_sigma: Option<f64>,
    time_budget_s: Option<f64>,
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
) -> PyResult<(Bound<'py, PyArray4<f32>>, Vec<PlaneResult>)> {
    let began = Instant::now();
    let mosaic = camera.bayer.ok_or_else(|| {
        let rule = "a camera of raw colour frames has a mosaic";
        let remedy = "Give bayer=\"rggb\" to the Camera, or call rowburst.reconstruct.";
        to_py_err(Error::input("bayer", "None", rule, remedy))
    })?;
    let mut options = options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?;
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let psfs = psfs_of(psf, &camera.camera, corrections.dark.as_ref())?;
    let (raw, corrections) = raw_frame(frame, corrections)?;
    let origin = if is_array(frame) {
        Origin::Array
    } else {
        Origin::File
    };
    check_raw_frame("frame", &raw.image, &camera.camera).map_err(to_py_err)?;
    let colour = ColourInputs {
        raw: raw.image,
        camera: camera.camera.clone(),
        mosaic,
        psfs,
        corrections,
    };
    colour.check_corrections().map_err(to_py_err)?;
    crate::memory::check(&colour.camera)?;
    let budget = parse_time_budget(time_budget_s).map_err(to_py_err)?;
    let pool = optional(threads, "threads")?.map(pool_of).transpose()?;
    let seed = seed.named("seed")? as u64;
    let mut planes = Vec::new();
    for site in colour.sites() {
        let plane = colour.plane_camera(site).map_err(to_py_err)?;
        let start_us = plane.start_us;
        let plane = colour.plane(site, plane).map_err(to_py_err)?;
        let camera = plane.camera.camera;
        let raw = Capture {
            image: plane.raw,
            format: raw.format,
        };
        let task = Task {
            measurement: measurement_of(&raw, origin, &camera, plane.corrections)
                .map_err(to_py_err)?,
            camera,
            psfs: plane.psfs,
            options,
            budget: budget.map(|budget| budget / 4),
            truth: None,
            truth_file: None,
            direct: None,
            seed,
            from_metadata: experiment
                .map(|e| e.from_metadata.clone())
                .unwrap_or_default(),
        };
        let heard = progress.as_ref().map(|f| f.clone_ref(py));
        let result = run(py, task, None, pool.clone(), debias, heard, began)?;
        options.prior = options.prior.or(result.prior_used(py));
        planes.push((site, start_us, result));
    }
    let videos: Vec<_> = planes
        .iter()
        .map(|(site, _, result)| (*site, result.copied_video(py)))
        .collect();
    let borrowed: Vec<_> = videos.iter().map(|(site, video)| (*site, video)).collect();
    let colours = merge_planes(&borrowed).ok_or_else(|| {
        let found = "planes of different lengths: there is no video in colour";
        to_py_err(Error::work(
            "frame",
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
    threads=None))]
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
    noise_sigma: Option<f64>,
    max_iterations: Option<Whole>,
    dark: Option<&Bound<'_, PyAny>>,
    flat: Option<&Bound<'_, PyAny>>,
    bad_pixels: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    experiment: Option<&PyExperiment>,
    threads: Option<Whole>,
) -> PyResult<String> {
    let began = Instant::now();
    let options = options_from(prior, tau, noise_sigma, max_iterations, false)?;
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let setup = Setup::new(camera, psf, corrections, options, experiment, threads)?;
    let measurement = measured(frame, &setup.camera, setup.corrections.clone())?;
    let (camera, measurement) = match bins {
        None => (setup.camera, measurement),
        Some((first, end)) => {
            let part = setup
                .camera
                .subset(first.named("bins")?..end.named("bins")?);
            let part = part.map_err(to_py_err)?;
            let rows: Vec<usize> = part.sensor_rows().collect();
            let measurement = measurement.select_rows(&rows);
            (part, measurement)
        }
    };
    let bins_per_chunk = optional(bins_per_chunk, "bins_per_chunk")?.filter(|n| *n > 0);
    let (psfs, from_metadata) = (setup.psfs, setup.from_metadata);
    let call = |py: Python<'_>, iteration: PyProgress| {
        progress
            .as_ref()
            .map_or(Ok(Answer::Continue), |f| answer_of(py, f, iteration))
    };
    let on_progress: Option<OnProgress<PyProgress>> = match progress {
        Some(_) => Some(&call),
        None => None,
    };
    let summary = interruptibly(py, setup.pool, on_progress, move |reporter| {
        let task = ChunkedTask {
            chunked: Chunked::new(camera, psfs, measurement, options)?,
            tau: options.tau,
            bins_per_chunk,
            title: "Rowburst",
            reproduce: None,
            movie: MovieStyle::Stamped,
            from_metadata: &from_metadata,
        };
        let folder = OutputFolder::create(&folder)?;
        run_chunked(&task, &folder, &mut |_, _, iteration| {
            let seconds = began.elapsed().as_secs_f64();
            let level = iteration.residual_rms / task.chunked.sigma().0;
            match reporter.ask(|| PyProgress::new(iteration, level, seconds)) {
                Answer::Continue => ControlFlow::Continue(()),
                Answer::Finish | Answer::Abandon => ControlFlow::Break(StopReason::Interrupted),
            }
        })
    })?;
    let summary = summary.map_err(to_py_err)?;
    Ok(serde_json::to_string(&summary).expect("plain numbers and text"))
}
