//! `rowburst.Experiment`: what an experiment file says, read.

use crate::array::from_image;
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::psf::PyPsf;
use numpy::PyArray2;
use pyo3::prelude::*;
use rowburst::reconstruct::Tau;
use rowburst::{Camera, Image, PatchSet};
use rowburst_io::{Experiment, read_metadata};
use rowburst_run::inputs::{read_corrections, read_psfs};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// What an experiment file says, with the files that it names.
#[pyclass(name = "Experiment", module = "rowburst", frozen)]
pub struct PyExperiment {
    camera: Camera,
    psfs: Option<PatchSet>,
    dark: Option<Image>,
    flat: Option<Image>,
    bad_pixels: Option<Image>,
    experiment: Experiment,
}

type Pixels<'py> = PyResult<Option<Bound<'py, PyArray2<f32>>>>;

fn array<'py>(py: Python<'py>, image: &Option<Image>) -> Pixels<'py> {
    image.clone().map(|i| from_image(py, i)).transpose()
}

#[pymethods]
impl PyExperiment {
    /// What the file leaves open is taken from the metadata of `frame`, a file or a folder.
    #[new]
    #[pyo3(signature = (path, frame=None))]
    fn new(path: PathBuf, frame: Option<PathBuf>) -> PyResult<Self> {
        let read = || {
            let metadata = frame.as_deref().map(read_metadata).unwrap_or_default();
            let experiment = Experiment::read_with(&path, &metadata)?;
            let camera = experiment.camera()?;
            let calibration = &experiment.calibration;
            let corrections = read_corrections(calibration, None)?;
            let dark = corrections.dark.as_ref();
            let psfs = calibration.psf.as_deref();
            let psfs = psfs.map(|p| read_psfs(p, &camera, dark)).transpose()?;
            Ok(Self {
                psfs: psfs.map(|p| p.0),
                camera,
                dark: corrections.dark,
                flat: corrections.flat,
                bad_pixels: corrections.bad_pixels,
                experiment,
            })
        };
        read().map_err(to_py_err)
    }

    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera {
            camera: self.camera.clone(),
        }
    }

    #[getter]
    fn psf(&self) -> Option<PyPsf> {
        self.psfs.clone().map(|psfs| PyPsf { psfs })
    }

    #[getter]
    fn dark<'py>(&self, py: Python<'py>) -> Pixels<'py> {
        array(py, &self.dark)
    }

    #[getter]
    fn flat<'py>(&self, py: Python<'py>) -> Pixels<'py> {
        array(py, &self.flat)
    }

    #[getter]
    fn bad_pixels<'py>(&self, py: Python<'py>) -> Pixels<'py> {
        array(py, &self.bad_pixels)
    }

    #[getter]
    fn prior(&self) -> String {
        let prior = self.experiment.reconstruction.prior.clone();
        prior.unwrap_or("auto".into())
    }

    #[getter]
    fn tau<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        match self.experiment.reconstruction.tau.unwrap_or_default() {
            Tau::Auto => Ok("auto".into_pyobject(py)?.into_any()),
            Tau::HeldOut => Ok("held-out".into_pyobject(py)?.into_any()),
            Tau::Given(tau) => Ok(tau.into_pyobject(py)?.into_any()),
        }
    }

    /// Keys that came from metadata, with their values as text.
    #[getter]
    fn metadata_taken(&self) -> BTreeMap<String, String> {
        self.experiment
            .from_metadata
            .values
            .iter()
            .cloned()
            .collect()
    }

    /// Where the metadata contradicts the file, and what of it cannot be used.
    #[getter]
    fn metadata_warnings(&self) -> Vec<String> {
        self.experiment.from_metadata.warnings.clone()
    }

    #[getter]
    fn frame_period_us(&self) -> Option<f64> {
        self.experiment.recording.frame_period_us
    }
}
