//! `rowburst.Psf`.

use crate::array::{capture, frame_of_maker, from_image};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::interrupt::interruptibly;
use crate::pickle::State3;
use crate::whole::{Number, Whole, optional_real, real_pairs};
use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::PyType;
use rowburst::{Camera, Error, Image, Parameter, PatchSet, PsfCapture};
use rowburst_run::inputs::{psf_from_capture, read_psfs};
use rowburst_run::simulate::{LensOptics, pixel_pitch_um, speckle_for};
use std::path::PathBuf;

/// What `Psf.__reduce__` gives: of each PSF the values, the offset, and noise and pinhole of its capture.
type Stored<'py> =
    State3<'py, Vec<Bound<'py, PyArray2<f32>>>, Vec<(f64, f64)>, Vec<Option<(f64, f64)>>>;

/// A point-spread function that sums to 1, or several that share out the field.
///
/// The element at ``(height // 2, width // 2)`` is zero displacement.
///
/// Parameters
/// ----------
/// values : array
///     The PSF ``[y, x]``, not negative; it is scaled to the sum 1.
///
/// Raises
/// ------
/// InputError
///     An element is negative or not finite, or all are zero.
///
/// Examples
/// --------
/// >>> centred = rb.Psf(np.eye(5))
/// >>> centred.shape, float(centred.array.sum())
/// ((5, 5), 1.0)
#[allow(clippy::doc_lazy_continuation)]
#[pyclass(name = "Psf", module = "rowburst", frozen, eq)]
#[derive(Clone, PartialEq)]
pub struct PyPsf {
    pub psfs: PatchSet,
}

#[pymethods]
impl PyPsf {
    /// Non-negative values, which are scaled to sum to 1.
    #[new]
    fn new(values: &Bound<'_, PyAny>) -> PyResult<Self> {
        let psf = rowburst::Psf::new(capture(values, "PSF")?.image).map_err(to_py_err)?;
        Ok(Self { psfs: psf.into() })
    }

    /// PSFs with the offset ``(dy, dx)`` of each one's source from the middle of the field.
    ///
    /// Parameters
    /// ----------
    /// values : sequence of array
    ///     The PSFs ``[y, x]``, of one size.
    /// offsets_px : sequence of tuple
    ///     The offset of each, in pixels.
    ///
    /// Returns
    /// -------
    /// Psf
    ///     PSFs that share out the field.
    ///
    /// Raises
    /// ------
    /// InputError
    ///     The numbers of PSFs and offsets differ, or a PSF breaks a rule.
    ///
    /// Examples
    /// --------
    /// >>> pair = rb.Psf.patches([np.eye(5), np.eye(5)[::-1]], [(-10, 0), (10, 0)])
    /// >>> len(pair.arrays), pair.offsets_px
    /// (2, [(-10.0, 0.0), (10.0, 0.0)])
    #[allow(clippy::doc_lazy_continuation)]
    #[staticmethod]
    fn patches(values: Vec<Bound<'_, PyAny>>, offsets_px: Vec<(Number, Number)>) -> PyResult<Self> {
        let offsets_px = real_pairs(offsets_px, "offsets_px")?;
        let psfs = values.iter().map(|v| {
            let image = capture(v, "PSF")?.image;
            rowburst::Psf::new(image).map_err(to_py_err)
        });
        let psfs = PatchSet::new(psfs.collect::<PyResult<_>>()?, offsets_px);
        Ok(Self {
            psfs: psfs.map_err(to_py_err)?,
        })
    }

