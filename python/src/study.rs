//! The results of studies.

use crate::errors::to_py_err;
use crate::exit;
use pyo3::prelude::*;
use std::path::Path;
use swm::cli::study;

/// The name, title and question of every study of this program, as JSON.
#[pyfunction]
pub fn studies() -> PyResult<String> {
    Ok(study::shipped().map_err(to_py_err)?.to_string())
}

/// The results of the study in a folder, as JSON.
#[pyfunction]
pub fn study_results(py: Python<'_>, folder: &str) -> PyResult<String> {
    exit::detached(py, || Ok(study::results(Path::new(folder))?.to_string())).map_err(to_py_err)
}

/// The table of the study in a folder, in a format of `swm study export`.
#[pyfunction]
pub fn study_export(py: Python<'_>, folder: &str, format: &str) -> PyResult<String> {
    exit::detached(py, || study::export(Path::new(folder), format)).map_err(to_py_err)
}
