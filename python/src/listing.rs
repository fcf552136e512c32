//! The engine's registries as JSON, and the command line.

use crate::errors::to_py_err;
use crate::exit;
use crate::warnings;
use pyo3::prelude::*;
use serde_json::{Map, Value};
use std::ffi::OsString;

/// The ids of the native environments.
#[pyfunction]
pub fn envs() -> Vec<&'static str> {
    swm::ENVS.rows.iter().map(|row| row.id).collect()
}

/// The description of an environment, as JSON: spaces, info columns, factors, options, experts.
#[pyfunction]
pub fn spec(py: Python<'_>, id: &str) -> PyResult<String> {
    let described = exit::detached(py, || {
        let chosen = swm::env(id, &swm::core::Origin::User)?;
        let env = chosen.env()?;
        Ok(swm::describe::env(&chosen.entry, env.spec()).to_string())
    });
    described.map_err(to_py_err)
}

/// The default settings of every solver by its id, as JSON.
#[pyfunction]
pub fn solvers() -> String {
    let rows = swm::plan::SOLVERS.rows.iter();
    let all: Map<String, Value> = rows.map(|row| (row.id.to_owned(), (row.defaults)())).collect();
    Value::Object(all).to_string()
}

/// The settings of every visual wrapper by its id, as JSON.
#[pyfunction]
pub fn wrappers() -> String {
    let rows = swm::envs::wrappers::WRAPPERS.rows.iter();
    let all: Map<String, Value> = rows.map(|row| (row.id.to_owned(), row.describe())).collect();
    Value::Object(all).to_string()
}

/// The ids of the dataset formats.
#[pyfunction]
pub fn formats() -> Vec<&'static str> {
    swm::data::FORMATS.rows.iter().map(|row| row.id).collect()
}

/// The home folder, which holds the datasets and checkpoints that are given by name.
#[pyfunction]
pub fn home() -> PyResult<OsString> {
    // What is not UTF-8 becomes what `os.fsdecode` makes of it.
    Ok(swm::home::home().map_err(to_py_err)?.into_os_string())
}

/// Runs the command line with these arguments (the program's name first) and returns its exit code.
#[pyfunction]
pub fn command(py: Python<'_>, arguments: Vec<String>) -> u8 {
    py.detach(|| warnings::printing(|| swm::cli::run(arguments)))
}
