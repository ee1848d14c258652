//! `rowburst._rowburst._Frames`: a recording, read frame by frame.

use crate::array::{capture, dtype_of, from_capture, from_integers, masked_capture};
use crate::error::{InputError, to_py_err};
use crate::interrupt::interruptibly;
use crate::threads::detached;
use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use rowburst::error::Subject;
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_io::{Capture, Frames, SampleFormat, open_recording};
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
        if capture.format.exceeds_f32() {
            let frame = detached(py, || self.frames.read_integers(index))?;
            return from_integers(py, frame.map_err(to_py_err)?);
        }
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

/// The numbers of a frame.
struct Numbers<V> {
    rows: usize,
    columns: usize,
    data: Vec<V>,
    format: SampleFormat,
}

/// Frame `index` in f32.
fn in_f32(frames: &dyn Frames, index: usize) -> Result<Numbers<f32>> {
    let Capture { image, format } = frames.read(index)?;
    Ok(Numbers {
        rows: image.rows(),
        columns: image.columns(),
        data: image.into_data(),
        format,
    })
}

/// Frame `index` in integers, which f32 would round.
fn in_integers(frames: &dyn Frames, index: usize) -> Result<Numbers<i64>> {
    let frame = frames.read_integers(index)?;
    Ok(Numbers {
        rows: frame.rows,
        columns: frame.columns,
        data: frame.data,
        format: frame.format,
    })
}

/// All frames, in numbers of the type that the file holds.
fn all_frames(frames: &dyn Frames, cancel: &Cancel) -> Result<ToArray> {
    let first = in_f32(frames, 0)?;
    // The values are those of the file, which the type holds.
    match dtype_of(first.format) {
        None => stack(frames, cancel, first, in_f32, |v| v),
        Some("bool") => stack(frames, cancel, first, in_f32, |v| v != 0.0),
        Some("int8") => stack(frames, cancel, first, in_f32, |v| v as i8),
        Some("int16") => stack(frames, cancel, first, in_f32, |v| v as i16),
        Some("uint8") => stack(frames, cancel, first, in_f32, |v| v as u8),
        Some("uint16") => stack(frames, cancel, first, in_f32, |v| v as u16),
        Some(wide) => {
            let first = in_integers(frames, 0)?;
            match wide {
                "int32" => stack(frames, cancel, first, in_integers, |v| v as i32),
                "uint32" => stack(frames, cancel, first, in_integers, |v| v as u32),
                "uint64" => stack(frames, cancel, first, in_integers, |v| v as u64),
                _ => stack(frames, cancel, first, in_integers, |v| v),
            }
        }
    }
}

/// `first` and all frames after it that `read` gives, converted.
fn stack<V: Copy, T: Element + 'static>(
    frames: &dyn Frames,
    cancel: &Cancel,
    first: Numbers<V>,
    read: fn(&dyn Frames, usize) -> Result<Numbers<V>>,
    convert: fn(V) -> T,
) -> Result<ToArray> {
    let (count, rows, columns) = (frames.count(), first.rows, first.columns);
    let dtype = dtype_of(first.format);
    let size = [count, rows, columns, size_of::<T>()];
    let bytes = size
        .iter()
        .try_fold(1u64, |bytes, &n| bytes.checked_mul(n as u64));
    let what = format!("{count} frames of {rows}×{columns}");
    let remedy = "Read some of them, or use rowburst.batch, which holds one frame at a time.";
    check_bytes(frames.path(), &what, bytes, remedy)?;
    let mut data: Vec<T> = Vec::with_capacity(count * rows * columns);
    data.extend(first.data.iter().map(|&v| convert(v)));
    for index in 1..count {
        cancel.check()?;
        let frame = read(frames, index)?;
        let size = (frame.rows, frame.columns);
        if size != (rows, columns) || dtype_of(frame.format) != dtype {
            return Err(Error::input(
                Subject::item(Parameter::Frames, frames.name(index)),
                format!("{}×{} pixels, or numbers of another kind", size.0, size.1),
                format!("it has the {rows}×{columns} pixels and the numbers of the first frame"),
                "Take it out of the recording.",
            )
            .with_kind(ErrorKind::Shape));
        }
        data.extend(frame.data.iter().map(|&v| convert(v)));
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
    /// Whether the masked pixels of its frames are bad pixels of the recording already.
    pub has_known_mask: bool,
}

impl ArrayFrames {
    fn subject(&self, index: usize) -> Subject {
        Subject::item(Parameter::Frames, self.name(index))
    }

    /// Frame `index`, as Python gives it.
    fn capture(&self, py: Python<'_>, index: usize) -> PyResult<Capture> {
        let frame = self.array.bind(py).get_item(index)?;
        if self.has_known_mask {
            masked_capture(&frame, "frame").map(|(capture, _)| capture)
        } else {
            capture(&frame, "frame")
        }
    }

    /// An exception as the error of frame `index`; one of this library keeps its words.
    fn failed(&self, py: Python<'_>, index: usize, exception: &PyErr) -> Error {
        let value = exception.value(py);
        let words = |name: &str| -> Option<String> { value.getattr(name).ok()?.extract().ok() };
        if exception.is_instance_of::<InputError>(py)
            && let (Some(value), Some(rule), Some(remedy)) =
                (words("value"), words("rule"), words("remedy"))
        {
            return Error::input(self.subject(index), value, rule, remedy);
        }
        let text = exception.to_string();
        let remedy = "Read the frame by itself: frames[i].";
        Error::work(self.subject(index), text.trim_end_matches('.'), remedy)
    }
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
        let capture = Python::attach(|py| {
            self.capture(py, index)
                .map_err(|exception| self.failed(py, index, &exception))
        })?;
        if self.has_bias && dtype_of(capture.format).is_none() {
            return Err(Error::input(
                self.subject(index),
                "floating-point numbers",
                "bias_counts of the camera is subtracted from raw frames, which are integers",
                "Give integers, or corrected=True where it is subtracted already.",
            ));
        }
        Ok(capture)
    }
}
