//! Converting, examining, describing.

use super::dataset::Dataset;
use super::image_codec;
use super::process::work;
use crate::errors::{foreign, json, raised, signals};
use pyo3::prelude::*;
use serde::Deserialize;
use serde_json::{Value, json as value};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use swm::core::run::{Control, Event};
use swm::core::{Error, Named as _};
use swm::data::doctor::{examine, open_damaged, repair};
use swm::data::{ConvertMode, ConvertOptions, Converted, Location, Reader, checksum, formats};
use swm::home;

/// How to convert, from JSON.
#[derive(Deserialize)]
struct Wanted {
    format: Option<String>,
    mode: Mode,
    codec: Option<Value>,
    verify: bool,
    least_psnr: f64,
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Mode {
    Resume,
    Error,
    Overwrite,
    Append,
}

impl Wanted {
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

/// A control that reports progress to Python's `tell(stage, done, total)` and lets Python handle signals. An exception
/// that either raises stops the run.
fn control<'a>(tell: Option<Py<PyAny>>) -> Control<'a> {
    let failed = Arc::new(Mutex::new(None));
    let raised = Arc::clone(&failed);
    let mut signals = signals();
    let control =
        Control::new().with_poll(move || match failed.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(error) => Err(foreign(error)),
            None => signals(),
        });
    let Some(tell) = tell else { return control };
    control.with_events(move |event| {
        let Event::Progress(at) = event else { return };
        let outcome = Python::attach(|py| tell.call1(py, (at.stage, at.done, at.total)).map(drop));
        if let Err(error) = outcome {
            raised.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
    })
}

fn text(found: &impl serde::Serialize) -> PyResult<String> {
    serde_json::to_string(found).map_err(|error| raised(Error::external("writing JSON", error)))
}

/// Writes a dataset to another place; returns what became of it as JSON. `tell(stage, done, total)` is called on the way.
#[pyfunction]
pub fn convert(
    py: Python<'_>,
    dataset: &Dataset,
    target: &str,
    options: &str,
    tell: Option<Py<PyAny>>,
) -> PyResult<String> {
    let options = json::<Wanted>("conversion", options)?.options()?;
    let mut control = control(tell);
    let converted = work(py, || {
        let target = home::target(target, options.format.as_deref())?;
        swm::data::convert(&dataset.reader()?, &target, &options, &mut control)
    });
    text(&converted.map_err(raised)?)
}

/// Examines a dataset, and writes what is sound of it to `target` if there is one; returns what was found as JSON.
#[pyfunction]
pub fn doctor(
    py: Python<'_>,
    path: &str,
    target: Option<&str>,
    options: &str,
    tell: Option<Py<PyAny>>,
) -> PyResult<String> {
    let options = json::<Wanted>("repair", options)?.options()?;
    let mut control = control(tell);
    let found = work(py, || {
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
    text(&found.map_err(raised)?)
}

/// What is in a dataset, as JSON. With `summed` everything is read for the checksum of what readers get.
#[pyfunction]
pub fn inspect(py: Python<'_>, dataset: &Dataset, summed: bool) -> PyResult<String> {
    let found = work(py, || {
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
            "checksum": if summed { Some(checksum(reader)?) } else { None },
        }))
    });
    text(&found.map_err(raised)?)
}

/// The format that recognises a path or URI, existing or about to be created.
#[pyfunction]
pub fn detect(path: &str) -> PyResult<Option<&'static str>> {
    let location = Location::parse(path).map_err(raised)?;
    Ok(formats::detect(&location).map(|format| format.id()))
}

/// Where a dataset is that is there, given by path, URI or name.
#[pyfunction]
pub fn find_dataset(path: &str) -> PyResult<String> {
    home::find_dataset(path).map(|location| location.to_string()).map_err(raised)
}

/// Where a dataset is to be written, given by path, URI or name.
#[pyfunction]
pub fn target(path: &str, format: Option<&str>) -> PyResult<String> {
    home::target(path, format).map(|location| location.to_string()).map_err(raised)
}
