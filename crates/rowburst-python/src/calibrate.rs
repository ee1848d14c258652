//! `rowburst.calibrate`: captures into the numbers of a sensor, a PSF and a shutter.

use crate::array::{capture, finite_image, from_image, path_of};
use crate::camera::PyCamera;
use crate::error::{subject, to_py_err};
use crate::interrupt::interruptibly;
use crate::psf::PyPsf;
use crate::task::threads_from;
use crate::threads::detached;
use crate::whole::{Number, Numbers, Whole, optional, optional_real, real_pairs};
use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};
use rowburst::calibrate::psf::NamedCapture;
use rowburst::calibrate::timing::{Extension, Lamp, Waveform};
use rowburst::{Error, ErrorKind, Image, Parameter};
use rowburst_io::{ForeignFiles, OutputFolder, read_colour_image};
use rowburst_run::calibrate::psf::{
    CaptureGroup, PsfCalibration, PsfFolder, PsfInputs, read_captures,
};
use rowburst_run::calibrate::sensor::{CalibratedSensor, calibrate_frames, read_frames};
use rowburst_run::calibrate::timing::{TimingCalibration, TimingInputs, read_waveform};
use std::ops::ControlFlow;
use std::path::PathBuf;

type Picture<'py> = PyResult<Bound<'py, PyArray2<f32>>>;

/// The parts of a list, a tuple or an array `[frame, y, x]`, with names for messages; a path and an array `[y, x]` are one
/// part.
fn parts<'py>(value: &Bound<'py, PyAny>, name: &str) -> PyResult<Vec<(String, Bound<'py, PyAny>)>> {
    let is_list = value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>();
    let axes = || -> Option<usize> { value.getattr("ndim").ok()?.extract().ok() };
    if path_of(value).is_some() || !(is_list || axes() == Some(3)) {
        return Ok(vec![(name.to_string(), value.clone())]);
    }
    (0..value.len()?)
        .map(|i| Ok((format!("{name}[{i}]"), value.get_item(i)?)))
        .collect()
}

/// Frames of paths and arrays, as the command line reads them.
fn frames_of(value: &Bound<'_, PyAny>, parameter: Parameter) -> PyResult<Vec<(String, Image)>> {
    let mut frames = Vec::new();
    for (part, value) in parts(value, parameter.name())? {
        if let Some(path) = path_of(&value) {
            let files = detached(value.py(), || read_frames(parameter, &[path]))?;
            frames.extend(files.map_err(to_py_err)?);
            continue;
        }
        for (page, value) in parts(&value, &part)? {
            frames.push((page, capture(&value, &part)?.image));
        }
    }
    Ok(frames)
}

/// A calibrated sensor.
#[pyclass(name = "_SensorCalibration", module = "rowburst._rowburst", frozen)]
pub struct PySensorCalibration {
    sensor: CalibratedSensor,
}

#[pymethods]
impl PySensorCalibration {
    #[new]
    #[pyo3(signature = (darks, flats, *, threads=None))]
    fn new(
        py: Python<'_>,
        darks: &Bound<'_, PyAny>,
        flats: &Bound<'_, PyAny>,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let threads = threads_from(threads)?;
        let (darks, flats) = (
            frames_of(darks, Parameter::Darks)?,
            frames_of(flats, Parameter::Flats)?,
        );
        let made = interruptibly::<(), _>(py, threads, None, move |_| {
            let sensor = calibrate_frames(darks, flats, None, &mut |_| ControlFlow::Continue(()))?;
            Ok(Self { sensor })
        })?;
        made.map_err(to_py_err)
    }

    fn json(&self) -> String {
        self.sensor.summary.to_string()
    }

    #[getter]
    fn dark<'py>(&self, py: Python<'py>) -> Picture<'py> {
        from_image(py, self.sensor.calibration.dark.clone())
    }

    #[getter]
    fn flat<'py>(&self, py: Python<'py>) -> Picture<'py> {
        from_image(py, self.sensor.calibration.flat.clone())
    }

    #[getter]
    fn response<'py>(&self, py: Python<'py>) -> Picture<'py> {
        from_image(py, self.sensor.calibration.response.clone())
    }

    #[getter]
    fn read_noise<'py>(&self, py: Python<'py>) -> Picture<'py> {
        from_image(py, self.sensor.calibration.read_noise.clone())
    }

    #[getter]
    fn bad_pixels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        let dark = &self.sensor.calibration.dark;
        let faults = &self.sensor.calibration.faults;
        let bad = (0..dark.data().len()).map(|i| faults.is_bad(i));
        PyArray1::from_iter(py, bad).reshape([dark.rows(), dark.columns()])
    }

    fn save(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        let write = || {
            let folder = OutputFolder::claim(&folder, "calibrate sensor", ForeignFiles::Accept)?;
            self.sensor.write(&folder, None)
        };
        detached(py, write)?.map_err(to_py_err)
    }
}

