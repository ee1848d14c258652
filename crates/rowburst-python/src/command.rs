//! The command `rowburst` of the package.

use pyo3::prelude::*;
use std::ffi::OsString;

/// Runs the command line, with the name of the program first; the exit status. For a process of its own: Ctrl-C, the
/// threads and `--help` are those of the command from then on.
#[pyfunction]
pub fn _command(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| rowburst_cli::run(arguments))
}
