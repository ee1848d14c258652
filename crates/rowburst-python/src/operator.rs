//! The forward operator and the data term, for solvers of other toolboxes.

use crate::array::vector;
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::frame::measured;
use crate::interrupt::interruptibly;
use crate::memory;
use crate::pickle::State2;
use crate::psf::{PyPsf, psfs_of};
use crate::threads::detached;
use numpy::{Element, PyArray1};
use pyo3::prelude::*;
use pyo3::types::PyType;
use rowburst::linop::{LinearOperator, Scalar};
use rowburst::reconstruct::{DataStep, Model};
use rowburst::{Camera, Error, Parameter, PatchSet, RollingShutter};
use rowburst_run::Setup;
use std::sync::{Mutex, OnceLock, PoisonError};

/// Whether the blocks of `A Aᵀ` are computed with a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gram {
    Absent,
    Cached,
}

/// The model of a camera with its PSFs.
///
/// # Errors
/// Those of [`interruptibly`].
pub fn model_of(
    py: Python<'_>,
    camera: &Camera,
    psfs: &PatchSet,
    thread_count: Option<usize>,
    gram: Gram,
) -> PyResult<Model> {
    let (camera, psfs) = (camera.clone(), psfs.clone());
    interruptibly::<(), _>(py, thread_count, None, move |reporter| {
        let model = Model::new(&camera, psfs).with_cancel(reporter.cancel());
        if gram == Gram::Cached && !reporter.is_abandoned() {
            model.with_cached_gram()
        } else {
            model
        }
    })
}

type Vector<'py, T = f32> = PyResult<Bound<'py, PyArray1<T>>>;

/// `A`: from a flattened video to a flattened frame.
#[pyclass(name = "_Operator", module = "rowburst._rowburst", frozen)]
pub struct PyOperator {
    model: Model,
    /// The same in double precision, once somebody asks for it.
    double: OnceLock<RollingShutter<f64>>,
}

impl PyOperator {
    fn shutter(&self) -> &RollingShutter {
        self.model.operator()
    }

    fn double(&self) -> &RollingShutter<f64> {
        let make =
            || RollingShutter::with_precision(self.model.camera(), self.model.psfs().clone());
        self.double.get_or_init(make)
    }
}

#[pymethods]
impl PyOperator {
    #[new]
    fn new(py: Python<'_>, camera: &PyCamera, psf: &Bound<'_, PyAny>) -> PyResult<Self> {
        let camera = camera.grey()?;
        let psfs = psfs_of(psf, camera, None)?;
        let model = model_of(py, camera, &psfs, None, Gram::Absent)?;
        Ok(Self {
            model,
            double: OnceLock::new(),
        })
    }

    #[getter]
    fn shape(&self) -> (usize, usize) {
        (self.shutter().range_len(), self.shutter().domain_len())
    }

    #[getter]
    fn camera(&self) -> PyCamera {
        self.model.camera().clone().into()
    }

    #[getter]
    fn psf(&self) -> PyPsf {
        PyPsf {
            psfs: self.model.psfs().clone(),
        }
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<State2<'py, PyCamera, PyPsf>> {
        let this = slf.get();
        let restore = slf.get_type().getattr("_restore")?;
        Ok((restore, (this.camera(), this.psf())))
    }

    /// The operator of what `__reduce__` gives.
    #[classmethod]
    fn _restore(
        cls: &Bound<'_, PyType>,
        camera: &PyCamera,
        psf: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        Self::new(cls.py(), camera, psf)
    }

    /// `A x`.
    fn apply<'py>(&self, py: Python<'py>, x: &Bound<'py, PyAny>) -> Vector<'py> {
        let x = vector::<f32>(x, "video", self.shutter().domain_len())?;
        applied(py, || self.shutter(), x.as_slice()?)
    }

    /// `A x` in float64.
    fn apply_double<'py>(&self, py: Python<'py>, x: &Bound<'py, PyAny>) -> Vector<'py, f64> {
        let x = vector::<f64>(x, "video", self.shutter().domain_len())?;
        applied(py, || self.double(), x.as_slice()?)
    }

