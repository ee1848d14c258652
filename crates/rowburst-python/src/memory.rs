//! Whether this machine has memory for a reconstruction.

use crate::error::to_py_err;
use pyo3::prelude::*;
use rowburst::{Camera, Parameter};
use rowburst_run::check_memory;

/// Checks that a reconstruction with `camera` fits into the memory that is available, beside `kept` bytes that stay
/// between runs.
///
/// # Errors
/// Too little memory; the words are those of the command line.
pub fn check(camera: &Camera, kept: u64) -> PyResult<()> {
    check_memory(Parameter::Memory, camera, kept).map_err(to_py_err)
}
