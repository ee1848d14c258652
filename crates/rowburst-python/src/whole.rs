//! Numbers that users give.

use crate::error::{subject, to_py_err};
use pyo3::Borrowed;
use pyo3::prelude::*;
use pyo3::types::PyBool;
use rowburst::Error;

/// A whole number from 0. It is checked by [`Whole::named`], which knows the name of the argument.
#[derive(Clone)]
pub struct Whole(Result<usize, String>);

impl Whole {
    /// The default of an argument.
    pub const fn of(value: usize) -> Self {
        Self(Ok(value))
    }

    /// The number.
    ///
    /// # Errors
    /// A number below 0 or above the range of sizes, or a truth value; the error names the argument.
    pub fn named(self, name: &str) -> PyResult<usize> {
        self.0.map_err(|found| {
            to_py_err(Error::input(
                subject(name),
                found,
                "the value is a whole number from 0",
                "Give a non-negative int.",
            ))
        })
    }
}

impl<'py> FromPyObject<'_, 'py> for Whole {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let value = &*value;
        if value.is_instance_of::<PyBool>() {
            return Ok(Self(Err(value.str()?.to_string())));
        }
        // A TypeError for what is no whole number, with the name of the argument by PyO3.
        let index = value
            .py()
            .import("operator")?
            .call_method1("index", (value,))?;
        let number = index.extract::<usize>();
        Ok(Self(number.map_err(|_| index.to_string())))
    }
}

/// A real number; a truth value is none, though Python takes it for 0 or 1. It is checked by [`Number::named`], which
/// knows the name of the argument.
#[derive(Clone)]
pub struct Number(Result<f64, String>);

impl Number {
    /// The default of an argument.
    pub const fn of(value: f64) -> Self {
        Self(Ok(value))
    }

    /// The number.
    ///
    /// # Errors
    /// A truth value; the error names the argument.
    pub fn named(self, name: &str) -> PyResult<f64> {
        self.0.map_err(|found| {
            let rule = "the value is a number, and not a truth value";
            to_py_err(Error::input(
                subject(name),
                found,
                rule,
                "Give a float or an int.",
            ))
        })
    }
}

impl<'py> FromPyObject<'_, 'py> for Number {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let value = &*value;
        if is_bool(value)? {
            return Ok(Self(Err(value.str()?.to_string())));
        }
        // A TypeError for what is no number, with the name of the argument by PyO3.
        value.extract::<f64>().map(|number| Self(Ok(number)))
    }
}

/// The real number of an optional argument.
///
/// # Errors
/// Those of [`Number::named`].
pub fn optional_real(value: Option<Number>, name: &str) -> PyResult<Option<f64>> {
    value.map(|value| value.named(name)).transpose()
}

/// The number of an optional argument.
///
/// # Errors
/// Those of [`Whole::named`].
pub fn optional(value: Option<Whole>, name: &str) -> PyResult<Option<usize>> {
    value.map(|value| value.named(name)).transpose()
}

/// Whether `value` is a truth value of Python or numpy.
pub fn is_bool(value: &Bound<'_, PyAny>) -> PyResult<bool> {
    if value.is_instance_of::<PyBool>() {
        return Ok(true);
    }
    let numpy_bool = value.py().import("numpy")?.getattr("bool_")?;
    value.is_instance(&numpy_bool)
}
