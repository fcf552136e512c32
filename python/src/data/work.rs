//! Converting, examining, describing.

use super::dataset::Dataset;
use super::image_codec;
use super::process::work;
use crate::errors::{foreign, json, raised, signals};
use pyo3::prelude::*;
use serde::Deserialize;
use serde_json::{Value, json as value};
use std::collections::BTreeMap;
use swm::core::{Error, Named as _};
use swm::data::convert::Stage;
use swm::data::doctor::{examine, open_what_is_left, repair};
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

/// Tells Python how far the work is, lets it see its signals, and remembers what it raised.
struct Watch {
    tell: Option<Py<PyAny>>,
    signals: Box<dyn FnMut() -> swm::core::Result<()> + Send>,
    raised: Option<Error>,
}

impl Watch {
    fn new(tell: Option<Py<PyAny>>) -> Self {
        Self { tell, signals: Box::new(signals()), raised: None }
    }

    /// Whether the work goes on.
    fn at(&mut self, stage: &str, done: usize, total: usize) -> bool {
        let told = match &self.tell {
            Some(tell) => Python::attach(|py| tell.call1(py, (stage, done, total)).map(drop)).map_err(foreign),
            None => Ok(()),
        };
        self.raised = told.and_then(|()| (self.signals)()).err();
        self.raised.is_none()
    }

    /// The outcome, with what Python raised in place of the interruption that it caused.
    fn outcome<T>(self, outcome: swm::core::Result<T>) -> PyResult<T> {
        match self.raised {
            Some(error) => Err(raised(error)),
            None => outcome.map_err(raised),
        }
    }
}

fn stage(stage: Stage) -> &'static str {
    match stage {
        Stage::Comparing => "compare",
        Stage::Writing => "convert",
        Stage::Verifying => "verify",
    }
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
    let mut watch = Watch::new(tell);
    let converted = work(py, || {
        let target = home::target(target, options.format.as_deref())?;
        let mut progress = |at, done, total| watch.at(stage(at), done, total);
        swm::data::convert(&dataset.reader()?, &target, &options, &mut progress)
    });
    text(&watch.outcome(converted)?)
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
    let mut watch = Watch::new(tell);
    let found = work(py, || {
        let (reader, lost) = open_what_is_left(&home::find_dataset(path)?)?;
        let total = reader.episodes().len();
        let mut diagnosis = examine(&*reader, &mut |done| watch.at("examine", done, total))?;
        diagnosis.add_lost(lost);
        let mut repaired: Option<Converted> = None;
        if let Some(target) = target {
            let target: Location = home::target(target, options.format.as_deref())?;
            let mut progress = |at, done, total| watch.at(stage(at), done, total);
            repaired = Some(repair(&reader, &diagnosis, &target, &options, &mut progress)?);
        }
        let mut found = value!(diagnosis);
        found["problems"] = value!(diagnosis.problems());
        found["repaired"] = value!(repaired);
        Ok(found)
    });
    text(&watch.outcome(found)?)
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
