//! numpy arrays ⇄ values.

use crate::error::{subject, to_py_err};
use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyUntypedArrayMethods,
};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::pyclass::CompareOp;
use pyo3::types::{PyDict, PyString};
use rowburst::{Error, ErrorKind, Image, Shape, Video};
use rowburst_io::{Capture, IntegerFrame, SampleFormat, read_image, read_video};
use std::path::{Path, PathBuf};

/// Anything that numpy takes for an array, in C order and in numbers of `T`, with the kind of its own.
fn floats<'py, T: Element>(
    value: &Bound<'py, PyAny>,
    name: &str,
    dimensions: usize,
) -> PyResult<(Bound<'py, PyAny>, SampleFormat)> {
    let py = value.py();
    let numpy = py.import(intern!(py, "numpy"))?;
    let value = &computed(value)?;
    if let Some(mask) = mask_of(value)? {
        let count: usize = mask.call_method0(intern!(py, "sum"))?.extract()?;
        return Err(to_py_err(Error::input(
            subject(name),
            format!("a masked array with {count} masked values"),
            "only frame, dark, flat and bad_pixels may have masked pixels, which are then bad pixels",
            "Replace them: array.filled(0).",
        )));
    }
    let mut array = numpy.call_method1(intern!(py, "asarray"), (value,))?;
    let mut dtype = array.getattr(intern!(py, "dtype"))?;
    let mut kind: String = dtype.getattr(intern!(py, "kind"))?.extract()?;
    if kind == "O" && value.hasattr(intern!(py, "__dlpack__"))? {
        array = from_dlpack(value, name)?;
        dtype = array.getattr(intern!(py, "dtype"))?;
        kind = dtype.getattr(intern!(py, "kind"))?.extract()?;
    }
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
                subject(name),
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
        return Err(to_py_err(
            Error::input(
                subject(name),
                format!("an array of shape {shape:?}"),
                format!("it has {axes} and is not empty"),
                "Index or reshape it: a frame is array[i] of a stack.",
            )
            .with_kind(ErrorKind::Shape),
        ));
    }
    let options = PyDict::new(py);
    options.set_item("dtype", T::get_dtype(py))?;
    // Dask gives arrays that are not aligned.
    options.set_item("requirements", ("C", "A"))?;
    let errors = PyDict::new(py);
    // What `T` cannot hold becomes infinite, which is refused with its place.
    errors.set_item("over", "ignore")?;
    let state = numpy.call_method("errstate", (), Some(&errors))?;
    state.call_method0("__enter__")?;
    let converted = numpy.call_method("require", (&array,), Some(&options));
    state.call_method1("__exit__", (py.None(), py.None(), py.None()))?;
    Ok((converted?, format))
}

/// The array of an object that speaks DLPack and nothing else.
fn from_dlpack<'py>(value: &Bound<'py, PyAny>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    let numpy = value.py().import(intern!(value.py(), "numpy"))?;
    numpy
        .call_method1("from_dlpack", (value,))
        .map_err(|error| {
            to_py_err(Error::input(
                subject(name),
                format!("a DLPack object that numpy cannot take ({error})"),
                "arrays lie in the memory of the processor",
                "Copy it there first, such as by array.get() or tensor.cpu().",
            ))
        })
}

/// The path that `value` is, if it is text or an `os.PathLike`.
pub fn path_of(value: &Bound<'_, PyAny>) -> Option<PathBuf> {
    let py = value.py();
    let is_path = value.is_instance_of::<PyString>()
        || value.hasattr(intern!(py, "__fspath__")).unwrap_or(false);
    is_path.then(|| value.extract().ok()).flatten()
}

/// Whether `value` is computed by Dask.
fn is_dask(value: &Bound<'_, PyAny>) -> PyResult<bool> {
    value.hasattr(intern!(value.py(), "__dask_graph__"))
}

/// What a Dask array or an `xarray.DataArray` holds, with its mask, which `numpy.asarray` drops; anything else as it is.
fn computed<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = value.py();
    let is_xarray = value.hasattr(intern!(py, "to_masked_array"))?;
    let mut array = value.clone();
    if is_xarray {
        array = value.getattr(intern!(py, "data"))?;
    }
    if is_dask(&array)? {
        array = array.call_method0(intern!(py, "compute"))?;
    }
    if is_xarray {
        // xarray replaces masked values by NaN.
        let is_nan = array.rich_compare(&array, CompareOp::Ne)?;
        let masked = py.import(intern!(py, "numpy.ma"))?;
        array = masked.call_method1(intern!(py, "masked_where"), (is_nan, array))?;
    }
    Ok(array)
}

