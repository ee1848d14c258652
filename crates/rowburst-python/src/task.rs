//! `rowburst.reconstruct`.

use crate::array::{capture, finite_image, video};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::psf::psfs_of;
use crate::result::{PyProgress, PyReconstruction};
use pyo3::prelude::*;
use rowburst::measurement::{Corrections, Measurement, correct};
use rowburst::reconstruct::{Options, Prior, Tau};
use rowburst::solve::StopReason;
use rowburst::{Camera, Error};
use rowburst_io::FromMetadata;
use rowburst_run::inputs::{check_memory, checked_truth};
use rowburst_run::options::{parse_prior, parse_tau, parse_time_budget};
use rowburst_run::{Task, solve};
use std::ops::ControlFlow;
use std::time::Instant;

/// The video of a frame.
#[pyfunction]
#[pyo3(signature = (frame, camera, psf, *, prior="auto", tau=None, noise_sigma=None,
    time_budget_s=None, max_iterations=None, dark=None, flat=None, bad_pixels=None, truth=None,
    direct=None, progress=None, seed=0))]
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
    max_iterations: Option<usize>,
    dark: Option<&Bound<'_, PyAny>>,
    flat: Option<&Bound<'_, PyAny>>,
    bad_pixels: Option<&Bound<'_, PyAny>>,
    truth: Option<&Bound<'_, PyAny>>,
    direct: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    seed: u64,
) -> PyResult<PyReconstruction> {
    let began = Instant::now();
    let camera = camera.camera.clone();
    let options = Options {
        prior: prior_from(prior)?,
        tau: tau_from(tau)?,
        noise_sigma,
        max_iterations: match max_iterations {
            Some(0) => {
                let rule = "a run has at least one iteration";
                let error = Error::input("max_iterations", 0, rule, "Leave it out.");
                return Err(to_py_err(error));
            }
            most => most,
        },
    };
    let budget = parse_time_budget(time_budget_s).map_err(to_py_err)?;
    let corrections = Corrections {
        dark: dark.map(|v| finite_image(v, "dark")).transpose()?,
        flat: flat.map(|v| finite_image(v, "flat")).transpose()?,
        bad_pixels: bad_pixels
            .map(|v| finite_image(v, "bad_pixels"))
            .transpose()?,
        saturation_counts: None,
    };
    let psfs = psfs_of(psf, &camera, corrections.dark.as_ref())?;
    let measurement = measured(frame, &camera, corrections)?;
    check_memory("the video".as_ref(), &camera).map_err(to_py_err)?;
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
        from_metadata: FromMetadata::default(),
    };
    // Raised by the callback, or Ctrl-C: the run is given up.
    let mut interruption: Option<PyErr> = None;
    let completed = py.detach(|| {
        solve(task, began, &mut |iteration, metrics| {
            let asked = Python::attach(|py| {
                py.check_signals()?;
                let Some(progress) = &progress else {
                    return Ok(true);
                };
                let level = metrics.residual_over_sigma;
                let py_progress = PyProgress::new(iteration, level, began.elapsed().as_secs_f64());
                let answer = progress.call1(py, (py_progress,))?;
                // `None` goes on; `False` asks for the best so far.
                Ok(!answer
                    .bind(py)
                    .is_exact_instance_of::<pyo3::types::PyBool>()
                    || answer.is_truthy(py)?)
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
    });
    match interruption {
        Some(error) => Err(error),
        None => Ok(PyReconstruction::new(completed.map_err(to_py_err)?)),
    }
}

/// The measurement that a frame is.
pub fn measured(
    frame: &Bound<'_, PyAny>,
    camera: &Camera,
    corrections: Corrections,
) -> PyResult<Measurement> {
    let raw = capture(frame, "frame")?;
    let corrections = Corrections {
        saturation_counts: raw.format.saturation_limit(),
        ..corrections
    };
    correct(&raw.image, camera, &corrections).map_err(|e| to_py_err(within_frame(e)))
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
        Some(value) => match value.extract::<f64>() {
            Ok(number) => Ok(Tau::Given(number)),
            Err(_) => parse_tau(&value.str()?.to_string()).map_err(to_py_err),
        },
    }
}
