//! `rowburst.Experiment`: what an experiment file says, read.

use crate::array::{finite_image, from_image, makers_of};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::options::tau_from;
use crate::pickle::{State, entry, optional_entry};
use crate::psf::PyPsf;
use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use rowburst::guide::{Guide, GuideExposure};
use rowburst::reconstruct::Tau;
use rowburst::{Cancel, Image, PatchSet};
use rowburst_io::{Experiment, FromMetadata, Metadata, micro_manager_metadata, read_metadata};
use rowburst_run::GuideTask;
use rowburst_run::inputs::{read_corrections, read_psfs};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The content of an experiment file and of the files that it names.
///
/// Parameters
/// ----------
/// path : path
///     The experiment file, as ``rowburst init`` writes it.
/// frame : path, optional
///     A frame or a recording: keys that the file leaves open are taken from its metadata, also from that of a camera
///     maker's file.
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
    /// The pictures of `[[guide]]`.
    pub guides: Vec<Guide>,
    pub from_metadata: FromMetadata,
    /// The experiment file as it was read; `None` after pickling.
    pub file: Option<Experiment>,
}

/// What the metadata of a frame say, also of a file of a camera maker, which a package of Python reads.
pub fn metadata_of(py: Python<'_>, path: &Path) -> PyResult<Metadata> {
    let Some(makers) = makers_of(py, path)? else {
        return Ok(read_metadata(path));
    };
    let (settings, record): (Bound<'_, PyDict>, Option<String>) = makers
        .call_method1("metadata_of_maker", (path,))?
        .extract()?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let count = |name: &str| -> PyResult<Option<usize>> {
        let value = settings.get_item(name)?;
        value.map(|v| v.extract()).transpose()
    };
    let size = count("rows")?.zip(count("columns")?);
    if let Some(record) = record {
        let source = format!("Micro-Manager's record in {name}");
        return Ok(Metadata {
            size,
            ..micro_manager_metadata(&record, &source)
        });
    }
    let number = |name: &str| -> PyResult<Option<f64>> {
        let value = settings.get_item(name)?;
        value.map(|v| v.extract()).transpose()
    };
    Ok(Metadata {
        sources: vec![format!("the header of {name}")],
        size,
        exposure_us: number("exposure_us")?,
        frame_period_us: number("frame_period_us")?,
        binning: count("binning")?,
        ..Metadata::default()
    })
}

/// The time and the length of an exposure in µs, if they are known.
type Exposure = Option<(f64, f64)>;

type Pixels<'py> = PyResult<Option<Bound<'py, PyArray2<f32>>>>;

fn array<'py>(py: Python<'py>, image: &Option<Image>) -> Pixels<'py> {
    image.clone().map(|i| from_image(py, i)).transpose()
}

