//! Converts, examines and describes datasets.

use super::dataset::Dataset;
use super::image_codec;
use super::process::detached;
use crate::errors::{from_py_err, json, signal_poll, to_py_err};
use crate::exit;
use crate::held::Held;
use pyo3::prelude::*;
use serde::Deserialize;
use serde_json::{Value, json as value};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use swm::core::run::{Control, Event};
use swm::core::{Error, Named as _};
use swm::data::doctor::{examine, open_damaged, repair};
use swm::data::{ConvertMode, ConvertOptions, Converted, Location, Reader, checksum, formats};
use swm::home;

/// The options of a conversion, from JSON.
#[derive(Deserialize)]
struct Options {
    format: Option<String>,
    mode: Mode,
    codec: Option<Value>,
    verify: bool,
    least_psnr: Option<f64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Mode {
    Resume,
    Error,
    Overwrite,
    Append,
}

impl Options {
    fn options(self) -> PyResult<ConvertOptions> {
        let mode = match self.mode {
            Mode::Resume => ConvertMode::Resume,
            Mode::Error => ConvertMode::Create,
            Mode::Overwrite => ConvertMode::Overwrite,
            Mode::Append => ConvertMode::Append,
        };
        Ok(ConvertOptions {
            format: self.format,
            mode,
            codec: image_codec(self.codec.map(|codec| codec.to_string()).as_deref())?,
            verify: self.verify,
            least_psnr: self.least_psnr,
            ..ConvertOptions::default()
        })
    }
}

/// Creates a run control that calls Python's `progress(stage, done, total)` and runs Python's signal handlers. An
/// exception from either stops the run.
fn control<'a>(progress: Option<Py<PyAny>>) -> Control<'a> {
    let failed = Arc::new(Mutex::new(None));
    let callback_error = Arc::clone(&failed);
    let mut poll = signal_poll();
    let control =
        Control::new().with_poll(move || match failed.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(error) => Err(error),
            None => poll(),
        });
    let Some(progress) = progress.map(Held::new) else { return control };
    control.with_events(move |event| {
        let Event::Progress(at) = event else { return };
        let outcome = Python::try_attach(|py| exit::call(progress.bind(py), (at.stage, at.done, at.total)).map(drop));
        if let Some(Err(error)) = outcome {
            let error = from_py_err(error);
            callback_error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
    })
}

/// Writes a value as JSON text.
fn to_json(value: &impl serde::Serialize) -> PyResult<String> {
    serde_json::to_string(value).map_err(|error| to_py_err(Error::external("writing JSON", error)))
}

/// Copies a dataset to `target` and returns the outcome as JSON. Calls `progress(stage, done, total)`.
#[pyfunction]
pub fn convert(
    py: Python<'_>,
    dataset: &Dataset,
    target: &str,
    options: &str,
    progress: Option<Py<PyAny>>,
) -> PyResult<String> {
    let options = json::<Options>("conversion", options)?.options()?;
    let mut control = control(progress);
    let converted = detached(py, || {
        let target = home::target(target, options.format.as_deref())?;
        swm::data::convert(&dataset.reader()?, &target, &options, &mut control)
    });
    to_json(&converted.map_err(to_py_err)?)
}

/// Examines a dataset, and writes its intact episodes to `target` if one is given. Returns the diagnosis as JSON.
#[pyfunction]
pub fn doctor(
    py: Python<'_>,
    path: &str,
    target: Option<&str>,
    options: &str,
    progress: Option<Py<PyAny>>,
) -> PyResult<String> {
    let options = json::<Options>("repair", options)?.options()?;
    let mut control = control(progress);
    let found = detached(py, || {
        let (reader, lost) = open_damaged(&home::find_dataset(path)?)?;
        let mut diagnosis = examine(&*reader, &swm::models::dataset_requirements()?, &mut control)?;
        diagnosis.add_losses(lost);
        let mut repaired: Option<Converted> = None;
        if let Some(target) = target {
            let target: Location = home::target(target, options.format.as_deref())?;
            repaired = Some(repair(&reader, &diagnosis, &target, &options, &mut control)?);
        }
        let mut found = value!(diagnosis);
        found["problems"] = value!(diagnosis.problems());
        found["repaired"] = value!(repaired);
        Ok(found)
    });
    to_json(&found.map_err(to_py_err)?)
}

/// Describes a dataset as JSON. With `with_checksum`, reads all rows to compute the checksum of the decoded content.
#[pyfunction]
pub fn inspect(py: Python<'_>, dataset: &Dataset, with_checksum: bool) -> PyResult<String> {
    let found = detached(py, || {
        let reader = dataset.reader()?;
        let reader: &dyn Reader = &*reader;
        let footprint: BTreeMap<String, u64> = reader.footprint()?.into_iter().collect();
        let lengths: Vec<usize> = reader.episodes().iter().map(|episode| episode.length).collect();
        Ok(value!({
            "episodes": lengths.len(),
            "steps": lengths.iter().sum::<usize>(),
            "lengths": lengths,
            "bytes": footprint.values().sum::<u64>(),
            "footprint": footprint,
            "content_hash": reader.content_hash()?,
            "checksum": if with_checksum { Some(checksum(reader)?) } else { None },
        }))
    });
    to_json(&found.map_err(to_py_err)?)
}

/// The id of the format that recognises a path or URI; the path need not exist.
#[pyfunction]
pub fn detect(path: &str) -> PyResult<Option<&'static str>> {
    let location = Location::parse(path).map_err(to_py_err)?;
    Ok(formats::detect(&location).map(|format| format.id()))
}

/// Whether an existing path holds no dataset yet: an empty folder, or what a writer leaves that was killed.
#[pyfunction]
pub fn has_no_dataset(path: PathBuf) -> bool {
    formats::has_no_dataset(&path)
}

/// Raises an error if the dataset at a path is being replaced, or that was interrupted.
#[pyfunction]
pub fn check_replacement(path: &str) -> PyResult<()> {
    let location = Location::parse(path).map_err(to_py_err)?;
    formats::interrupted(&location).map_or(Ok(()), |error| Err(to_py_err(error)))
}

/// The location of an existing dataset, given by path, URI or name. A dataset of a hub is downloaded.
#[pyfunction]
pub fn find_dataset(py: Python<'_>, path: &str) -> PyResult<String> {
    exit::detached(py, || home::find_dataset(path).map(|location| location.to_string())).map_err(to_py_err)
}

/// A warning if a dataset was recorded in another environment than the one that starts from its rows.
#[pyfunction]
pub fn warning_of_starts(py: Python<'_>, dataset: &str, env: &str) -> PyResult<Option<String>> {
    exit::detached(py, || Ok(swm::recorded_env::warning_of_starts(dataset, env))).map_err(to_py_err)
}

/// The URI of a dataset of a hub with the commit that it has now; another URI, path or name unchanged.
#[pyfunction]
pub fn pinned_dataset(py: Python<'_>, path: &str) -> PyResult<String> {
    exit::detached(py, || home::pinned_dataset(path)).map_err(to_py_err)
}

/// Completes or undoes an interrupted replacement of the dataset at a path or URI.
#[pyfunction]
pub fn recover(py: Python<'_>, path: &str) -> PyResult<()> {
    exit::detached(py, || swm::data::recover(&Location::parse(path)?)).map_err(to_py_err)
}

/// The location for a new dataset, given by path, URI or name.
#[pyfunction]
pub fn target(path: &str, format: Option<&str>) -> PyResult<String> {
    home::target(path, format).map(|location| location.to_string()).map_err(to_py_err)
}