/// 1 at the pixels that are masked in any frame of a Dask array of masked arrays, `[frame, y, x]`; `None` where it is
/// another kind of array.
pub fn mask_of_dask_frames(frames: &Bound<'_, PyAny>) -> PyResult<Option<Image>> {
    let py = frames.py();
    if !is_dask(frames)? || !frames.hasattr(intern!(py, "_meta"))? {
        return Ok(None);
    }
    // An empty array of the kind that Dask computes.
    let sample = frames.getattr(intern!(py, "_meta"))?;
    let masked = py.import(intern!(py, "numpy.ma"))?;
    let is_masked = masked.call_method1(intern!(py, "isMaskedArray"), (sample,))?;
    if !is_masked.is_truthy()? {
        return Ok(None);
    }
    let dask_masked = py.import(intern!(py, "dask.array.ma"))?;
    let mask = dask_masked.call_method1(intern!(py, "getmaskarray"), (frames,))?;
    let mask = mask.call_method1(intern!(py, "any"), (0,))?;
    capture(&mask, "frames").map(|capture| Some(capture.image))
}

/// The mask of a masked array of numpy in which something is masked.
fn mask_of<'py>(value: &Bound<'py, PyAny>) -> PyResult<Option<Bound<'py, PyAny>>> {
    let py = value.py();
    let masked = py.import(intern!(py, "numpy.ma"))?;
    for question in [intern!(py, "isMaskedArray"), intern!(py, "is_masked")] {
        if !masked.call_method1(question, (value,))?.is_truthy()? {
            return Ok(None);
        }
    }
    masked
        .call_method1(intern!(py, "getmaskarray"), (value,))
        .map(Some)
}

/// What [`capture`] reads, and the mask of a masked array: 1 where a pixel is masked.
pub fn masked_capture(value: &Bound<'_, PyAny>, name: &str) -> PyResult<(Capture, Option<Image>)> {
    let py = value.py();
    let value = &computed(value)?;
    let Some(mask) = mask_of(value)? else {
        return Ok((capture(value, name)?, None));
    };
    let masked = py.import(intern!(py, "numpy.ma"))?;
    let filled = masked.call_method1(intern!(py, "filled"), (value, 0))?;
    let capture_with_zeros = capture(&filled, name)?;
    Ok((capture_with_zeros, Some(capture(&mask, name)?.image)))
}

/// Adds the pixels of `mask` to `bad_pixels`. Where one has several pixels for each of the other, as with
/// binning, the result is on the finer grid.
pub fn with_masked(bad_pixels: Option<Image>, mask: Option<Image>) -> Option<Image> {
    let (Some(bad), Some(mask)) = (&bad_pixels, &mask) else {
        return bad_pixels.or(mask);
    };
    let (rows, columns) = (
        bad.rows().max(mask.rows()),
        bad.columns().max(mask.columns()),
    );
    let block_side = |image: &Image| {
        let side = rows / image.rows();
        let fits = (image.rows() * side, image.columns() * side) == (rows, columns);
        fits.then_some(side)
    };
    let (Some(of_bad), Some(of_mask)) = (block_side(bad), block_side(mask)) else {
        // Of no common grid: the check of the sizes names it.
        return bad_pixels;
    };
    let is_set =
        |image: &Image, side: usize, y: usize, x: usize| image.at(y / side, x / side) != 0.0;
    Some(Image::from_fn(rows, columns, |y, x| {
        f32::from(u8::from(
            is_set(bad, of_bad, y, x) || is_set(mask, of_mask, y, x),
        ))
    }))
}

/// Whether `value` is an array rather than the name of a file.
pub fn is_array(value: &Bound<'_, PyAny>) -> bool {
    path_of(value).is_none()
}

/// The frame of a camera maker's file, which a package of Python reads; `None`: `path` is another kind of file.
pub fn frame_of_maker<'py>(py: Python<'py>, path: &Path) -> PyResult<Option<Bound<'py, PyAny>>> {
    let Some(makers) = makers_of(py, path)? else {
        return Ok(None);
    };
    makers.call_method1("frame_of_maker", (path,)).map(Some)
}

