//! The library's errors as Python exceptions.

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use rowburst::Error;

pyo3::create_exception!(
    rowburst,
    InputError,
    PyValueError,
    "What was given breaks a rule: the message names it, the value, the rule and the remedy."
);
pyo3::create_exception!(
    rowburst,
    WorkError,
    PyRuntimeError,
    "The work itself failed: a full disk, no memory, numbers that overflowed."
);

/// `error` as an exception, with the words of the command line turned into Python's.
pub fn to_py_err(error: Error) -> PyErr {
    let message = to_python_names(&error.to_string());
    match error {
        Error::Input { .. } => InputError::new_err(message),
        Error::Work { .. } => WorkError::new_err(message),
    }
}

/// `--noise-sigma` is `noise_sigma` here.
fn to_python_names(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("--") {
        let (before, option) = rest.split_at(at);
        out.push_str(before);
        let name = &option[2..];
        let end = name
            .find(|c: char| !(c.is_ascii_lowercase() || c == '-'))
            .unwrap_or(name.len());
        out.push_str(&name[..end].replace('-', "_"));
        rest = &name[end..];
    }
    out + rest
}
