//! `rowburst.capture`: sources of frames, settings of cameras, and recordings.

use crate::error::to_py_err;
use crate::threads::detached;
use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray2};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use rowburst::error::Subject;
use rowburst::{Cancel, Error, ErrorKind};
use rowburst_capture::{
    Delivery, Driver, Ended, Frame, Property, Recorder, Settings, Source, experiment_text,
    open_source,
};
use serde_json::json;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Kinds of cameras that the package was built with.
const DRIVERS: &[Driver] = &[
    #[cfg(feature = "genicam")]
    rowburst_genicam::DRIVER,
];

/// A source of frames.
#[pyclass(name = "_Source", module = "rowburst._rowburst", frozen)]
pub struct PySource {
    source: Mutex<Box<dyn Source>>,
}

/// Number, time in µs, counts, and what is wrong with a frame; without counts, the first and the last number of
/// frames that are lost, and why.
type Delivered<'py> = (
    u64,
    Option<u64>,
    Option<Bound<'py, PyArray2<u16>>>,
    Option<String>,
    u64,
);

#[pymethods]
impl PySource {
    #[new]
    fn new(py: Python<'_>, name: String) -> PyResult<Self> {
        let source = detached(py, || open_source(&name, DRIVERS))?.map_err(to_py_err)?;
        Ok(Self {
            source: Mutex::new(source),
        })
    }

    fn settings(&self, py: Python<'_>) -> PyResult<String> {
        let read = || {
            let mut source = self.source.lock().unwrap_or_else(PoisonError::into_inner);
            source.settings()
        };
        let settings = detached(py, read)?.map_err(to_py_err)?;
        Ok(serde_json::to_string(&settings).expect("plain text"))
    }

    /// Leaves out the frames that wait; how many.
    fn skip_to_latest(&self, py: Python<'_>) -> PyResult<u64> {
        let skip = || {
            let mut source = self.source.lock().unwrap_or_else(PoisonError::into_inner);
            source.skip_to_latest()
        };
        detached(py, skip)?.map_err(to_py_err)
    }

    /// The next delivery; `None` at the end. Ctrl-C is heard while it waits.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<Option<Delivered<'py>>> {
        let delivery = self.wait(py)?;
        Ok(match delivery {
            Delivery::End => None,
            Delivery::Frame(frame) => Some(delivered(py, frame, None)?),
            Delivery::Incomplete {
                frame: Some(frame),
                reason,
                ..
            } => Some(delivered(py, frame, Some(reason))?),
            Delivery::Incomplete { number, reason, .. } => {
                Some((number, None, None, Some(reason), number))
            }
            Delivery::Dropped { first, last } => {
                Some((first, None, None, Some("dropped".into()), last))
            }
        })
    }
}

/// Time after which Python's signals are looked at.
const PATIENCE: Duration = Duration::from_millis(100);

impl PySource {
    fn wait(&self, py: Python<'_>) -> PyResult<Delivery> {
        let cancel = Cancel::default();
        let (send, receive) = std::sync::mpsc::channel();
        // Python's lock is released by a closure that threads may share.
        let receive = Mutex::new(receive);
        let wait = || {
            let receive = receive.lock().unwrap_or_else(PoisonError::into_inner);
            receive.recv_timeout(PATIENCE)
        };
        std::thread::scope(|scope| {
            let asked = cancel.clone();
            scope.spawn(move || {
                let mut source = self.source.lock().unwrap_or_else(PoisonError::into_inner);
                // Who no longer listens has been interrupted.
                let _ = send.send(source.next(&asked));
            });
            loop {
                match py.detach(wait) {
                    Ok(delivery) => return delivery.map_err(to_py_err),
                    Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {
                        if let Err(error) = py.check_signals() {
                            cancel.cancel();
                            return Err(error);
                        }
                    }
                    Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => {
                        return Err(PyRuntimeError::new_err("the source has ended"));
                    }
                }
            }
        })
    }
}