    /// `Aᵀ y`.
    fn adjoint<'py>(&self, py: Python<'py>, y: &Bound<'py, PyAny>) -> Vector<'py> {
        let y = vector::<f32>(y, "frame", self.shutter().range_len())?;
        memory::check_video(self.model.camera(), size_of::<f32>())?;
        adjoint_of(py, || self.shutter(), y.as_slice()?)
    }

    /// `Aᵀ y` in float64.
    fn adjoint_double<'py>(&self, py: Python<'py>, y: &Bound<'py, PyAny>) -> Vector<'py, f64> {
        let y = vector::<f64>(y, "frame", self.shutter().range_len())?;
        memory::check_video(self.model.camera(), size_of::<f64>())?;
        adjoint_of(py, || self.double(), y.as_slice()?)
    }
}

fn applied<'py, 'a, T: Scalar + Element>(
    py: Python<'py>,
    shutter: impl FnOnce() -> &'a RollingShutter<T> + Send,
    x: &[T],
) -> Vector<'py, T> {
    let y = detached(py, || {
        let shutter = shutter();
        let mut y = vec![T::zero(); shutter.range_len()];
        shutter.apply(x, &mut y);
        y
    })?;
    Ok(PyArray1::from_vec(py, y))
}

fn adjoint_of<'py, 'a, T: Scalar + Element>(
    py: Python<'py>,
    shutter: impl FnOnce() -> &'a RollingShutter<T> + Send,
    y: &[T],
) -> Vector<'py, T> {
    let x = detached(py, || {
        let shutter = shutter();
        let mut x = vec![T::zero(); shutter.domain_len()];
        shutter.adjoint(y, &mut x);
        x
    })?;
    Ok(PyArray1::from_vec(py, x))
}

/// `½‖W(b − A v)‖²` of a frame.
#[pyclass(name = "_DataTerm", module = "rowburst._rowburst", frozen)]
pub struct PyDataTerm {
    step: Mutex<DataStep>,
    length: usize,
}

#[pymethods]
impl PyDataTerm {
    #[new]
    fn new(py: Python<'_>, operator: &PyOperator, frame: &Bound<'_, PyAny>) -> PyResult<Self> {
        let model = operator.model.clone();
        let setup = Setup::new(model.camera().clone(), model.psfs().clone());
        let measurement = measured(frame, setup)?;
        memory::check_data_term(model.camera())?;
        let step = interruptibly::<(), _>(py, None, None, move |reporter| {
            let model = model.with_cancel(reporter.cancel());
            DataStep::new(&model, &measurement)
        })?;
        Ok(Self {
            length: operator.shutter().domain_len(),
            step: Mutex::new(step),
        })
    }

    /// Its value at `x`.
    fn value(&self, py: Python<'_>, x: &Bound<'_, PyAny>) -> PyResult<f64> {
        self.with(py, x, |step, x| Ok(step.value(x)))
    }

    /// Its gradient at `x`.
    fn gradient<'py>(&self, py: Python<'py>, x: &Bound<'py, PyAny>) -> Vector<'py> {
        let gradient = self.with(py, x, |step, x| Ok(step.gradient(x)))?;
        Ok(PyArray1::from_vec(py, gradient))
    }

    /// `argmin_v ½‖W(b − A v)‖² + ‖v − x‖²/(2 step)`.
    fn prox<'py>(&self, py: Python<'py>, x: &Bound<'py, PyAny>, step: f64) -> Vector<'py> {
        let found = self.with(py, x, |data, x| data.prox(x, step))?;
        Ok(PyArray1::from_vec(py, found))
    }
}

impl PyDataTerm {
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        x: &Bound<'_, PyAny>,
        work: impl FnOnce(&mut DataStep, &[f32]) -> rowburst::Result<T> + Send,
    ) -> PyResult<T> {
        let x = vector::<f32>(x, "video", self.length)?;
        let x = x.as_slice()?;
        if let Some(i) = x.iter().position(|v| !v.is_finite()) {
            let rule = "every value is a finite number";
            let error = Error::input(
                Parameter::Video,
                format!("{} at {i}", x[i]),
                rule,
                "Take smaller steps.",
            );
            return Err(to_py_err(error));
        }
        detached(py, || {
            let mut step = self.step.lock().unwrap_or_else(PoisonError::into_inner);
            work(&mut step, x)
        })?
        .map_err(to_py_err)
    }
}