    /// An image, or the patch set of ``rowburst calibrate psf``, as the command line reads it.
    ///
    /// Parameters
    /// ----------
    /// path : path
    ///     The file.
    /// camera : Camera
    ///     The camera that the PSF is for.
    ///
    /// Returns
    /// -------
    /// Psf
    ///     The PSF, which sums to 1.
    ///
    /// Raises
    /// ------
    /// InputError
    ///     The file is missing, damaged or of another kind.
    ///
    /// Examples
    /// --------
    /// >>> rb.Psf.from_file("psf.npy", camera).shape
    /// (47, 59)
    #[allow(clippy::doc_lazy_continuation)]
    #[staticmethod]
    fn from_file(py: Python<'_>, path: PathBuf, camera: &PyCamera) -> PyResult<Self> {
        let camera = &camera.camera;
        if let Some(frame) = frame_of_maker(py, &path)? {
            let found = psf_from_capture(capture(&frame, "PSF")?, camera, None);
            let (psf, _) = found.map_err(|error| to_py_err(error.within(&path)))?;
            return Ok(Self { psfs: psf.into() });
        }
        let read = py.detach(|| read_psfs(&path, camera, None));
        let (psfs, _) = read.map_err(to_py_err)?;
        Ok(Self { psfs })
    }

    /// The PSF of each patch, ``[y, x]``; each sums to 1.
    #[getter]
    fn arrays<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyArray2<f32>>>> {
        let psfs = self.psfs.psfs().iter();
        psfs.map(|psf| from_image(py, psf.image().clone()))
            .collect()
    }

    /// The PSF nearest to the middle of the field, ``[y, x]``.
    #[getter]
    fn array<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        from_image(py, self.psfs.central().image().clone())
    }

    /// The offset ``(dy, dx)`` of each patch's source from the middle of the field, in pixels.
    #[getter]
    fn offsets_px(&self) -> Vec<(f64, f64)> {
        self.psfs.offsets_px().to_vec()
    }

    /// Rows and columns of the PSF nearest to the middle.
    #[getter]
    fn shape(&self) -> (usize, usize) {
        let image = self.psfs.central().image();
        (image.rows(), image.columns())
    }

    #[pyo3(signature = (dtype=None, copy=None))]
    fn __array__<'py>(
        &self,
        py: Python<'py>,
        dtype: Option<Bound<'py, PyAny>>,
        copy: Option<bool>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let _ = copy;
        let array = self.array(py)?.into_any();
        match dtype {
            Some(dtype) => array.call_method1("astype", (dtype,)),
            None => Ok(array),
        }
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<Stored<'py>> {
        let this = slf.get();
        let restore = slf.get_type().getattr("_restore")?;
        let captures = this.psfs.psfs().iter().map(|psf| {
            let capture = psf.capture()?;
            Some((capture.noise_per_light, capture.pinhole_px))
        });
        let arrays = this.arrays(slf.py())?;
        Ok((restore, (arrays, this.offsets_px(), captures.collect())))
    }

    /// The PSF of what `__reduce__` gives, bit for bit.
    #[classmethod]
    fn _restore(
        _cls: &Bound<'_, PyType>,
        values: Vec<Bound<'_, PyAny>>,
        offsets_px: Vec<(f64, f64)>,
        captures: Vec<Option<(f64, f64)>>,
    ) -> PyResult<Self> {
        let psfs = values.iter().zip(captures).map(|(v, known)| {
            let image = capture(v, "PSF")?.image;
            let psf = rowburst::Psf::from_normalized(image).map_err(to_py_err)?;
            Ok(
                psf.with_capture(known.map(|(noise_per_light, pinhole_px)| PsfCapture {
                    noise_per_light,
                    pinhole_px,
                })),
            )
        });
        let psfs = PatchSet::new(psfs.collect::<PyResult<_>>()?, offsets_px);
        Ok(Self {
            psfs: psfs.map_err(to_py_err)?,
        })
    }

    fn __repr__(&self) -> String {
        let (rows, columns) = self.shape();
        match self.psfs.psfs().len() {
            1 => format!("Psf({rows}×{columns})"),
            n => format!("Psf({n} patches of {rows}×{columns})"),
        }
    }

    /// What notebooks show.
    fn _repr_html_(slf: &Bound<'_, Self>) -> PyResult<String> {
        crate::html::of(slf, "psf_html")
    }
}

