//! What pickled objects are made of.

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// What `__reduce__` gives: a function, and the state that it is called with.
pub type State<'py> = (Bound<'py, PyAny>, (Bound<'py, PyDict>,));
/// The same with two arguments.
pub type State2<'py, A, B> = (Bound<'py, PyAny>, (A, B));
/// The same with three arguments.
pub type State3<'py, A, B, C> = (Bound<'py, PyAny>, (A, B, C));

/// The value `name` of a state.
pub fn entry<'py>(state: &Bound<'py, PyDict>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    state.get_item(name)?.ok_or_else(|| {
        PyValueError::new_err(format!(
            "state: found no {name}; it was pickled by another version of rowburst. Pickle it again with this one."
        ))
    })
}

/// The value `name` of a state, unless it is `None`.
pub fn optional_entry<'py>(
    state: &Bound<'py, PyDict>,
    name: &str,
) -> PyResult<Option<Bound<'py, PyAny>>> {
    Ok(Some(entry(state, name)?).filter(|value| !value.is_none()))
}