/// The PSF of captures.
#[pyclass(name = "_PsfCalibration", module = "rowburst._rowburst", frozen)]
pub struct PyPsfCalibration {
    calibration: PsfCalibration,
}

/// The captures of one group or of one for each place.
fn groups_of(captures: &Bound<'_, PyAny>, has_positions: bool) -> PyResult<Vec<CaptureGroup>> {
    let mut groups = Vec::new();
    for (part, value) in parts(captures, "captures")? {
        if let Some(path) = path_of(&value) {
            let files = detached(value.py(), || read_captures(&[path]))?;
            let files = files.map_err(to_py_err)?;
            groups.extend(files.into_iter().map(CaptureGroup::from));
            continue;
        }
        let (mut shots, mut limits) = (Vec::new(), Vec::new());
        for (name, value) in parts(&value, &part)? {
            let found = capture(&value, &part)?;
            limits.push(found.format.saturation_limit());
            shots.push(NamedCapture {
                name,
                image: found.image,
            });
        }
        groups.push(CaptureGroup {
            shots,
            // As of a file of several pages, whose kind is not asked.
            saturation_limit: limits.pop().flatten().filter(|_| limits.is_empty()),
        });
    }
    if has_positions {
        return Ok(groups);
    }
    Ok(CaptureGroup::join(groups))
}

#[pymethods]
impl PyPsfCalibration {
    #[new]
    #[pyo3(signature = (captures, *, dark=None, camera=None, exposures_ms=Numbers::none(), positions_mm=None, binning=None,
        saturation_counts=None, field=None, expected_grain_px=None, pinhole_um=None, all_patches=false, threads=None))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        captures: &Bound<'_, PyAny>,
        dark: Option<&Bound<'_, PyAny>>,
        camera: Option<&PyCamera>,
        exposures_ms: Numbers,
        positions_mm: Option<Vec<(Number, Number)>>,
        binning: Option<Whole>,
        saturation_counts: Option<Number>,
        field: Option<(Whole, Whole)>,
        expected_grain_px: Option<Number>,
        pinhole_um: Option<Number>,
        all_patches: bool,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let threads = threads_from(threads)?;
        let saturation_counts = optional_real(saturation_counts, "saturation_counts")?;
        let expected_grain_px = optional_real(expected_grain_px, "expected_grain_px")?;
        let pinhole_um = optional_real(pinhole_um, "pinhole_um")?;
        let exposures_ms = exposures_ms.named("exposures_ms")?;
        let positions_mm = positions_mm
            .map(|pairs| real_pairs(pairs, "positions_mm"))
            .transpose()?;
        for (name, value) in [
            ("saturation_counts", saturation_counts),
            ("expected_grain_px", expected_grain_px),
        ] {
            if let Some(bad) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                let remedy = "Leave it out where it is not known.";
                let error = Error::input(
                    subject(name),
                    bad,
                    "the value is a number above zero",
                    remedy,
                );
                return Err(to_py_err(error));
            }
        }
        let groups = groups_of(captures, positions_mm.is_some())?;
        if let Some(positions) = positions_mm.as_ref().filter(|p| p.len() != groups.len()) {
            return Err(to_py_err(Error::input(
                Parameter::PositionsMm,
                format!("{} positions", positions.len()),
                format!(
                    "each of the {} captures has its position (y, x)",
                    groups.len()
                ),
                "Give one for each file or array.",
            )));
        }
        let camera = camera.map(|c| &c.camera);
        let sensor = camera.map(|c| c.sensor());
        let binning = optional(binning, "binning")?;
        if binning.is_some_and(|b| !(1..=64).contains(&b)) {
            let rule = "a pixel of the working grid has 1 to 64 raw pixels along a side";
            let error = Error::input(
                Parameter::Binning,
                binning.unwrap_or(0),
                rule,
                "Leave it out.",
            );
            return Err(to_py_err(error));
        }
        let field =
            field.map(|(rows, columns)| Ok((rows.named("field")?, columns.named("field")?)));
        let inputs = PsfInputs {
            groups,
            positions_mm,
            dark: dark.map(|dark| finite_image(dark, "dark")).transpose()?,
            exposures_ms,
            saturation_counts: saturation_counts.or(sensor.and_then(|s| s.saturation_counts())),
            binning: binning.unwrap_or(sensor.map_or(1, |s| s.binning)),
            field: field
                .transpose()
                .map(|field: Option<(usize, usize)>| field.or(camera.map(|c| c.field())))
                .map_err(|e: PyErr| e)?,
            sensor_rows: camera.map(|c| c.rows()),
            expected_grain_px,
            pinhole_um,
            object_pixel_um: sensor.and_then(|s| s.object_pixel_um()),
            all_patches,
        };
        let calibration = interruptibly::<(), _>(py, threads, None, move |_| inputs.calibrate())?;
        Ok(Self {
            calibration: calibration.map_err(to_py_err)?,
        })
    }

    fn json(&self) -> String {
        serde_json::to_string(&self.calibration.summary).expect("plain numbers and text")
    }

    #[getter]
    fn psf(&self) -> PyPsf {
        PyPsf {
            psfs: self.calibration.psf.clone().into(),
        }
    }

    #[getter]
    fn patches(&self) -> Option<PyPsf> {
        let patches = self.calibration.patches.clone();
        patches.map(|psfs| PyPsf { psfs })
    }

    fn save(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        let beside = PsfFolder {
            experiment: None,
            field: None,
            reproduce: None,
        };
        let write = || {
            self.calibration.write(
                &OutputFolder::claim(&folder, "calibrate psf", ForeignFiles::Accept)?,
                beside,
            )
        };
        detached(py, write)?.map_err(to_py_err)
    }
}

