//! `rowburst._rowburst._View`: the viewer's page of result folders, served by this process.

use crate::error::to_py_err;
use pyo3::prelude::*;
use rowburst::Result;
use rowburst_view::{ResultFiles, Server};
use std::path::PathBuf;

/// A server on 127.0.0.1 that shows results.
#[pyclass(name = "_View", module = "rowburst._rowburst", frozen)]
pub struct PyView {
    server: Server,
}

#[pymethods]
impl PyView {
    #[new]
    #[pyo3(signature = (results, port=None))]
    fn new(py: Python<'_>, results: Vec<PathBuf>, port: Option<u16>) -> PyResult<Self> {
        let start = || -> Result<Self> {
            let files = results.iter().map(|path| ResultFiles::open(path));
            let server = Server::start(port, files.collect::<Result<_>>()?, None)?;
            Ok(Self { server })
        };
        py.detach(start).map_err(to_py_err)
    }

    /// The address of the page.
    #[getter]
    fn url(&self) -> String {
        self.server.url()
    }

    /// Ends the server.
    fn close(&self) {
        self.server.stop();
    }
}
