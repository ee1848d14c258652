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
use pyo3::prelude::*;
use rayon::ThreadPool;
use rowburst::camera::CameraParams;
use rowburst::measurement::{Corrections, Measurement, correct};
use rowburst::reconstruct::{Model, Options, Prior, Tau};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst::{Camera, Error, Image, PatchSet, Sensor};
use rowburst_io::{FromMetadata, SampleFormat};
use rowburst_run::inputs::checked_truth;
use rowburst_run::options::{parse_prior, parse_tau, parse_time_budget};
use rowburst_run::{IterationMetrics, Task, TraceRequest, solve, solve_with_model};
use std::ops::ControlFlow;
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
    direct=None, progress=None, seed=Whole::of(0), experiment=None, keep_all_pixels=false, debias=false, threads=None),
    text_signature = "(frame, camera, psf, *, prior='auto', tau=None, noise_sigma=None, time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None, direct=None, progress=None, seed=0, experiment=None, keep_all_pixels=False, debias=False, threads=None)")]
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
    keep_all_pixels: bool,
    debias: bool,
    threads: Option<Whole>,
) -> PyResult<PyReconstruction> {
    let began = Instant::now();
    let options = options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?;
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
        flat=None, bad_pixels=None, experiment=None, keep_all_pixels=false, threads=None))]
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
        keep_all_pixels: bool,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let options = options_from(prior, tau, noise_sigma, max_iterations, keep_all_pixels)?;
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
        let debias = inputs.debias;
        let call = |py: Python<'_>, iteration: PyProgress| {
            progress
                .as_ref()
                .map_or(Ok(Answer::Continue), |f| answer_of(py, f, iteration))
        };
        let on_progress: Option<OnProgress<PyProgress>> = match progress {
            Some(_) => Some(&call),
            None => None,
        };
        let completed = interruptibly(py, self.pool.clone(), on_progress, move |reporter| {
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

/// What a progress function answers: `None` goes on; `False`, of Python or numpy, asks for the best so far.
fn answer_of(py: Python<'_>, progress: &Py<PyAny>, iteration: PyProgress) -> PyResult<Answer> {
    let answer = progress.call1(py, (iteration,))?;
    let answer = answer.bind(py);
    let goes_on = answer.is_none() || !is_bool(answer)? || answer.is_truthy()?;
    Ok(if goes_on {
        Answer::Continue
    } else {
        Answer::Finish
    })
}

pub fn options_from(
    prior: &str,
    tau: Option<&Bound<'_, PyAny>>,
    noise_sigma: Option<f64>,
    max_iterations: Option<Whole>,
    keep_all_pixels: bool,
) -> PyResult<Options> {
    Ok(Options {
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
        is_preview: false,
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
    let (raw, mask) = masked_capture(frame, "frame")?;
    if raw.format == (SampleFormat::Counts { bits: 1 }) {
        return Err(to_py_err(Error::input(
            "frame",
            "an array of bool",
            "a frame holds counts or floating-point numbers, and two values are no capture",
            "Give the counts as the camera recorded them.",
        )));
    }
    let mut corrections = Corrections {
        saturation_counts: raw.format.saturation_limit(),
        bad_pixels: with_masked(corrections.bad_pixels, mask),
        ..corrections
    };
    let bias = camera.sensor().bias_counts.filter(|bias| *bias > 0.0);
    let corrected = match bias {
        Some(bias)
            if is_array(frame)
                && raw.format == SampleFormat::Float
                && corrections.dark.is_none() =>
        {
            if let Some(flat) = &mut corrections.flat {
                flat.data_mut().iter_mut().for_each(|p| *p -= bias as f32);
            }
            correct(
                &raw.image,
                &without_bias(camera, bias).map_err(to_py_err)?,
                &corrections,
            )
        }
        _ => correct(&raw.image, camera, &corrections),
    };
    corrected.map_err(|e| to_py_err(within_frame(e)))
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
