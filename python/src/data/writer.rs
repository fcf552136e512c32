//! [`Writer`]: writes episodes into a dataset in one of the engine's formats.

use super::process::{Owned, detached, in_pool};
use super::{Column, image_codec, schema, write_mode};
use crate::arrays;
use crate::errors::{json, to_py_err};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::sync::{Mutex, MutexGuard, PoisonError};
use swm::data::{FORMATS, WriteOptions};
use swm::home;

/// A dataset writer.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Writer(Owned<Mutex<Open>>);

/// The writer of the engine; `None` once it is finished.
type Open = Option<Box<dyn swm::data::Writer>>;

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
        let made = detached(py, || {
            let location = home::target(path, format)?;
            match format {
                Some(format) => FORMATS.get(format)?.create(&location, &schema, options),
                None => swm::data::create(location, &schema, options),
            }
        });
        made.map(|writer| Self(Owned::new(Mutex::new(Some(writer))))).map_err(to_py_err)
    }

    /// Adds an episode (arrays `[rows, ..]` with the schema's columns in order) and its constants.
    fn write(&self, py: Python<'_>, episode: &Bound<'_, PyDict>, constants: &Bound<'_, PyDict>) -> PyResult<()> {
        let (episode, constants) = (arrays::batch(episode)?, super::constants(constants)?);
        let write = || match &mut *self.lock()? {
            Some(writer) => writer.write_episode_with(&episode, &constants).map_err(to_py_err),
            None => Err(PyValueError::new_err("the writer is closed: open another one, with mode='append'")),
        };
        in_pool(py, write).map_err(to_py_err)?
    }

    /// The number of episodes in the dataset; `None` once the writer is finished.
    fn episodes(&self) -> PyResult<Option<usize>> {
        Ok(self.lock()?.as_ref().map(|writer| writer.episodes()))
    }

    /// Commits the remaining episodes and closes the writer.
    fn finish(&self, py: Python<'_>) -> PyResult<()> {
        let finish = || self.lock()?.take().map_or(Ok(()), |writer| writer.finish().map_err(to_py_err));
        in_pool(py, finish).map_err(to_py_err)?
    }
}

impl Writer {
    fn lock(&self) -> PyResult<MutexGuard<'_, Open>> {
        let open = self.0.get("writer").map_err(to_py_err)?;
        Ok(open.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
