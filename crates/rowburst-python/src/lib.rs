//! The extension module behind the Python package `rowburst`: values in and out of numpy, the
//! library's errors as exceptions, the interpreter's lock released while it works.
//!
//! What users see is documented in `python/rowburst`.

mod array;
mod batch;
mod camera;
mod error;
mod experiment;
mod operator;
mod psf;
mod result;
mod sequence;
mod simulation;
mod task;

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

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }

    /// Sets the number of threads, once, before anything is computed.
    #[pyfunction]
    fn set_threads(threads: usize) -> PyResult<()> {
        if threads == 0 {
            let rule = "there is at least one";
            let error = rowburst::Error::input("threads", 0, rule, "Give the number of cores.");
            return Err(crate::error::to_py_err(error));
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build_global().map_err(|error| {
            let remedy = "Call set_threads before anything else.";
            crate::error::to_py_err(rowburst::Error::work("threads", error, remedy))
        })
    }

    /// The frames of a file, float32 [frame, y, x]: every format that the command line reads.
    #[pyfunction]
    fn read_frames(
        py: Python<'_>,
        path: std::path::PathBuf,
    ) -> PyResult<Bound<'_, numpy::PyArray3<f32>>> {
        let video = py.detach(|| rowburst_io::read_video(&path));
        crate::array::from_video(py, video.map_err(crate::error::to_py_err)?)
    }

    /// Threads that are used.
    #[pyfunction]
    fn threads() -> usize {
        rayon::current_num_threads()
    }
}
