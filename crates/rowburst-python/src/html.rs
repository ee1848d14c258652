//! What notebooks show of a value: the package's `_display` makes it.

use pyo3::PyTypeInfo;
use pyo3::prelude::*;

/// The answer of the function `name` of `rowburst._display` to `value`.
pub fn of<T: PyTypeInfo>(value: &Bound<'_, T>, name: &str) -> PyResult<String> {
    let display = value.py().import("rowburst._display")?;
    display.call_method1(name, (value,))?.extract()
}
