//! `rowburst.reconstruct`.

use crate::array::{finite_image, is_array, masked_capture, masked_image, video, with_masked};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::experiment::PyExperiment;
use crate::psf::psfs_of;
use crate::result::{PyProgress, PyReconstruction};
use crate::threads::detached;
use crate::whole::{Whole, is_bool, optional};
use pyo3::prelude::*;
use rowburst::camera::CameraParams;
use rowburst::measurement::{Corrections, Measurement, correct};
use rowburst::reconstruct::{Options, Prior, Tau};
use rowburst::solve::StopReason;
use rowburst::{Camera, Error, Image, Sensor};
use rowburst_io::{FromMetadata, SampleFormat};
use rowburst_run::inputs::checked_truth;
use rowburst_run::options::{parse_prior, parse_tau, parse_time_budget};
use rowburst_run::{Task, solve};
use std::ops::ControlFlow;
use std::time::Instant;

/// The video of a frame.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, *, prior="auto", tau=None, noise_sigma=None,
    time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None,
    direct=None, progress=None, seed=Whole::of(0), experiment=None, keep_all_pixels=false),
    text_signature = "(frame, camera, psf, *, prior='auto', tau=None, noise_sigma=None, time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None, direct=None, progress=None, seed=0, experiment=None, keep_all_pixels=False)")]
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
) -> PyResult<PyReconstruction> {
    let began = Instant::now();
    let camera = camera.grey()?.clone();
    let seed = seed.named("seed")? as u64;
    let options = Options {
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
    };
    let budget = parse_time_budget(time_budget_s).map_err(to_py_err)?;
    let corrections = corrections_of(dark, flat, bad_pixels)?;
    let psfs = psfs_of(psf, &camera, corrections.dark.as_ref())?;
    let measurement = measured(frame, &camera, corrections)?;
    crate::memory::check(&camera)?;
    let truth = match truth {
        Some(value) => {
            let video = video(value, "truth")?;
            Some(checked_truth(video, "truth", &camera).map_err(to_py_err)?)
        }
        None => None,
    };
    let direct = direct.map(|v| finite_image(v, "direct")).transpose()?;
    let task = Task {
        camera,
        psfs,
        measurement,
        options,
        budget,
        truth,
        truth_file: None,
        direct,
        seed,
        from_metadata: match experiment {
            Some(experiment) => experiment.from_metadata.clone(),
            None => FromMetadata::default(),
        },
    };
    // Raised by the callback, or Ctrl-C: the run is given up.
    let mut interruption: Option<PyErr> = None;
    let completed = detached(py, || {
        solve(task, began, &mut |iteration, metrics| {
            let asked = Python::attach(|py| {
                py.check_signals()?;
                let Some(progress) = &progress else {
                    return Ok(true);
                };
                let level = metrics.residual_over_sigma;
                let py_progress = PyProgress::new(iteration, level, began.elapsed().as_secs_f64());
                let answer = progress.call1(py, (py_progress,))?;
                // `None` goes on; `False`, of Python or numpy, asks for the best so far.
                let answer = answer.bind(py);
                Ok(answer.is_none() || !is_bool(answer)? || answer.is_truthy()?)
            });
            match asked {
                Ok(true) => ControlFlow::Continue(()),
                Ok(false) => ControlFlow::Break(StopReason::Interrupted),
                Err(error) => {
                    interruption = Some(error);
                    ControlFlow::Break(StopReason::Interrupted)
                }
            }
        })
    })?;
    match interruption {
        Some(error) => Err(error),
        None => Ok(PyReconstruction::new(completed.map_err(to_py_err)?)),
    }
}

/// Dark, flat and bad pixels. Masked pixels of each are bad pixels.
fn corrections_of(
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