#[pymethods]
impl PyExperiment {
    /// What the file leaves open is taken from the metadata of `frame`, a file or a folder.
    #[new]
    #[pyo3(signature = (path, frame=None))]
    fn new(py: Python<'_>, path: PathBuf, frame: Option<PathBuf>) -> PyResult<Self> {
        let metadata = frame.map(|frame| metadata_of(py, &frame)).transpose()?;
        let metadata = metadata.unwrap_or_default();
        let read = || -> rowburst::Result<Self> {
            let experiment = Experiment::read_with(&path, &metadata)?;
            let camera = experiment.camera()?;
            let calibration = &experiment.calibration;
            let corrections = read_corrections(calibration)?;
            let dark = corrections.dark.as_ref();
            let psfs = calibration.psf.as_deref();
            let psfs = psfs.map(|p| read_psfs(p, &camera, dark)).transpose()?;
            let guide = GuideTask::read(&[], &experiment, None, &Cancel::default())?;
            Ok(Self {
                file: Some(experiment.clone()),
                guides: guide.map(|guide| guide.guides).unwrap_or_default(),
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
        py.detach(read).map_err(to_py_err)
    }

    /// The camera and the field.
    #[getter]
    fn camera(&self) -> PyCamera {
        self.camera.clone()
    }

    /// The PSF, or the PSFs of a patch set; None where the file names none.
    #[getter]
    fn psf(&self) -> Option<PyPsf> {
        self.psfs.clone().map(|psfs| PyPsf { psfs })
    }

    /// The frame without light ``[y, x]``, in counts; None where the file names none.
    #[getter]
    fn dark<'py>(&self, py: Python<'py>) -> Pixels<'py> {
        array(py, &self.dark)
    }

    /// The frame of even light ``[y, x]``, in counts; None where the file names none.
    #[getter]
    fn flat<'py>(&self, py: Python<'py>) -> Pixels<'py> {
        array(py, &self.flat)
    }

    /// The mask ``[y, x]``, not 0 at bad pixels; None where the file names none.
    #[getter]
    fn bad_pixels<'py>(&self, py: Python<'py>) -> Pixels<'py> {
        array(py, &self.bad_pixels)
    }

    /// The prior; ``auto`` where the file names none.
    #[getter]
    fn prior(&self) -> String {
        self.prior.clone()
    }

    /// The weight of the prior, ``auto`` or ``held-out``.
    #[getter]
    fn tau<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        match self.tau {
            Tau::Auto => Ok("auto".into_pyobject(py)?.into_any()),
            Tau::HeldOut => Ok("held-out".into_pyobject(py)?.into_any()),
            Tau::Given(tau) => Ok(tau.into_pyobject(py)?.into_any()),
        }
    }

    /// The pictures ``[y, x]`` of ``[[guide]]``, by a second camera; :func:`reconstruct` uses them.
    #[getter]
    fn guide<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyArray2<f32>>>> {
        let pictures = self.guides.iter();
        pictures
            .map(|guide| from_image(py, guide.image.clone()))
            .collect()
    }

    /// The middle of the exposure of each of these pictures and its length in microseconds; None where they are unknown.
    #[getter]
    fn guide_exposures_us(&self) -> Vec<Exposure> {
        let exposures = self.guides.iter().map(|guide| guide.exposure);
        exposures
            .map(|exposure| exposure.map(|e| (e.time_us, e.exposure_us)))
            .collect()
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

    /// A reconstructor with everything that the file says.
    ///
    /// Parameters
    /// ----------
    /// **options
    ///     Arguments of :class:`Reconstructor`, which take precedence.
    ///
    /// Returns
    /// -------
    /// Reconstructor
    ///     Set up once, called for each frame.
    ///
    /// Raises
    /// ------
    /// InputError
    ///     An argument breaks a rule, or the file names no PSF.
    ///
    /// Examples
    /// --------
    /// >>> rb.Experiment("experiment.toml").reconstructor(max_iterations=5)(frame).prior
    /// 'tv'
    #[allow(clippy::doc_lazy_continuation)]
    #[pyo3(signature = (**options))]
    fn reconstructor<'py>(
        slf: &Bound<'py, Self>,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let package = slf.py().import("rowburst")?;
        package.getattr("Reconstructor")?.call((slf,), options)
    }

    /// Time from the start of a frame to that of the next, in microseconds; None where it is unknown.
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
            has(!self.guides.is_empty(), "guide"),
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
        state.set_item("guide", this.guide(py)?)?;
        state.set_item("guide_exposures_us", this.guide_exposures_us())?;
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
        let pictures: Vec<Bound<'_, PyAny>> = entry(state, "guide")?.extract()?;
        let exposures: Vec<Exposure> = entry(state, "guide_exposures_us")?.extract()?;
        let guides = pictures.iter().zip(exposures).map(|(picture, exposure)| {
            Ok(Guide {
                image: finite_image(picture, "guide")?,
                exposure: exposure.map(|(time_us, exposure_us)| GuideExposure {
                    time_us,
                    exposure_us,
                }),
            })
        });
        Ok(Self {
            guides: guides.collect::<PyResult<_>>()?,
            file: None,
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
