//! `rowburst._rowburst._Frames`: a recording, read frame by frame.

use crate::array::{capture, dtype_of, from_capture};
use crate::error::to_py_err;
use crate::interrupt::interruptibly;
use crate::threads::detached;
use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use rowburst::error::Subject;
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_io::{Capture, Frames, open_recording};
use rowburst_run::check_bytes;
use rowburst_zarr::{is_zarr, open_zarr_recording};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A recording on disk: a folder, a stack or a Zarr array.
#[pyclass(name = "_Frames", module = "rowburst._rowburst", frozen)]
pub struct PyFrames {
    pub frames: Arc<dyn Frames>,
}

#[pymethods]
impl PyFrames {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let open = || {
            if is_zarr(&path) {
                open_zarr_recording(&path)
            } else {
                open_recording(&path)
            }
        };
        let frames = detached(py, open)?.map_err(to_py_err)?;
        Ok(Self {
            frames: frames.into(),
        })
    }

    fn __len__(&self) -> usize {
        self.frames.count()
    }

    /// A frame `[y, x]`, of the type that the file holds.
    fn __getitem__<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyAny>> {
        if index >= self.frames.count() {
            return Err(PyIndexError::new_err(index));
        }
        let capture = detached(py, || self.frames.read(index))?.map_err(to_py_err)?;
        from_capture(py, capture)
    }

    /// What a user calls a frame: the name of its file, or its page.
    fn name(&self, index: usize) -> PyResult<String> {
        if index >= self.frames.count() {
            return Err(PyIndexError::new_err(index));
        }
        Ok(self.frames.name(index))
    }

    /// All frames, `[frame, y, x]`, of the type that the file holds.
    fn read<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let frames = Arc::clone(&self.frames);
        let read = interruptibly::<(), _>(py, None, None, move |reporter| {
            all_frames(&*frames, reporter.cancel())
        })?;
        read.map_err(to_py_err)?(py)
    }
}

/// Gives numbers to numpy, without a copy.
type ToArray = Box<dyn FnOnce(Python<'_>) -> PyResult<Bound<'_, PyAny>> + Send>;

/// All frames, in numbers of the type that the file holds.
fn all_frames(frames: &dyn Frames, cancel: &Cancel) -> Result<ToArray> {
    let first = frames.read(0)?;
    // The values are those of the file, which the type holds.
    match dtype_of(first.format) {
        None => stack(frames, cancel, &first, |v| v),
        Some("bool") => stack(frames, cancel, &first, |v| v != 0.0),
        Some("int8") => stack(frames, cancel, &first, |v| v as i8),
        Some("int16") => stack(frames, cancel, &first, |v| v as i16),
        Some("uint8") => stack(frames, cancel, &first, |v| v as u8),
        Some("uint16") => stack(frames, cancel, &first, |v| v as u16),
        Some(_) => stack(frames, cancel, &first, |v| v as i64),
    }
}

fn stack<T: Element + 'static>(
    frames: &dyn Frames,
    cancel: &Cancel,
    first: &Capture,
    convert: fn(f32) -> T,
) -> Result<ToArray> {
    let (count, rows, columns) = (frames.count(), first.image.rows(), first.image.columns());
    let dtype = dtype_of(first.format);
    let size = [count, rows, columns, size_of::<T>()];
    let bytes = size
        .iter()
        .try_fold(1u64, |bytes, &n| bytes.checked_mul(n as u64));
    let what = format!("{count} frames of {rows}×{columns}");
    let remedy = "Read some of them, or use rowburst.batch, which holds one frame at a time.";
    check_bytes(frames.path(), &what, bytes, remedy)?;
    let mut data: Vec<T> = Vec::with_capacity(count * rows * columns);
    data.extend(first.image.data().iter().map(|&v| convert(v)));
    for index in 1..count {
        cancel.check()?;
        let frame = frames.read(index)?;
        let size = (frame.image.rows(), frame.image.columns());
        if size != (rows, columns) || dtype_of(frame.format) != dtype {
            return Err(Error::input(
                Subject::item(Parameter::Frames, frames.name(index)),
                format!("{}×{} pixels, or numbers of another kind", size.0, size.1),
                format!("it has the {rows}×{columns} pixels and the numbers of the first frame"),
                "Take it out of the recording.",
            )
            .with_kind(ErrorKind::Shape));
        }
        data.extend(frame.image.data().iter().map(|&v| convert(v)));
    }
    Ok(Box::new(move |py| {
        let array = PyArray1::from_vec(py, data).reshape([count, rows, columns])?;
        Ok(array.into_any())
    }))
}

/// The frames of an array of Python, `[frame, y, x]`: numpy, Dask, Zarr, HDF5, or a list.
pub struct ArrayFrames {
    pub array: Py<PyAny>,
    pub count: usize,
    /// Whether frames of floating-point numbers are refused, since their bias is taken off already.
    pub has_bias: bool,
}

impl Frames for ArrayFrames {
    fn path(&self) -> &Path {
        "frames".as_ref()
    }

    fn count(&self) -> usize {
        self.count
    }

    fn name(&self, index: usize) -> String {
        format!("frame {index}")
    }

    fn read(&self, index: usize) -> Result<Capture> {
        let failed = |error: PyErr| {
            let remedy = "Read the frame by itself: frames[i].";
            Error::work(
                Subject::item(Parameter::Frames, format!("frame {index}")),
                error,
                remedy,
            )
        };
        let read = Python::attach(|py| {
            let frame = self.array.bind(py).get_item(index)?;
            capture(&frame, "frame")
        });
        let capture = read.map_err(failed)?;
        if self.has_bias && dtype_of(capture.format).is_none() {
            return Err(Error::input(
                Subject::item(Parameter::Frames, format!("frame {index}")),
                "floating-point numbers",
                "bias_counts of the camera is subtracted from raw frames, which are integers",
                "Give integers, or corrected=True where it is subtracted already.",
            ));
        }
        Ok(capture)
    }
}
