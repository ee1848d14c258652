//! `rowburst.Camera`.

use crate::error::to_py_err;
use crate::whole::{Number, Whole, optional, optional_real};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use rowburst::bayer::Bayer;
use rowburst::camera::CameraParams;
use rowburst::{Camera, Error, ErrorKind, Parameter, Sensor, Shutter};
use rowburst_io::Experiment;
use std::path::PathBuf;

/// A rolling-shutter camera and the field that it is asked to reconstruct.
///
/// The names are the keys of the experiment file. Frames of a sensor with a mosaic (``bayer``) are reconstructed by
/// :func:`reconstruct_colour`.
///
/// Parameters
/// ----------
/// rows, columns : int
///     Pixels of the frame on the working grid, after binning.
/// shutter : str
///     ``"top-down"``, ``"bottom-up"``, ``"dual-inside-out"``, ``"dual-outside-in"``, ``"custom"`` or ``"global"``.
/// exposure_us : float
///     Exposure of a row in microseconds.
/// row_time_us : float, optional
///     Time from the readout of one row to that of the next in microseconds; needed unless the shutter is global.
/// row_order : sequence of int, optional
///     The instant of every row, for the shutter ``"custom"``.
/// binning : int
///     Raw pixels along a side of a pixel of the working grid.
/// bins_per_row : int
///     Bins of the video in a row time.
/// field : tuple of int, optional
///     Rows and columns of the video, if it is larger than the sensor.
/// pixel_pitch_um : float, optional
///     Width of a pixel in micrometres.
/// magnification : float, optional
///     Size of an image on the sensor over that of the object.
/// trigger_delay_us : float, optional
///     From the trigger to the start of exposure of the row that is read first.
/// bit_depth : int, optional
///     Bits of the converter.
/// bias_counts, gain_electrons_per_count, read_noise_electrons, full_well_counts : float, optional
///     The numbers of :func:`rowburst.calibrate.sensor`.
/// bayer : str, optional
///     The mosaic: ``"rggb"``, ``"bggr"``, ``"grbg"`` or ``"gbrg"``.
///
/// Raises
/// ------
/// InputError
///     A value breaks a rule.
///
/// Examples
/// --------
/// >>> zyla = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
/// >>> zyla.video_shape, round(zyla.frame_rate_hz)
/// ((54, 108, 108), 104167)
#[allow(clippy::doc_lazy_continuation)]
#[pyclass(name = "Camera", module = "rowburst", frozen, eq, from_py_object)]
#[derive(Clone, PartialEq)]
pub struct PyCamera {
    pub camera: Camera,
    /// The mosaic of a colour sensor whose frames are raw.
    pub bayer: Option<Bayer>,
}

impl From<Camera> for PyCamera {
    /// A camera without a mosaic.
    fn from(camera: Camera) -> Self {
        Self {
            camera,
            bayer: None,
        }
    }
}

impl PyCamera {
    /// The camera of grey frames.
    ///
    /// # Errors
    /// A mosaic: its four planes are videos of their own.
    pub fn grey(&self) -> PyResult<&Camera> {
        match self.bayer {
            None => Ok(&self.camera),
            Some(mosaic) => Err(to_py_err(Error::input(
                Parameter::Bayer,
                format!("\"{}\"", mosaic.name()),
                "a raw Bayer frame has four planes, and this function reconstructs one grey video",
                "Call rowburst.reconstruct_colour, which gives a video in colour. For a sensor without a mosaic, leave bayer out.",
            ).with_kind(ErrorKind::Unsupported))),
        }
    }
}

