//! Numbers that users give. They are checked here alone; what is no number is an `InputError` with the name of the
//! argument. A truth value is no number, though Python takes it for 0 or 1.

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
    /// Anything but a whole number from 0 to the largest size; the error names the argument.
    pub fn named(self, name: &str) -> PyResult<usize> {
        let rule = "the value is a whole number from 0";
        self.0
            .map_err(|found| refused(name, found, rule, "Give a non-negative int."))
    }
}

impl<'py> FromPyObject<'_, 'py> for Whole {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let value = &*value;
        if is_bool(value)? {
            return Ok(Self(Err(shown(value)?)));
        }
        let index = value.py().import("operator")?.getattr("index")?;
        let number = index.call1((value,)).and_then(|i| i.extract::<usize>());
        Ok(Self(match number {
            Ok(number) => Ok(number),
            Err(_) => Err(shown(value)?),
        }))
    }
}

/// A real number. It is checked by [`Number::named`], which knows the name of the argument.
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
    /// Anything but a number; the error names the argument.
    pub fn named(self, name: &str) -> PyResult<f64> {
        let rule = "the value is a number, and not a truth value";
        self.0
            .map_err(|found| refused(name, found, rule, "Give a float or an int."))
    }
}

impl<'py> FromPyObject<'_, 'py> for Number {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let value = &*value;
        if is_bool(value)? {
            return Ok(Self(Err(shown(value)?)));
        }
        Ok(Self(match value.extract::<f64>() {
            Ok(number) => Ok(number),
            Err(_) => Err(shown(value)?),
        }))
    }
}

/// A sequence of real numbers. It is checked by [`Numbers::named`], which knows the name of the argument.
pub struct Numbers(Result<Vec<Number>, String>);

impl Numbers {
    /// No number: the default of an argument.
    pub const fn none() -> Self {
        Self(Ok(Vec::new()))
    }

    /// The numbers.
    ///
    /// # Errors
    /// Anything but a sequence of numbers; the error names the argument, and the element that is no number.
    pub fn named(self, name: &str) -> PyResult<Vec<f64>> {
        let rule = "the value is a sequence of numbers";
        let numbers = self
            .0
            .map_err(|found| refused(name, found, rule, "Give a list."))?;
        let numbers = numbers.into_iter().enumerate();
        numbers
            .map(|(i, number)| number.named(&format!("{name}[{i}]")))
            .collect()
    }
}

impl<'py> FromPyObject<'_, 'py> for Numbers {
    type Error = PyErr;

    fn extract(value: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let value = &*value;
        Ok(Self(match value.extract::<Vec<Number>>() {
            Ok(numbers) => Ok(numbers),
            Err(_) => Err(shown(value)?),
        }))
    }
}

/// Pairs of real numbers.
///
/// # Errors
/// Those of [`Number::named`].
pub fn real_pairs(pairs: Vec<(Number, Number)>, name: &str) -> PyResult<Vec<(f64, f64)>> {
    let named = |(i, (first, second)): (usize, (Number, Number))| {
        let name = format!("{name}[{i}]");
        Ok::<_, PyErr>((first.named(&name)?, second.named(&name)?))
    };
    pairs.into_iter().enumerate().map(named).collect()
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

fn refused(name: &str, found: String, rule: &'static str, remedy: &'static str) -> PyErr {
    to_py_err(Error::input(subject(name), found, rule, remedy))
}

/// What a message says of `value`.
fn shown(value: &Bound<'_, PyAny>) -> PyResult<String> {
    let checks = value.py().import("rowburst._checks")?;
    checks.call_method1("shown", (value,))?.extract()
}
