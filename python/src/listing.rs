//! What there is, as JSON, and the command line.

use crate::errors::raised;
use clap::Parser as _;
use pyo3::prelude::*;
use serde_json::{Map, Value};

/// Ids of the environments.
#[pyfunction]
pub fn envs() -> Vec<&'static str> {
    swm::ENVS.rows.iter().map(|row| row.id).collect()
}

/// What an environment is.
#[pyfunction]
pub fn spec(py: Python<'_>, id: &str) -> PyResult<String> {
    let described = py.detach(|| {
        let chosen = swm::env(id)?;
        let env = chosen.env()?;
        Ok(swm::describe::env(&chosen.entry, env.spec()).to_string())
    });
    described.map_err(raised)
}

/// The solvers and their settings.
#[pyfunction]
pub fn solvers() -> String {
    let rows = swm::plan::SOLVERS.rows.iter();
    let all: Map<String, Value> = rows.map(|row| (row.id.to_owned(), (row.defaults)())).collect();
    Value::Object(all).to_string()
}

/// The visual wrappers and their settings.
#[pyfunction]
pub fn wrappers() -> String {
    let rows = swm::envs::wrappers::WRAPPERS.rows.iter();
    let all: Map<String, Value> = rows.map(|row| (row.id.to_owned(), row.describe())).collect();
    Value::Object(all).to_string()
}

/// The dataset formats.
#[pyfunction]
pub fn formats() -> Vec<&'static str> {
    swm::data::FORMATS.rows.iter().map(|row| row.id).collect()
}

/// The folder everything without a path of its own lives in.
#[pyfunction]
pub fn home() -> String {
    swm::home::home().display().to_string()
}

/// Runs the command line; returns its exit code.
#[pyfunction]
pub fn command(py: Python<'_>, words: Vec<String>) -> u8 {
    py.detach(|| match swm::cli::Cli::try_parse_from(words) {
        Ok(cli) => cli.run(),
        Err(error) => {
            // Help and versions are printed as answers, wrong words as complaints; there is nobody left to tell if that fails.
            let _ = error.print();
            u8::try_from(error.exit_code()).unwrap_or(2)
        }
    })
}