#[pymethods]
impl PyCamera {
    #[new]
    #[pyo3(signature = (*, rows, columns, shutter, exposure_us, row_time_us=None, row_order=None,
        binning=Whole::of(1), bins_per_row=Whole::of(1), field=None, pixel_pitch_um=None,
        magnification=None, trigger_delay_us=None, bit_depth=None, bias_counts=None, gain_electrons_per_count=None,
        read_noise_electrons=None, full_well_counts=None, bayer=None),
        text_signature = "(*, rows, columns, shutter, exposure_us, row_time_us=None, row_order=None, binning=1, bins_per_row=1, field=None, pixel_pitch_um=None, magnification=None, trigger_delay_us=None, bit_depth=None, bias_counts=None, gain_electrons_per_count=None, read_noise_electrons=None, full_well_counts=None, bayer=None)")]
    #[allow(clippy::too_many_arguments)]
    fn new(
        rows: Whole,
        columns: Whole,
        shutter: &str,
        exposure_us: Number,
        row_time_us: Option<Number>,
        row_order: Option<Vec<Whole>>,
        binning: Whole,
        bins_per_row: Whole,
        field: Option<(Whole, Whole)>,
        pixel_pitch_um: Option<Number>,
        magnification: Option<Number>,
        trigger_delay_us: Option<Number>,
        bit_depth: Option<Whole>,
        bias_counts: Option<Number>,
        gain_electrons_per_count: Option<Number>,
        read_noise_electrons: Option<Number>,
        full_well_counts: Option<Number>,
        bayer: Option<&str>,
    ) -> PyResult<Self> {
        let row_order = row_order
            .map(|order| order.into_iter().map(|k| k.named("row_order")).collect())
            .transpose()?;
        let shutter = shutter_of(shutter, row_order).map_err(to_py_err)?;
        let exposure_us = exposure_us.named("exposure_us")?;
        let row_time_us = optional_real(row_time_us, "row_time_us")?;
        let row_time_us = match shutter {
            Shutter::Global => row_time_us.unwrap_or(exposure_us),
            _ => row_time_us.ok_or_else(|| {
                let rule = "a rolling shutter has a time from row to row";
                let remedy = "Read it from the camera's data sheet or software.";
                to_py_err(
                    Error::input(Parameter::RowTimeUs, "nothing", rule, remedy)
                        .with_kind(ErrorKind::Missing),
                )
            })?,
        };
        let params = CameraParams {
            rows: rows.named("rows")?,
            columns: columns.named("columns")?,
            shutter,
            row_time_us,
            exposure_us,
            bins_per_row: bins_per_row.named("bins_per_row")?,
            field: field
                .map(|(rows, columns)| {
                    Ok::<_, PyErr>((rows.named("field")?, columns.named("field")?))
                })
                .transpose()?,
            sensor: Sensor {
                binning: binning.named("binning")?,
                pixel_pitch_um: optional_real(pixel_pitch_um, "pixel_pitch_um")?,
                magnification: optional_real(magnification, "magnification")?,
                trigger_delay_us: optional_real(trigger_delay_us, "trigger_delay_us")?,
                // What 32 bits cannot hold is out of range as well.
                bit_depth: optional(bit_depth, "bit_depth")?
                    .map(|bits| u32::try_from(bits).unwrap_or(u32::MAX)),
                bias_counts: optional_real(bias_counts, "bias_counts")?,
                gain_electrons_per_count: optional_real(
                    gain_electrons_per_count,
                    "gain_electrons_per_count",
                )?,
                read_noise_electrons: optional_real(read_noise_electrons, "read_noise_electrons")?,
                full_well_counts: optional_real(full_well_counts, "full_well_counts")?,
            },
        };
        let camera = Camera::new(params).map_err(to_py_err)?;
        let bayer = bayer.map(mosaic_of).transpose().map_err(to_py_err)?;
        Ok(Self { camera, bayer })
    }

    /// The camera of an experiment file.
    ///
    /// Parameters
    /// ----------
    /// path : path
    ///     The experiment file.
    ///
    /// Returns
    /// -------
    /// Camera
    ///     The camera and the field.
    ///
    /// Raises
    /// ------
    /// InputError
    ///     The file is missing or breaks a rule.
    ///
    /// Examples
    /// --------
    /// >>> rb.Camera.from_file("experiment.toml") == camera
    /// True
    #[allow(clippy::doc_lazy_continuation)]
    #[staticmethod]
    fn from_file(path: PathBuf) -> PyResult<Self> {
        let read = || {
            let experiment = Experiment::read(&path)?;
            Ok(Self {
                camera: experiment.camera()?,
                bayer: experiment.bayer,
            })
        };
        read().map_err(to_py_err)
    }

    /// The text of an experiment file with this camera.
    ///
    /// Returns
    /// -------
    /// str
    ///     TOML, which :meth:`from_file` and the command line read.
    ///
    /// Examples
    /// --------
    /// >>> "[camera]" in camera.to_toml().splitlines()
    /// True
    #[allow(clippy::doc_lazy_continuation)]
    fn to_toml(&self) -> String {
        let experiment = Experiment {
            bayer: self.bayer,
            ..Experiment::new(self.camera.params().clone())
        };
        experiment.to_toml("".as_ref())
    }

    /// Rows of the frame on the working grid.
    #[getter]
    fn rows(&self) -> usize {
        self.camera.rows()
    }

    /// Columns of the frame on the working grid.
    #[getter]
    fn columns(&self) -> usize {
        self.camera.columns()
    }

    /// The readout order, such as ``dual-inside-out``.
    #[getter]
    fn shutter(&self) -> &'static str {
        self.camera.shutter().name()
    }

    /// The instant of every row for the shutter ``custom``.
    #[getter]
    fn row_order(&self) -> Option<Vec<usize>> {
        match self.camera.shutter() {
            Shutter::Custom(order) => Some(order.clone()),
            _ => None,
        }
    }

    /// The mosaic of a colour sensor whose frames are raw, such as ``rggb``.
    #[getter]
    fn bayer(&self) -> Option<&'static str> {
        self.bayer.map(Bayer::name)
    }

    /// Time from the readout of one row to that of the next, in microseconds.
    #[getter]
    fn row_time_us(&self) -> f64 {
        self.camera.params().row_time_us
    }

    /// Exposure of a row, in microseconds.
    #[getter]
    fn exposure_us(&self) -> f64 {
        self.camera.params().exposure_us
    }

    /// Bins of the video in a row time.
    #[getter]
    fn bins_per_row(&self) -> usize {
        self.camera.params().bins_per_row
    }

    /// Raw pixels along a side of a pixel of the working grid.
    #[getter]
    fn binning(&self) -> usize {
        self.camera.sensor().binning
    }

    /// ``(rows, columns)`` of the video.
    #[getter]
    fn field(&self) -> (usize, usize) {
        self.camera.field()
    }

    /// Width of a pixel in micrometres; None where it is unknown.
    #[getter]
    fn pixel_pitch_um(&self) -> Option<f64> {
        self.camera.sensor().pixel_pitch_um
    }

    /// Size of an image on the sensor over that of the object; None where it is unknown.
    #[getter]
    fn magnification(&self) -> Option<f64> {
        self.camera.sensor().magnification
    }

    /// From the trigger to the zero of time, in microseconds; None where it is unknown.
    #[getter]
    fn trigger_delay_us(&self) -> Option<f64> {
        self.camera.sensor().trigger_delay_us
    }

    /// Bits of the converter; None where they are unknown.
    #[getter]
    fn bit_depth(&self) -> Option<u32> {
        self.camera.sensor().bit_depth
    }

    /// Counts of a pixel without light; None where they are unknown.
    #[getter]
    fn bias_counts(&self) -> Option<f64> {
        self.camera.sensor().bias_counts
    }

    /// Electrons of a count; None where they are unknown.
    #[getter]
    fn gain_electrons_per_count(&self) -> Option<f64> {
        self.camera.sensor().gain_electrons_per_count
    }

    /// Standard deviation of the read noise, in electrons; None where it is unknown.
    #[getter]
    fn read_noise_electrons(&self) -> Option<f64> {
        self.camera.sensor().read_noise_electrons
    }

    /// Counts at which a pixel is full; None where they are unknown.
    #[getter]
    fn full_well_counts(&self) -> Option<f64> {
        self.camera.sensor().full_well_counts
    }

    /// ``(bins, rows, columns)`` of the video.
    #[getter]
    fn video_shape(&self) -> (usize, usize, usize) {
        let shape = self.camera.video_shape();
        (shape.bins, shape.rows, shape.columns)
    }

    /// ``(rows, columns)`` of the frame on the working grid.
    #[getter]
    fn frame_shape(&self) -> (usize, usize) {
        (self.camera.rows(), self.camera.columns())
    }

    /// Frames of the video a second.
    #[getter]
    fn frame_rate_hz(&self) -> f64 {
        self.camera.time().frame_rate_hz()
    }

    /// The middle of each bin of the video, in microseconds from the start of exposure of the row that is read first.
    #[getter]
    fn time_us<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let time = self.camera.time();
        PyArray1::from_iter(py, (0..time.bins()).map(|bin| time.middle_us(bin)))
    }

    /// ``w[r, j]``: overlap of the exposure of row ``r`` with bin ``j``, in row times.
    ///
    /// Returns
    /// -------
    /// numpy.ndarray
    ///     float32 ``[row, bin]``.
    ///
    /// Examples
    /// --------
    /// >>> weights = camera.row_time_weights()
    /// >>> weights.shape, float(weights[0].sum())
    /// ((24, 12), 1.0)
    #[allow(clippy::doc_lazy_continuation)]
    fn row_time_weights<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let time = self.camera.time();
        let (rows, bins) = (self.camera.rows(), time.bins());
        let mut weights = vec![0.0f32; rows * bins];
        for (row, &instant) in self.camera.instants().iter().enumerate() {
            let run = &time.instants()[instant];
            for (i, &w) in run.weights.iter().enumerate() {
                weights[row * bins + run.first_bin + i] = w as f32;
            }
        }
        let image = rowburst::Image::new(rows, bins, weights).map_err(to_py_err)?;
        crate::array::from_image(py, image)
    }

    fn __reduce__<'py>(
        slf: &Bound<'py, Self>,
    ) -> PyResult<(Bound<'py, PyAny>, (Bound<'py, PyDict>,))> {
        let (this, keys) = (slf.get(), PyDict::new(slf.py()));
        let params = this.camera.params();
        keys.set_item("rows", params.rows)?;
        keys.set_item("columns", params.columns)?;
        keys.set_item("shutter", this.shutter())?;
        keys.set_item("exposure_us", params.exposure_us)?;
        keys.set_item("row_time_us", params.row_time_us)?;
        keys.set_item("row_order", this.row_order())?;
        keys.set_item("binning", params.sensor.binning)?;
        keys.set_item("bins_per_row", params.bins_per_row)?;
        keys.set_item("field", params.field)?;
        keys.set_item("pixel_pitch_um", this.pixel_pitch_um())?;
        keys.set_item("magnification", this.magnification())?;
        keys.set_item("trigger_delay_us", this.trigger_delay_us())?;
        keys.set_item("bit_depth", this.bit_depth())?;
        keys.set_item("bias_counts", this.bias_counts())?;
        keys.set_item("gain_electrons_per_count", this.gain_electrons_per_count())?;
        keys.set_item("read_noise_electrons", this.read_noise_electrons())?;
        keys.set_item("full_well_counts", this.full_well_counts())?;
        keys.set_item("bayer", this.bayer())?;
        keys.set_item("start_us", this.camera.time().start_us())?;
        Ok((slf.get_type().getattr("_restore")?, (keys,)))
    }

    /// A camera that differs in the given arguments of the constructor.
    ///
    /// After a calibration of the sensor: ``camera.replace(**sensor.camera_fields)``.
    ///
    /// Parameters
    /// ----------
    /// **changes
    ///     Arguments of :class:`Camera`.
    ///
    /// Returns
    /// -------
    /// Camera
    ///     Another camera; this one stays as it is.
    ///
    /// Raises
    /// ------
    /// InputError
    ///     A value breaks a rule.
    ///
    /// Examples
    /// --------
    /// >>> camera.replace(exposure_us=19.2).exposure_us
    /// 19.2
    #[allow(clippy::doc_lazy_continuation)]
    #[pyo3(signature = (**changes))]
    fn replace<'py>(
        slf: &Bound<'py, Self>,
        changes: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (_, (keys,)) = Self::__reduce__(slf)?;
        keys.del_item("start_us")?;
        if let Some(changes) = changes {
            keys.update(changes.as_mapping())?;
        }
        slf.get_type().call((), Some(&keys))
    }

    /// The camera of what `__reduce__` gives.
    #[classmethod]
    fn _restore<'py>(
        cls: &Bound<'py, PyType>,
        keys: &Bound<'py, PyDict>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let keys = keys.copy()?;
        let start_us: Option<f64> = keys
            .get_item("start_us")?
            .map(|us| us.extract())
            .transpose()?;
        if start_us.is_some() {
            keys.del_item("start_us")?;
        }
        let found = cls.call((), Some(&keys))?;
        let PyCamera { camera, bayer } = found.extract()?;
        match start_us.filter(|us| *us != camera.time().start_us()) {
            // The plane of a colour sensor.
            Some(start_us) => {
                let camera = camera.starting_at(start_us);
                Ok(Bound::new(cls.py(), Self { camera, bayer })?.into_any())
            }
            None => Ok(found),
        }
    }

    fn __repr__(&self) -> String {
        let shape = self.camera.video_shape();
        format!(
            "Camera(rows={}, columns={}, shutter='{}', row_time_us={}, exposure_us={}) # {} frames at {:.0} fps",
            self.rows(),
            self.columns(),
            self.shutter(),
            self.row_time_us(),
            self.exposure_us(),
            shape.bins,
            self.frame_rate_hz()
        )
    }

    /// What notebooks show.
    fn _repr_html_(slf: &Bound<'_, Self>) -> PyResult<String> {
        crate::html::of(slf, "camera_html")
    }
}

