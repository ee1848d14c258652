//! The library's errors as Python exceptions.

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use rowburst::Error;

pyo3::create_exception!(
    rowburst,
    InputError,
    PyValueError,
    "An input breaks a rule: the message names the input, its value, the rule and the remedy."
);
pyo3::create_exception!(
    rowburst,
    WorkError,
    PyRuntimeError,
    "The work itself failed: a full disk, no memory, numbers that overflowed."
);

/// `error` as an exception, with the words of the command line turned into Python's.
pub fn to_py_err(error: Error) -> PyErr {
    let message = to_python_words(&error.to_string());
    match error {
        Error::Input { .. } => InputError::new_err(message),
        Error::Work { .. } => WorkError::new_err(message),
    }
}

/// Phrases of the command line and of the experiment file, and what they are in Python.
const PHRASES: [(&str, &str); 5] = [
    (" with -o", ""),
    ("Give --psf FILE", "Give psf=FILE"),
    ("as in --region 40,52", "as in (40, 52)"),
    ("as in --region 36,48,9,9", "as in (36, 48, 9, 9)"),
    ("(--bins)", "(bins)"),
];

/// Names of tables of the experiment file, where no such file is at fault.
const TABLES: [(&str, &str); 6] = [
    ("Add a line `", "Give `"),
    (" in [camera]", " of the Camera"),
    (" to [camera]", " to the Camera"),
    ("[camera] ", ""),
    ("[camera]", "camera"),
    ("[field]", "field"),
];

/// `text` without names that only the command line has: `--noise-sigma` is `noise_sigma` here. Commands in
/// backquotes stay.
fn to_python_words(text: &str) -> String {
    let replaced = |text: String, pairs: &[(&str, &str)]| {
        let replace = |text: String, (from, to): &(&str, &str)| text.replace(from, to);
        pairs.iter().fold(text, replace)
    };
    let mut text = replaced(text.to_string(), &PHRASES);
    if !text.contains(".toml") {
        text = replaced(text, &TABLES);
    }
    let parts = text.split('`').enumerate().map(|(i, part)| {
        let is_command = i % 2 == 1 && part.starts_with("rowburst ");
        if is_command {
            part.to_string()
        } else {
            to_python_names(part)
        }
    });
    parts.collect::<Vec<_>>().join("`")
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
