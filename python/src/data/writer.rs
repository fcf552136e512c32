//! [`Writer`]: episodes into a dataset of one of our formats.

use super::{Column, constants, image_codec, schema, write_mode};
use crate::arrays;
use crate::errors::{json, raised};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::sync::{Mutex, PoisonError};
use swm::data::{FORMATS, WriteOptions};
use swm::home;

/// Writes episodes of a schema.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Writer(Mutex<Option<Box<dyn swm::data::Writer>>>);

#[pymethods]
impl Writer {
    #[new]
    fn new(
        py: Python<'_>,
        path: &str,
        format: Option<&str>,
        mode: &str,
        codec: Option<&str>,
        columns: Vec<Column>,
        manifest: Option<&str>,
    ) -> PyResult<Self> {
        let schema = schema(columns)?;
        let manifest = manifest.map(|text| json("manifest", text)).transpose()?;
        let options =
            WriteOptions { mode: write_mode(mode), codec: image_codec(codec)?, manifest, ..WriteOptions::default() };
        let made = py.detach(|| {
            let location = home::target(path, format)?;
            match format {
                Some(format) => FORMATS.get(format)?.create(&location, &schema, options),
                None => swm::data::create(location, &schema, options),
            }
        });
        made.map(|writer| Self(Mutex::new(Some(writer)))).map_err(raised)
    }

    /// Adds an episode, arrays `[rows, ..]` of the schema's types in its order, and what is the same in all of its steps.
    fn write(&self, py: Python<'_>, episode: &Bound<'_, PyDict>, same: &Bound<'_, PyDict>) -> PyResult<()> {
        let (episode, same) = (arrays::batch(episode)?, constants(same)?);
        py.detach(|| match &mut *self.lock() {
            Some(writer) => writer.write_episode_with(&episode, &same).map_err(raised),
            None => Err(PyValueError::new_err("the writer is closed: open another one, with mode='append'")),
        })
    }

    /// Episodes of the dataset; none once it is closed.
    fn episodes(&self) -> Option<usize> {
        self.lock().as_ref().map(|writer| writer.episodes())
    }

    /// Commits what is not committed yet, and ends.
    fn finish(&self, py: Python<'_>) -> PyResult<()> {
        py.detach(|| self.lock().take().map_or(Ok(()), |writer| writer.finish())).map_err(raised)
    }
}

impl Writer {
    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Box<dyn swm::data::Writer>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