pub fn mosaic_of(name: &str) -> rowburst::Result<Bayer> {
    Bayer::from_name(name).ok_or_else(|| {
        Error::input(
            Parameter::Bayer,
            format!("\"{name}\""),
            format!("the mosaic is one of {}", Bayer::NAMES.join(", ")),
            "Give the colours of the first two pixels of the first row, then of the second.",
        )
    })
}

fn shutter_of(name: &str, row_order: Option<Vec<usize>>) -> rowburst::Result<Shutter> {
    match (name, row_order, Shutter::from_name(name)) {
        ("custom", Some(order), _) => Ok(Shutter::Custom(order)),
        ("custom", None, _) => Err(Error::input(
            Parameter::RowOrder,
            "nothing",
            "the shutter \"custom\" needs the instant of every row",
            "Give row_order=[k of row 0, k of row 1, …].",
        )
        .with_kind(ErrorKind::Missing)),
        (_, None, Some(shutter)) => Ok(shutter),
        (_, Some(_), Some(_)) => Err(Error::input(
            Parameter::RowOrder,
            format!("an order of rows for the shutter \"{name}\""),
            "row_order goes with shutter=\"custom\" alone",
            "Remove it, or give shutter=\"custom\".",
        )),
        (_, _, None) => Err(Error::input(
            Parameter::Shutter,
            format!("\"{name}\""),
            format!("the shutter is one of {}", Shutter::NAMES.join(", ")),
            "Zyla and other dual cameras of the paper's kind are dual-inside-out.",
        )),
    }
}