/// The module that reads files of camera makers, where `path` is one.
pub fn makers_of<'py>(py: Python<'py>, path: &Path) -> PyResult<Option<Bound<'py, PyModule>>> {
    let makers = py.import(intern!(py, "rowburst._makers"))?;
    let is_of_maker = makers.call_method1(intern!(py, "is_of_maker"), (path,))?;
    Ok(is_of_maker.is_truthy()?.then_some(makers))
}

/// A frame, a PSF or a mask; the name of a file is read.
pub fn capture(value: &Bound<'_, PyAny>, name: &str) -> PyResult<Capture> {
    if let Some(path) = path_of(value) {
        return match frame_of_maker(value.py(), &path)? {
            Some(frame) => capture(&frame, name),
            None => value.py().detach(|| read_image(&path)).map_err(to_py_err),
        };
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
    require_finite(capture(value, name)?.image, name)
}

/// Like [`finite_image`], with the mask of a masked array.
pub fn masked_image(value: &Bound<'_, PyAny>, name: &str) -> PyResult<(Image, Option<Image>)> {
    let (capture, mask) = masked_capture(value, name)?;
    Ok((require_finite(capture.image, name)?, mask))
}

fn require_finite(image: Image, name: &str) -> PyResult<Image> {
    match image.first_non_finite() {
        None => Ok(image),
        Some((y, x)) => Err(to_py_err(
            Error::input(
                subject(name),
                format!("{} at row {y}, column {x}", image.at(y, x)),
                "every pixel is a finite number",
                "Replace the pixel by the mean of its neighbours.",
            )
            .with_kind(ErrorKind::NotFinite),
        )),
    }
}

/// A video; the name of a file is read.
pub fn video(value: &Bound<'_, PyAny>, name: &str) -> PyResult<Video> {
    if let Some(path) = path_of(value) {
        let read = value.py().detach(|| read_video(&path));
        return read.map_err(to_py_err);
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
        return Err(to_py_err(
            Error::input(
                subject(name),
                format!("{} values", array.len()),
                format!("the operator takes {length}"),
                "Flatten it with .ravel(), in C order.",
            )
            .with_kind(ErrorKind::Shape),
        ));
    }
    Ok(array.try_readonly()?)
}

/// `data` as an array `[t, y, x]`, without a copy.
pub fn from_video(py: Python<'_>, video: Video) -> PyResult<Bound<'_, PyArray3<f32>>> {
    let shape = video.shape();
    PyArray1::from_vec(py, video.into_data()).reshape([shape.bins, shape.rows, shape.columns])
}

/// A capture as an array `[y, x]` of the type that its file holds.
pub fn from_capture<'py>(py: Python<'py>, capture: Capture) -> PyResult<Bound<'py, PyAny>> {
    let array = from_image(py, capture.image)?;
    match dtype_of(capture.format) {
        None => Ok(array.into_any()),
        Some(dtype) => array.call_method1("astype", (dtype,)),
    }
}

/// A frame of integers as an array `[y, x]` of the type that its file holds.
pub fn from_integers<'py>(py: Python<'py>, frame: IntegerFrame) -> PyResult<Bound<'py, PyAny>> {
    let dtype = dtype_of(frame.format).unwrap_or("int64");
    let array = PyArray1::from_vec(py, frame.data).reshape([frame.rows, frame.columns])?;
    array.call_method1("astype", (dtype,))
}

/// The name of the type of integers in numpy; `None` for floating-point numbers.
pub fn dtype_of(format: SampleFormat) -> Option<&'static str> {
    let SampleFormat::Counts { bits } = format else {
        return None;
    };
    Some(match bits {
        1 => "bool",
        7 => "int8",
        15 => "int16",
        31 => "int32",
        63 => "int64",
        _ if bits <= 8 => "uint8",
        _ if bits <= 16 => "uint16",
        _ if bits <= 32 => "uint32",
        _ => "uint64",
    })
}

/// Forbids writing to `array`.
pub fn make_read_only(array: &Bound<'_, PyAny>) -> PyResult<()> {
    let options = PyDict::new(array.py());
    options.set_item("write", false)?;
    array
        .call_method("setflags", (), Some(&options))
        .map(|_| ())
}

/// `image` as an array `[y, x]`, without a copy.
pub fn from_image(py: Python<'_>, image: Image) -> PyResult<Bound<'_, PyArray2<f32>>> {
    let (rows, columns) = (image.rows(), image.columns());
    PyArray1::from_vec(py, image.into_data()).reshape([rows, columns])
}
