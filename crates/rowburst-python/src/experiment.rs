//! `rowburst.Experiment`: what an experiment file says, read.

use crate::array::{finite_image, from_image};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::options::tau_from;
use crate::pickle::{State, entry, optional_entry};
use crate::psf::PyPsf;
use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use rowburst::reconstruct::Tau;
use rowburst::{Image, PatchSet};
use rowburst_io::{Experiment, FromMetadata, read_metadata};
use rowburst_run::inputs::{read_corrections, read_psfs};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The content of an experiment file and of the files that it names.
///
/// Parameters
/// ----------
/// path : path
///     The experiment file, as ``rowburst init`` writes it.
/// frame : path, optional
///     A frame or a recording: keys that the file leaves open are taken from its metadata.
///
/// Raises
/// ------
/// InputError
///     The file or one that it names is missing or breaks a rule.
///
/// Examples
/// --------
/// >>> experiment = rb.Experiment("experiment.toml")
/// >>> experiment.prior, experiment.psf.shape
/// ('tv', (47, 59))
/// >>> experiment.reconstructor(max_iterations=5)(frame).prior
/// 'tv'
#[allow(clippy::doc_lazy_continuation)]
#[pyclass(name = "Experiment", module = "rowburst", frozen)]
pub struct PyExperiment {
    camera: PyCamera,
    psfs: Option<PatchSet>,
    dark: Option<Image>,
    flat: Option<Image>,
    bad_pixels: Option<Image>,
    prior: String,
    tau: Tau,
    frame_period_us: Option<f64>,
    pub from_metadata: FromMetadata,
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
            let corrections = read_corrections(calibration)?;
            let dark = corrections.dark.as_ref();
            let psfs = calibration.psf.as_deref();
            let psfs = psfs.map(|p| read_psfs(p, &camera, dark)).transpose()?;
            Ok(Self {
                psfs: psfs.map(|p| p.0),
                camera: PyCamera {
                    camera,
                    bayer: experiment.bayer,
                },
                dark: corrections.dark,
                flat: corrections.flat,
                bad_pixels: corrections.bad_pixels,
                prior: experiment.reconstruction.prior.unwrap_or("auto".into()),
                tau: experiment.reconstruction.tau.unwrap_or_default(),
                frame_period_us: experiment.recording.frame_period_us,
                from_metadata: experiment.from_metadata,
            })
        };
        read().map_err(to_py_err)
    }

    #[getter]
    fn camera(&self) -> PyCamera {
        self.camera.clone()
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
        self.prior.clone()
    }

    #[getter]
    fn tau<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        match self.tau {
            Tau::Auto => Ok("auto".into_pyobject(py)?.into_any()),
            Tau::HeldOut => Ok("held-out".into_pyobject(py)?.into_any()),
            Tau::Given(tau) => Ok(tau.into_pyobject(py)?.into_any()),
        }
    }

    /// Keys that came from metadata, with their values as text.
    #[getter]
    fn metadata_taken(&self) -> BTreeMap<String, String> {
        self.from_metadata.values.iter().cloned().collect()
    }

    /// Contradictions between metadata and file, and metadata that cannot be used.
    #[getter]
    fn metadata_warnings(&self) -> Vec<String> {
        self.from_metadata.warnings.clone()
    }

    /// A reconstructor with everything that the file says; ``options`` are the arguments of :class:`Reconstructor`.
    #[pyo3(signature = (**options))]
    fn reconstructor<'py>(
        slf: &Bound<'py, Self>,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let package = slf.py().import("rowburst")?;
        package.getattr("Reconstructor")?.call((slf,), options)
    }

    #[getter]
    fn frame_period_us(&self) -> Option<f64> {
        self.frame_period_us
    }

    fn __repr__(&self) -> String {
        let has = |there: bool, name: &'static str| there.then_some(name);
        let files = [
            has(self.psfs.is_some(), "psf"),
            has(self.dark.is_some(), "dark"),
            has(self.flat.is_some(), "flat"),
            has(self.bad_pixels.is_some(), "bad_pixels"),
        ];
        let files: Vec<_> = files.into_iter().flatten().collect();
        format!(
            "<rowburst.Experiment: {}×{}, prior {}, with {}>",
            self.camera.camera.rows(),
            self.camera.camera.columns(),
            self.prior,
            if files.is_empty() {
                "no calibration".into()
            } else {
                files.join(", ")
            }
        )
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<State<'py>> {
        let (this, py) = (slf.get(), slf.py());
        let state = PyDict::new(py);
        state.set_item("camera", this.camera())?;
        state.set_item("psf", this.psf())?;
        state.set_item("dark", this.dark(py)?)?;
        state.set_item("flat", this.flat(py)?)?;
        state.set_item("bad_pixels", this.bad_pixels(py)?)?;
        state.set_item("prior", this.prior())?;
        state.set_item("tau", this.tau(py)?)?;
        state.set_item("frame_period_us", this.frame_period_us)?;
        let metadata = &this.from_metadata;
        state.set_item(
            "metadata",
            (&metadata.sources, &metadata.values, &metadata.warnings),
        )?;
        Ok((slf.get_type().getattr("_restore")?, (state,)))
    }

    /// The experiment of what `__reduce__` gives.
    #[classmethod]
    fn _restore(_cls: &Bound<'_, PyType>, state: &Bound<'_, PyDict>) -> PyResult<Self> {
        let image = |name: &str| -> PyResult<Option<Image>> {
            let value = optional_entry(state, name)?;
            value.map(|value| finite_image(&value, name)).transpose()
        };
        let psf = optional_entry(state, "psf")?;
        let psf = psf.map(|psf| Ok::<_, PyErr>(psf.cast::<PyPsf>()?.get().psfs.clone()));
        let (sources, values, warnings) = entry(state, "metadata")?.extract()?;
        Ok(Self {
            camera: entry(state, "camera")?.extract()?,
            psfs: psf.transpose()?,
            dark: image("dark")?,
            flat: image("flat")?,
            bad_pixels: image("bad_pixels")?,
            prior: entry(state, "prior")?.extract()?,
            tau: tau_from(Some(&entry(state, "tau")?))?,
            frame_period_us: entry(state, "frame_period_us")?.extract()?,
            from_metadata: FromMetadata {
                sources,
                values,
                warnings,
            },
        })
    }
}
