//! `rowburst.LiveView`: a live view.

use crate::array::{from_video, make_read_only};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::frame::{corrections_of, measured};
use crate::interrupt::interruptibly;
use crate::operator::{Gram, model_of};
use crate::options::{Constants, prior_from, tau_from, tuning_of};
use crate::task::{setup_of, threads_from};
use crate::whole::{Number, Whole, optional_real};
use numpy::PyArray3;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use rowburst::reconstruct::{Model, Options, SelfCalibration, Sequence};
use rowburst::solve::StopReason;
use rowburst_run::Setup;
use rowburst_run::options::parse_time_budget;
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// A live view: frames of one scene, each warm-started from the previous one.
///
/// A frame that was stopped early is not lost: the next one continues from its state. Where the last video explains less
/// than half of the variance of the frame, the solver starts from zero. Videos depend on earlier frames: use them for
/// display, not for measurement.
///
/// Parameters
/// ----------
/// camera : Camera
///     The camera.
/// psf : Psf, array or path
///     The point-spread function ``[y, x]``.
/// prior : str
///     ``"auto"`` is the standard prior ``tv+0.5*tdiff+support`` here.
/// tau, noise_sigma, dark, flat, bad_pixels, tuning
///     Those of :func:`reconstruct`.
/// threads : int, optional
///     Threads of this view alone; by default all those of the process (:func:`threads`).
///
/// Raises
/// ------
/// InputError
///     An argument breaks a rule.
/// WorkError
///     The machine has too little memory.
///
/// Examples
/// --------
/// >>> live = rb.LiveView(camera, psf)
/// >>> look = live.next(frame, time_budget_s=0.1)
/// >>> look.video.shape, look.went_on
/// ((12, 24, 30), False)
#[allow(clippy::doc_lazy_continuation)]
#[pyclass(name = "LiveView", module = "rowburst", frozen)]
pub struct PySequence {
    setup: Setup,
    sequence: Arc<Mutex<Sequence>>,
    thread_count: Option<usize>,
}

/// A frame of a :class:`LiveView`.
#[pyclass(name = "Look", module = "rowburst", frozen)]
pub struct PyLook {
    /// ``[t, y, x]``, in counts. It may not be written to.
    #[pyo3(get)]
    video: Py<PyArray3<f32>>,
    /// Rms of the residual over sigma: about 1 where the video explains the frame.
    #[pyo3(get)]
    residual_over_sigma: f64,
    /// Iterations for this frame.
    #[pyo3(get)]
    iterations: usize,
    /// Whether it was warm-started from the previous frame.
    #[pyo3(get)]
    went_on: bool,
    /// good, suspicious or bad: whether the model explains the frame.
    #[pyo3(get)]
    fit: &'static str,
    /// Time of this frame, in seconds.
    #[pyo3(get)]
    seconds: f64,
}

#[pymethods]
impl PySequence {
    #[new]
    #[pyo3(signature = (camera, psf, *, prior="auto", tau=None, noise_sigma=None, dark=None, flat=None,
        bad_pixels=None, tuning=None, threads=None))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
        prior: &str,
        tau: Option<&Bound<'_, PyAny>>,
        noise_sigma: Option<Number>,
        dark: Option<&Bound<'_, PyAny>>,
        flat: Option<&Bound<'_, PyAny>>,
        bad_pixels: Option<&Bound<'_, PyAny>>,
        tuning: Option<Constants>,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let thread_count = threads_from(threads)?;
        let options = Options {
            prior: prior_from(prior)?,
            tau: tau_from(tau)?,
            noise_sigma: optional_real(noise_sigma, "noise_sigma")?,
            max_iterations: None,
            self_calibration: SelfCalibration::OFF,
            keep_all_pixels: true,
            tuning: tuning_of(tuning)?,
            is_preview: true,
        };
        let grey = camera.grey()?;
        let corrections = corrections_of(dark, flat, bad_pixels)?;
        let setup = setup_of(grey, psf, corrections, options, None)?;
        crate::memory::check(grey, Model::cached_gram_bytes(grey))?;
        let model = model_of(py, grey, &setup.psfs, thread_count, Gram::Cached)?;
        Ok(Self {
            thread_count,
            setup,
            sequence: Arc::new(Mutex::new(Sequence::new(model, options))),
        })
    }

    /// The video of the next frame; the budget limits the iterations, not the evaluation after them.
    ///
    /// The bias of the camera is subtracted from integers, not from an array of floating-point numbers.
    ///
    /// Parameters
    /// ----------
    /// frame : array or path
    ///     The frame ``[y, x]``.
    /// time_budget_s : float, optional
    ///     Limit of the iterations, in seconds.
    ///
    /// Returns
    /// -------
    /// Look
    ///     The video and whether it can be trusted.
    ///
    /// Raises
    /// ------
    /// InputError
    ///     The frame breaks a rule.
    ///
    /// Examples
    /// --------
    /// >>> rb.LiveView(camera, psf).next(frame, time_budget_s=0.1).video.shape
    /// (12, 24, 30)
    #[allow(clippy::doc_lazy_continuation)]
    #[pyo3(signature = (frame, *, time_budget_s=None))]
    fn next(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, PyAny>,
        time_budget_s: Option<Number>,
    ) -> PyResult<PyLook> {
        let began = Instant::now();
        let time_budget_s = optional_real(time_budget_s, "time_budget_s")?;
        let budget = parse_time_budget(time_budget_s).map_err(to_py_err)?;
        let measurement = measured(frame, self.setup.clone())?;
        let sequence = Arc::clone(&self.sequence);
        let found = interruptibly::<(), _>(py, self.thread_count, None, move |reporter| {
            let mut sequence = sequence.lock().unwrap_or_else(PoisonError::into_inner);
            if reporter.is_abandoned() {
                return None;
            }
            sequence.set_cancel(reporter.cancel());
            Some(sequence.reconstruct(&measurement, &mut |_| {
                if reporter.is_abandoned() {
                    ControlFlow::Break(StopReason::Interrupted)
                } else if budget.is_some_and(|budget| began.elapsed() > budget) {
                    ControlFlow::Break(StopReason::TimeBudget)
                } else {
                    ControlFlow::Continue(())
                }
            }))
        })?;
        let found = found.expect("somebody waits for it");
        let (found, went_on) = found.map_err(to_py_err)?;
        let video = from_video(py, found.video)?;
        make_read_only(&video)?;
        Ok(PyLook {
            residual_over_sigma: found.residual_over_sigma,
            iterations: found.iterations,
            went_on,
            fit: found.fit.verdict.name(),
            seconds: began.elapsed().as_secs_f64(),
            video: video.unbind(),
        })
    }

    fn __reduce__(&self) -> PyResult<()> {
        Err(PyTypeError::new_err(
            "a LiveView cannot be pickled or copied: it holds the state of a running solver. Make one in each \
             process: rowburst.LiveView(camera, psf).",
        ))
    }

    /// The next frame starts from zero.
    ///
    /// Examples
    /// --------
    /// >>> live = rb.LiveView(camera, psf)
    /// >>> first = live.next(frame)
    /// >>> live.forget()
    /// >>> live.next(frame).went_on
    /// False
    #[allow(clippy::doc_lazy_continuation)]
    fn forget(&self, py: Python<'_>) {
        py.detach(|| {
            let mut sequence = self.sequence.lock().unwrap_or_else(PoisonError::into_inner);
            sequence.reset();
        });
    }
}