/// A `Psf`, or an array: as the command line takes a file of such numbers.
pub fn psfs_of(
    value: &Bound<'_, PyAny>,
    camera: &Camera,
    dark: Option<&Image>,
) -> PyResult<PatchSet> {
    if let Ok(psf) = value.cast::<PyPsf>() {
        return Ok(psf.get().psfs.clone());
    }
    if value.is_none() {
        return Err(to_py_err(Error::input(
            Parameter::Psf,
            "None",
            "the point-spread function of the diffuser is needed",
            "Give psf=..., an array, a Psf or a file, or write psf = \"FILE\" under [calibration] of the experiment file.",
        )));
    }
    let (psf, _) = psf_from_capture(capture(value, "PSF")?, camera, dark).map_err(to_py_err)?;
    Ok(psf.into())
}

/// A random speckle PSF of a diffuser behind a lens, for every displacement that a camera sees.
///
/// Parameters
/// ----------
/// camera : Camera
///     The camera; its pixel pitch is that of the paper where it has none.
/// wavelength_nm : float
///     Wavelength in nanometres.
/// pupil_mm, focal_length_mm : float
///     Diameter of the pupil and focal length of the lens in millimetres.
/// magnification : float
///     Size on the sensor over size in the scene.
/// na : float, optional
///     Numerical aperture on the side of the sensor, instead of the diameter of the pupil.
/// diffuser_deg : float
///     Full width at half maximum of its scattering in degrees.
/// diffuser_phase : float
///     Rms of its phase in radians.
/// seed : int
///     The seed of the diffuser.
///
/// Returns
/// -------
/// Psf
///     The PSF ``[y, x]``.
///
/// Raises
/// ------
/// InputError
///     An argument breaks a rule.
///
/// Examples
/// --------
/// >>> rb.speckle_psf(camera).shape
/// (47, 59)
#[allow(clippy::doc_lazy_continuation)]
#[pyfunction]
#[pyo3(signature = (camera, *, wavelength_nm=Number::of(532.0), pupil_mm=Number::of(1.71),
    focal_length_mm=Number::of(50.0), magnification=Number::of(1.0 / 22.5), na=None, diffuser_deg=Number::of(1.0),
    diffuser_phase=Number::of(4.0), seed=Whole::of(1)),
    text_signature = "(camera, *, wavelength_nm=532.0, pupil_mm=1.71, focal_length_mm=50.0, magnification=..., na=None, diffuser_deg=1.0, diffuser_phase=4.0, seed=1)")]
#[allow(clippy::too_many_arguments)]
pub fn speckle_psf(
    py: Python<'_>,
    camera: &PyCamera,
    wavelength_nm: Number,
    pupil_mm: Number,
    focal_length_mm: Number,
    magnification: Number,
    na: Option<Number>,
    diffuser_deg: Number,
    diffuser_phase: Number,
    seed: Whole,
) -> PyResult<PyPsf> {
    let camera = camera.camera.clone();
    let seed = seed.named("seed")? as u64;
    let optics = LensOptics {
        wavelength_nm: wavelength_nm.named("wavelength_nm")?,
        pupil_mm: pupil_mm.named("pupil_mm")?,
        focal_length_mm: focal_length_mm.named("focal_length_mm")?,
        magnification: magnification.named("magnification")?,
        na: optional_real(na, "na")?,
        diffuser_deg: diffuser_deg.named("diffuser_deg")?,
    };
    let diffuser_phase = diffuser_phase.named("diffuser_phase")?;
    let optics = optics.optics(pixel_pitch_um(&camera));
    let psf = interruptibly::<(), _>(py, None, None, move |_| {
        speckle_for(&camera, &optics, diffuser_phase, seed)
    })?;
    Ok(PyPsf {
        psfs: psf.map_err(to_py_err)?.into(),
    })
}
