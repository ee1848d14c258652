//! numpy arrays ⇄ values.

use crate::error::to_py_err;
use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyUntypedArrayMethods,
};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};
use rowburst::{Error, Image, Shape, Video};
use rowburst_io::{Capture, SampleFormat, read_image, read_video};
use std::path::PathBuf;

/// Anything that numpy takes for an array, in C order and in numbers of `T`, with the kind of its own.
fn floats<'py, T: Element>(
    value: &Bound<'py, PyAny>,
    name: &str,
    dimensions: usize,
) -> PyResult<(Bound<'py, PyAny>, SampleFormat)> {
    let py = value.py();
    let numpy = py.import(intern!(py, "numpy"))?;
    let array = numpy.call_method1(intern!(py, "asarray"), (value,))?;
    let dtype = array.getattr(intern!(py, "dtype"))?;
    let kind: String = dtype.getattr(intern!(py, "kind"))?.extract()?;
    let bytes: u32 = dtype.getattr(intern!(py, "itemsize"))?.extract()?;
    let format = match kind.as_str() {
        "b" => SampleFormat::Counts { bits: 1 },
        "u" => SampleFormat::Counts { bits: 8 * bytes },
        "i" => SampleFormat::Counts {
            bits: 8 * bytes - 1,
        },
        "f" => SampleFormat::Float,
        _ => {
            return Err(to_py_err(Error::input(
                name,
                format!("an array of {dtype}"),
                "arrays hold integers or floating-point numbers",
                "Convert it with numpy.asarray(array, dtype=numpy.float32).",
            )));
        }
    };
    let shape: Vec<usize> = array.getattr(intern!(py, "shape"))?.extract()?;
    if shape.len() != dimensions || shape.contains(&0) {
        let axes = match dimensions {
            1 => "one axis",
            2 => "two axes, [y, x],",
            _ => "three axes, [t, y, x],",
        };
        return Err(to_py_err(Error::input(
            name,
            format!("an array of shape {shape:?}"),
            format!("it has {axes} and is not empty"),
            "Index or reshape it: a frame is array[i] of a stack.",
        )));
    }
    let options = PyDict::new(py);
    options.set_item("dtype", T::get_dtype(py))?;
    options.set_item("order", "C")?;
    let errors = PyDict::new(py);
    // What `T` cannot hold becomes infinite, which is refused with its place.
    errors.set_item("over", "ignore")?;
    let state = numpy.call_method("errstate", (), Some(&errors))?;
    state.call_method0("__enter__")?;
    let converted = numpy.call_method("asarray", (&array,), Some(&options));
    state.call_method1("__exit__", (py.None(), py.None(), py.None()))?;
    Ok((converted?, format))
}

/// The path that `value` is, if it is text or an `os.PathLike`.
fn path_of(value: &Bound<'_, PyAny>) -> Option<PathBuf> {
    let py = value.py();
    let is_path = value.is_instance_of::<PyString>()
        || value.hasattr(intern!(py, "__fspath__")).unwrap_or(false);
    is_path.then(|| value.extract().ok()).flatten()
}

/// A frame, a PSF or a mask; the name of a file is read.
pub fn capture(value: &Bound<'_, PyAny>, name: &str) -> PyResult<Capture> {
    if let Some(path) = path_of(value) {
        return read_image(&path).map_err(to_py_err);
    }
    let (array, format) = floats::<f32>(value, name, 2)?;
    let array = array.cast::<PyArray2<f32>>()?;
    let (rows, columns) = (array.shape()[0], array.shape()[1]);
    let data = array.readonly().as_slice()?.to_vec();
    let image = Image::new(rows, columns, data).map_err(|e| to_py_err(e.within(name)))?;
    Ok(Capture { image, format })
}

/// An image whose pixels are finite.
pub fn finite_image(value: &Bound<'_, PyAny>, name: &str) -> PyResult<Image> {
    let image = capture(value, name)?.image;
    match image.first_non_finite() {
        None => Ok(image),
        Some((y, x)) => Err(to_py_err(Error::input(
            name,
            format!("{} at row {y}, column {x}", image.at(y, x)),
            "every pixel is a finite number",
            "Replace the pixel by the mean of its neighbours.",
        ))),
    }
}

/// A video; the name of a file is read.
pub fn video(value: &Bound<'_, PyAny>, name: &str) -> PyResult<Video> {
    if let Some(path) = path_of(value) {
        return read_video(&path).map_err(to_py_err);
    }
    let (array, _) = floats::<f32>(value, name, 3)?;
    let array = array.cast::<PyArray3<f32>>()?;
    let shape = array.shape();
    let shape = Shape::new(shape[0], shape[1], shape[2]);
    let data = array.readonly().as_slice()?.to_vec();
    Video::new(shape, data).map_err(|e| to_py_err(e.within(name)))
}

/// A vector of `length` numbers of `T`, borrowed where it is one already.
pub fn vector<'py, T: Element>(
    value: &Bound<'py, PyAny>,
    name: &str,
    length: usize,
) -> PyResult<PyReadonlyArray1<'py, T>> {
    let (array, _) = floats::<T>(value, name, 1)?;
    let array = array.cast_into::<PyArray1<T>>()?;
    if array.len() != length {
        return Err(to_py_err(Error::input(
            name,
            format!("{} values", array.len()),
            format!("the operator takes {length}"),
            "Flatten it with .ravel(), in C order.",
        )));
    }
    Ok(array.try_readonly()?)
}

/// `data` as an array `[t, y, x]`, without a copy.
pub fn from_video(py: Python<'_>, video: Video) -> PyResult<Bound<'_, PyArray3<f32>>> {
    let shape = video.shape();
    PyArray1::from_vec(py, video.into_data()).reshape([shape.bins, shape.rows, shape.columns])
}

/// `image` as an array `[y, x]`, without a copy.
pub fn from_image(py: Python<'_>, image: Image) -> PyResult<Bound<'_, PyArray2<f32>>> {
    let (rows, columns) = (image.rows(), image.columns());
    PyArray1::from_vec(py, image.into_data()).reshape([rows, columns])
}
