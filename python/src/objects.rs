//! Small files of runs that several machines share: on this machine, or in an object store.

use crate::errors::to_py_err;
use crate::exit;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use swm::core::Result;
use swm::data::{Location, objects};

/// Runs a request without the interpreter lock.
fn at<T: Send>(py: Python<'_>, location: &str, run: impl Send + FnOnce(&Location) -> Result<T>) -> PyResult<T> {
    exit::detached(py, || run(&Location::parse(location)?)).map_err(to_py_err)
}

/// The content of a file; `None` if it does not exist.
#[pyfunction]
pub fn object_read<'py>(py: Python<'py>, location: &str) -> PyResult<Option<Bound<'py, PyBytes>>> {
    Ok(at(py, location, objects::read_file)?.map(|content| PyBytes::new(py, &content)))
}

/// Writes a file.
#[pyfunction]
pub fn object_write(py: Python<'_>, location: &str, content: Vec<u8>) -> PyResult<()> {
    at(py, location, |location| objects::write_file(location, content))
}

/// Writes a file unless it exists; returns whether this call wrote it.
#[pyfunction]
pub fn object_write_new(py: Python<'_>, location: &str, content: Vec<u8>) -> PyResult<bool> {
    at(py, location, |location| objects::write_new_file(location, content))
}

/// The paths of all files below a folder, relative to it.
#[pyfunction]
pub fn object_list(py: Python<'_>, folder: &str) -> PyResult<Vec<String>> {
    at(py, folder, objects::list_files)
}

/// What the last bits of models depend on: the architecture of this processor and its vector instructions, where they matter.
#[pyfunction]
pub fn cpu_level() -> String {
    swm::capsule::arithmetic(&swm::capsule::cpu_level()).to_owned()
}