/// The timing of a shutter.
#[pyclass(name = "_TimingCalibration", module = "rowburst._rowburst", frozen)]
pub struct PyTimingCalibration {
    timing: TimingCalibration,
}

/// A frame of a path or an array; the channels of one in colour are averaged. And where its kind of numbers ends.
fn light_frame(value: &Bound<'_, PyAny>, name: &str) -> PyResult<(Image, Option<f64>)> {
    let found = match path_of(value) {
        Some(path) => {
            let read = value.py().detach(|| read_colour_image(&path));
            read.map_err(to_py_err)?
        }
        None => capture(value, name)?,
    };
    Ok((found.image, found.format.saturation_limit()))
}

fn lamp_of(
    frequency_hz: Option<f64>,
    duty: Option<f64>,
    signal: Option<&Bound<'_, PyAny>>,
    repeat: bool,
) -> PyResult<Lamp> {
    match (frequency_hz, signal) {
        (Some(frequency_hz), None) => Ok(Lamp::Periodic { frequency_hz, duty }),
        (None, Some(signal)) => {
            let points: Vec<(f64, f64)> = match path_of(signal) {
                Some(path) => read_waveform(&path).map_err(to_py_err)?,
                None => real_pairs(signal.extract()?, "signal")?,
            };
            let extension = if repeat {
                Extension::Repeats
            } else {
                Extension::Holds
            };
            let waveform = Waveform::new(&points, extension).map_err(to_py_err)?;
            Ok(Lamp::Waveform(waveform))
        }
        _ => Err(to_py_err(
            Error::input(
                Parameter::FrequencyHz,
                if frequency_hz.is_some() {
                    "a signal as well"
                } else {
                    "nothing"
                },
                "the light is given by its frequency or its waveform",
                "Give frequency_hz or signal.",
            )
            .with_kind(ErrorKind::Missing),
        )),
    }
}

#[pymethods]
impl PyTimingCalibration {
    #[new]
    #[pyo3(signature = (frames, *, frequency_hz=None, duty=None, signal=None, repeat=false, dark=None, flat=None,
        camera=None, threads=None))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        frames: &Bound<'_, PyAny>,
        frequency_hz: Option<Number>,
        duty: Option<Number>,
        signal: Option<&Bound<'_, PyAny>>,
        repeat: bool,
        dark: Option<&Bound<'_, PyAny>>,
        flat: Option<&Bound<'_, PyAny>>,
        camera: Option<&PyCamera>,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let threads = threads_from(threads)?;
        let frequency_hz = optional_real(frequency_hz, "frequency_hz")?;
        let duty = optional_real(duty, "duty")?;
        let light = lamp_of(frequency_hz, duty, signal, repeat)?;
        let (mut images, mut end) = (Vec::new(), None);
        for (name, frame) in parts(frames, "frames")? {
            let (image, limit) = light_frame(&frame, &name)?;
            end = limit.or(end);
            images.push(image);
        }
        let other = |value: Option<&Bound<'_, PyAny>>, name: &str| {
            value
                .map(|v| Ok::<_, PyErr>(light_frame(v, name)?.0))
                .transpose()
        };
        let inputs = TimingInputs {
            frames: images,
            light,
            dark: other(dark, "dark")?,
            flat: other(flat, "flat")?,
            saturation_limit: end,
            camera: camera.map(|c| c.camera.clone()),
        };
        let found = interruptibly::<(), _>(py, threads, None, move |_| {
            let timing = inputs.calibrate(None)?;
            Ok(Self { timing })
        })?;
        found.map_err(to_py_err)
    }

    fn json(&self) -> String {
        serde_json::to_string(&self.timing.summary).expect("plain numbers and text")
    }

    #[getter]
    fn binning(&self) -> usize {
        self.timing.binning
    }

    fn save(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        let write = || {
            let folder = OutputFolder::claim(&folder, "calibrate timing", ForeignFiles::Accept)?;
            self.timing.write(&folder, None)
        };
        detached(py, write)?.map_err(to_py_err)
    }
}
