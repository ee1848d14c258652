//! `rowburst.LiveView`: a live view.

use crate::array::from_video;
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::psf::psfs_of;
use crate::task::{measured, prior_from, tau_from};
use numpy::PyArray3;
use pyo3::prelude::*;
use rowburst::measurement::Corrections;
use rowburst::reconstruct::{Model, Options, Sequence};
use rowburst::solve::StopReason;
use rowburst_run::inputs::check_memory;
use rowburst_run::options::parse_time_budget;
use std::ops::ControlFlow;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Frames of one scene, each from the end of the last one.
#[pyclass(name = "LiveView", module = "rowburst", frozen)]
pub struct PySequence {
    camera: PyCamera,
    sequence: Mutex<Sequence>,
}

/// A frame of a sequence.
#[pyclass(name = "Look", module = "rowburst", frozen)]
pub struct PyLook {
    #[pyo3(get)]
    video: Py<PyArray3<f32>>,
    #[pyo3(get)]
    residual_over_sigma: f64,
    #[pyo3(get)]
    iterations: usize,
    #[pyo3(get)]
    went_on: bool,
    #[pyo3(get)]
    fit: &'static str,
    #[pyo3(get)]
    seconds: f64,
}

#[pymethods]
impl PySequence {
    #[new]
    #[pyo3(signature = (camera, psf, *, prior="auto", tau=None, noise_sigma=None))]
    fn new(
        py: Python<'_>,
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
        prior: &str,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<f64>,
    ) -> PyResult<Self> {
        let options = Options {
            prior: prior_from(prior)?,
            tau: tau_from(tau)?,
            noise_sigma,
            max_iterations: None,
        };
        let psfs = psfs_of(psf, &camera.camera, None)?;
        check_memory("the video".as_ref(), &camera.camera).map_err(to_py_err)?;
        let model = py.detach(|| Model::new(&camera.camera, psfs).with_cached_gram());
        Ok(Self {
            camera: PyCamera {
                camera: camera.camera.clone(),
            },
            sequence: Mutex::new(Sequence::new(model, options)),
        })
    }

    /// The video of the next frame.
    #[pyo3(signature = (frame, *, time_budget_s=None))]
    fn next(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, PyAny>,
        time_budget_s: Option<f64>,
    ) -> PyResult<PyLook> {
        let began = Instant::now();
        let budget = parse_time_budget(time_budget_s).map_err(to_py_err)?;
        let measurement = measured(frame, &self.camera.camera, Corrections::default())?;
        let mut interruption: Option<PyErr> = None;
        let found = py.detach(|| {
            let mut sequence = self.sequence.lock().unwrap_or_else(PoisonError::into_inner);
            sequence.next(&measurement, &mut |_| {
                if let Err(error) = Python::attach(|py| py.check_signals()) {
                    interruption = Some(error);
                    return ControlFlow::Break(StopReason::Interrupted);
                }
                match budget.is_some_and(|budget| began.elapsed() > budget) {
                    true => ControlFlow::Break(StopReason::TimeBudget),
                    false => ControlFlow::Continue(()),
                }
            })
        });
        if let Some(error) = interruption {
            return Err(error);
        }
        let (found, went_on) = found.map_err(to_py_err)?;
        Ok(PyLook {
            residual_over_sigma: found.residual_over_sigma,
            iterations: found.iterations,
            went_on,
            fit: found.fit.verdict.name(),
            seconds: began.elapsed().as_secs_f64(),
            video: from_video(py, found.video)?.unbind(),
        })
    }

    /// The next frame starts from nothing.
    fn forget(&self, py: Python<'_>) {
        py.detach(|| {
            let mut sequence = self.sequence.lock().unwrap_or_else(PoisonError::into_inner);
            sequence.reset();
        });
    }
}
