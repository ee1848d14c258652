//! The extension module behind the Python package `rowburst`: values in and out of numpy, the
//! library's errors as exceptions, the interpreter's lock released while it works.
//!
//! What users see is documented in `python/rowburst`.

mod array;
mod batch;
mod camera;
mod error;
mod experiment;
mod memory;
mod operator;
mod psf;
mod result;
mod sequence;
mod simulation;
mod state;
mod task;
mod threads;
mod whole;

use pyo3::prelude::*;

/// Not the process's: Dask's workers have glibc return and fault in every large buffer anew
/// (`MALLOC_TRIM_THRESHOLD_`), which makes a reconstruction half as slow again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

#[pymodule]
mod _rowburst {
    use super::*;

    #[pymodule_export]
    use crate::batch::PyBatch;
    #[pymodule_export]
    use crate::camera::PyCamera;
    #[pymodule_export]
    use crate::error::{InputError, WorkError};
    #[pymodule_export]
    use crate::experiment::PyExperiment;
    #[pymodule_export]
    use crate::operator::{PyDataTerm, PyOperator};
    #[pymodule_export]
    use crate::psf::{PyPsf, speckle_psf};
    #[pymodule_export]
    use crate::result::{PyProgress, PyReconstruction};
    #[pymodule_export]
    use crate::sequence::{PyLook, PySequence};
    #[pymodule_export]
    use crate::simulation::{PySimulation, simulate};
    #[pymodule_export]
    use crate::task::reconstruct;
    #[pymodule_export]
    use crate::threads::{set_threads, threads};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }

    /// The frames of a file, ``[frame, y, x]``: every format that the command line reads.
    ///
    /// Integers where the file holds integers, else float32, so that each frame is what it was in the file.
    #[pyfunction]
    fn read_frames(py: Python<'_>, path: std::path::PathBuf) -> PyResult<Bound<'_, PyAny>> {
        let frames = crate::threads::detached(py, || rowburst_io::read_frames(&path))?;
        let (video, format) = frames.map_err(crate::error::to_py_err)?;
        let array = crate::array::from_video(py, video)?;
        let dtype = match format {
            rowburst_io::SampleFormat::Float => return Ok(array.into_any()),
            rowburst_io::SampleFormat::Counts { bits } => match bits {
                1 => "bool",
                7 => "int8",
                15 => "int16",
                _ if bits <= 8 => "uint8",
                _ if bits <= 16 => "uint16",
                _ => "int64",
            },
        };
        array.call_method1("astype", (dtype,))
    }
}
