//! The extension module behind the Python package `rowburst`: values in and out of numpy, the
//! library's errors as exceptions, the interpreter's lock released while it works.
//!
//! What users see is documented in `python/rowburst`.

mod array;
mod batch;
mod calibrate;
mod camera;
mod capture;
mod command;
mod design;
mod error;
mod experiment;
mod files;
mod frame;
mod frames;
mod html;
mod interrupt;
mod log;
mod memory;
mod operator;
mod options;
mod pickle;
mod psf;
mod result;
mod run_files;
mod sequence;
mod simulation;
mod state;
mod task;
mod threads;
mod view;
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
    use crate::calibrate::{PyPsfCalibration, PySensorCalibration, PyTimingCalibration};
    #[pymodule_export]
    use crate::camera::PyCamera;
    #[pymodule_export]
    use crate::capture::{_property_origin, _read_properties, PyRecorder, PySource};
    #[pymodule_export]
    use crate::command::_command;
    #[pymodule_export]
    use crate::design::PyDesign;
    #[pymodule_export]
    use crate::error::{InputError, WorkError};
    #[pymodule_export]
    use crate::experiment::PyExperiment;
    #[pymodule_export]
    use crate::files::{_metadata, _psnr_db, _save_sweep, _ssim, _sweep_lines, _sweep_path};
    #[pymodule_export]
    use crate::frames::PyFrames;
    #[pymodule_export]
    use crate::interrupt::PyCancel;
    #[pymodule_export]
    use crate::operator::{PyDataTerm, PyOperator};
    #[pymodule_export]
    use crate::psf::{PyPsf, speckle_psf};
    #[pymodule_export]
    use crate::result::{_save_colour, PyProgress, PyReconstruction, figure_from_folder};
    #[pymodule_export]
    use crate::sequence::{PyLook, PySequence};
    #[pymodule_export]
    use crate::simulation::{PySimulation, simulate};
    #[pymodule_export]
    use crate::task::{_reconstruct_chunked, _reconstruct_colour, PyReconstructor, reconstruct};
    #[pymodule_export]
    use crate::threads::{set_threads, threads};
    #[pymodule_export]
    use crate::view::PyView;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        crate::error::declare_attributes(module.py())?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