fn delivered(py: Python<'_>, frame: Frame, incomplete: Option<String>) -> PyResult<Delivered<'_>> {
    let Frame {
        rows,
        columns,
        counts,
        number,
        time_us,
    } = frame;
    let array = PyArray1::from_vec(py, counts).reshape([rows, columns])?;
    Ok((number, time_us, Some(array), incomplete, number))
}

/// Name, value and origin of a property.
type PropertyTuple = (String, Option<String>, String);

fn settings_from(
    source: String,
    properties: Vec<PropertyTuple>,
    camera: Option<String>,
) -> Settings {
    let properties = properties.into_iter();
    Settings {
        source,
        camera,
        properties: properties
            .map(|(name, value, origin)| Property {
                name,
                value,
                origin,
            })
            .collect(),
    }
}

/// What properties mean, as JSON: values with their provenance, findings, and the text of an experiment file.
#[pyfunction]
#[pyo3(signature = (source, properties, camera=None))]
pub fn _read_properties(
    source: String,
    properties: Vec<PropertyTuple>,
    camera: Option<String>,
) -> String {
    let settings = settings_from(source, properties, camera);
    let reading = settings.reading();
    let metadata = &reading.metadata;
    let findings = reading.findings.iter().map(|finding| {
        json!({
            "name": finding.name, "is_fatal": finding.is_fatal,
            "text": finding.text, "remedy": finding.remedy,
        })
    });
    let provenance = reading.provenance.iter().map(|known| {
        let words = json!({ "origin": known.origin.name(), "from": known.from });
        (known.key.to_string(), words)
    });
    json!({
        "rows": metadata.size.map(|size| size.0),
        "columns": metadata.size.map(|size| size.1),
        "shutter": metadata.shutter.as_ref().map(rowburst::Shutter::name),
        "row_time_us": metadata.row_time_us,
        "exposure_us": metadata.exposure_us,
        "frame_period_us": metadata.frame_period_us,
        "bit_depth": metadata.bit_depth,
        "binning": metadata.binning,
        "notes": metadata.notes,
        "findings": findings.collect::<Vec<_>>(),
        "provenance": provenance.collect::<serde_json::Map<_, _>>(),
        "experiment": experiment_text(&settings),
    })
    .to_string()
}

/// How a driver knows the value of a property: `read` or `calculated`.
#[pyfunction]
pub fn _property_origin(name: &str) -> &'static str {
    rowburst_io::origin_of_property(name).name()
}

/// A recording that is being written.
#[pyclass(name = "_Recorder", module = "rowburst._rowburst", frozen)]
pub struct PyRecorder {
    recorder: Mutex<Option<Recorder>>,
}

#[pymethods]
impl PyRecorder {
    #[new]
    #[pyo3(signature = (path, purpose, source, properties, requested=None, camera=None))]
    fn new(
        path: PathBuf,
        purpose: &str,
        source: String,
        properties: Vec<PropertyTuple>,
        requested: Option<usize>,
        camera: Option<String>,
    ) -> PyResult<Self> {
        let settings = settings_from(source, properties, camera);
        let warnings = settings.check().map_err(to_py_err)?;
        let mut recorder =
            Recorder::create(&path, purpose, settings, requested).map_err(to_py_err)?;
        warnings
            .into_iter()
            .for_each(|warning| recorder.warn(warning));
        Ok(Self {
            recorder: Mutex::new(Some(recorder)),
        })
    }

    /// Writes a frame, or notes that it is lost.
    fn take(
        &self,
        number: u64,
        time_us: Option<u64>,
        counts: Option<PyReadonlyArray2<u16>>,
        incomplete: Option<String>,
        last: u64,
    ) -> PyResult<()> {
        let frame = counts.map(|counts| {
            let array = counts.as_array();
            Frame {
                rows: array.nrows(),
                columns: array.ncols(),
                counts: array.iter().copied().collect(),
                number,
                time_us,
            }
        });
        let delivery = match (frame, incomplete) {
            (Some(frame), None) => Delivery::Frame(frame),
            (None, Some(reason)) if reason == "dropped" => Delivery::Dropped {
                first: number,
                last,
            },
            (frame, reason) => Delivery::Incomplete {
                frame,
                number,
                reason: reason.unwrap_or_default(),
            },
        };
        let mut recorder = self.recorder.lock().unwrap_or_else(PoisonError::into_inner);
        match recorder.as_mut() {
            Some(recorder) => recorder.take(delivery).map_err(to_py_err),
            None => Ok(()),
        }
    }

    /// Puts the recording in place; `ended` is `complete`, `source` or the reason of a failure. The record as JSON.
    fn finish(&self, ended: &str) -> PyResult<String> {
        let mut recorder = self.recorder.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(recorder) = recorder.take() else {
            return Err(PyRuntimeError::new_err("the recording is finished"));
        };
        let ended = match ended {
            "complete" => Ended::Complete,
            "source" => Ended::SourceEnd,
            "interrupted" => Ended::Interrupted,
            reason => Ended::Failed(
                Error::work(Subject::named("the source"), reason, "Check the camera.")
                    .with_kind(ErrorKind::Failed),
            ),
        };
        let record = recorder.finish(&ended).map_err(to_py_err)?;
        Ok(serde_json::to_string(&record).expect("plain numbers and text"))
    }
}
