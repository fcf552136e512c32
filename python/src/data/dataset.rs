//! [`Dataset`]: the rows of episodes, as numpy arrays.

use super::foreign::ForeignReader;
use super::process::work;
use super::{Column, Kept, columns, described};
use crate::errors::raised;
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use std::sync::{Arc, Mutex, PoisonError};
use swm::core::columns::ACTION;
use swm::core::{Batch, ColumnSpec, Error, Result, Schema};
use swm::data::{CacheConfig, FORMATS, Reader, StepRange, views};
use swm::home;

/// How a reader is made, once more in a forked process.
type Open = Arc<dyn Fn() -> Result<Arc<dyn Reader>> + Send + Sync>;

/// A dataset, or a view of some.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Dataset {
    open: Open,
    opened: Mutex<Opened>,
}

struct Opened {
    /// Who opened it.
    process: u32,
    reader: Arc<dyn Reader>,
}

impl Dataset {
    pub fn of(py: Python<'_>, open: Open) -> PyResult<Self> {
        let reader = work(py, || open()).map_err(raised)?;
        Ok(Self { open, opened: Mutex::new(Opened { process: std::process::id(), reader }) })
    }

    /// Its reader, in whichever process.
    ///
    /// # Errors
    /// When it must be opened again and cannot be.
    pub fn reader(&self) -> Result<Arc<dyn Reader>> {
        let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
        let process = std::process::id();
        if opened.process != process {
            let reader = (self.open)()?;
            // What the parent opened may wait for its threads when it goes.
            std::mem::forget(std::mem::replace(&mut opened.reader, reader));
            opened.process = process;
        }
        Ok(Arc::clone(&opened.reader))
    }

    fn here(&self, py: Python<'_>) -> PyResult<Arc<dyn Reader>> {
        work(py, || self.reader()).map_err(raised)
    }
}

impl Drop for Dataset {
    fn drop(&mut self) {
        let opened = self.opened.get_mut().unwrap_or_else(PoisonError::into_inner);
        if opened.process != std::process::id() {
            std::mem::forget(Arc::clone(&opened.reader));
        }
    }
}

#[pymethods]
impl Dataset {
    /// Opens a dataset by path, URI or name.
    #[new]
    fn new(py: Python<'_>, path: String, format: Option<String>) -> PyResult<Self> {
        let open = move || {
            let location = home::find_dataset(&path)?;
            match &format {
                Some(format) => FORMATS.get(format)?.open(&location),
                None => swm::data::open(location),
            }
        };
        Self::of(py, Arc::new(open))
    }

    /// A dataset that an object of Python's reads: see [`ForeignReader`].
    #[staticmethod]
    fn foreign(py: Python<'_>, reader: Py<PyAny>) -> PyResult<Self> {
        let reader: Arc<dyn Reader> = Arc::new(ForeignReader::new(py, reader)?);
        Self::of(py, Arc::new(move || Ok(Arc::clone(&reader))))
    }

    /// The episodes of several datasets, one after another.
    #[staticmethod]
    fn concat(py: Python<'_>, parts: Vec<Py<Self>>) -> PyResult<Self> {
        let open = move || views::concat(parts.iter().map(|part| part.get().reader()).collect::<Result<_>>()?);
        Self::of(py, Arc::new(open))
    }

    /// A dataset with columns of another one that has the same episodes.
    #[staticmethod]
    fn merge(py: Python<'_>, base: Py<Self>, other: Py<Self>, names: Vec<String>) -> PyResult<Self> {
        let open = move || {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            views::merge(base.get().reader()?, other.get().reader()?, &names)
        };
        Self::of(py, Arc::new(open))
    }

    /// The same dataset, with decoded rows of some columns kept in memory.
    fn kept(slf: Py<Self>, py: Python<'_>, names: Vec<String>, bytes: usize) -> PyResult<Self> {
        let open = move || {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            CacheConfig::Memory { bytes }.over(slf.get().reader()?, &names)
        };
        Self::of(py, Arc::new(open))
    }

    /// Its columns.
    fn schema(&self, py: Python<'_>) -> PyResult<Vec<Column>> {
        Ok(described(self.here(py)?.schema()))
    }

    /// Rows of every episode.
    #[allow(clippy::cast_possible_wrap)]
    fn lengths<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let reader = self.here(py)?;
        Ok(PyArray1::from_iter(py, reader.episodes().iter().map(|episode| episode.length as i64)))
    }

    /// The number of every episode.
    fn numbers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let reader = self.here(py)?;
        Ok(PyArray1::from_iter(py, reader.episodes().iter().map(|episode| episode.index)))
    }

    /// Where it comes from, as JSON, if it says.
    fn manifest(&self, py: Python<'_>) -> PyResult<Option<String>> {
        let manifest = self.here(py)?.manifest();
        let text = manifest.map(|manifest| serde_json::to_string(&manifest)).transpose();
        text.map_err(|error| raised(Error::external("writing a manifest", error)))
    }

    /// What is the same in every step of an episode, by name.
    fn constants<'py>(&self, py: Python<'py>, episode: usize) -> PyResult<Bound<'py, PyDict>> {
        let constants = work(py, || self.reader()?.constants(episode)).map_err(raised)?;
        let dict = PyDict::new(py);
        for (name, bytes) in constants {
            dict.set_item(name, PyBytes::new(py, &bytes))?;
        }
        Ok(dict)
    }

    /// The rows of runs of episodes, one run after another, as arrays `[rows, ..]`: of actions all, of other columns the
    /// first and every `frameskip`-th behind it. Everything is read together.
    fn read<'py>(
        &self,
        py: Python<'py>,
        names: Vec<String>,
        episodes: PyReadonlyArray1<'py, i64>,
        starts: PyReadonlyArray1<'py, i64>,
        lengths: PyReadonlyArray1<'py, i64>,
        frameskip: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (episodes, starts, lengths) = (episodes.as_array(), starts.as_array(), lengths.as_array());
        if frameskip == 0 || episodes.len() != starts.len() || episodes.len() != lengths.len() {
            return Err(PyValueError::new_err(
                "expected a frameskip of at least 1, and a start and a length an episode",
            ));
        }
        let mut runs = Vec::with_capacity(episodes.len());
        for ((&episode, &start), &length) in episodes.iter().zip(starts).zip(lengths) {
            let (Ok(episode), Ok(start), Ok(length)) =
                (usize::try_from(episode), usize::try_from(start), usize::try_from(length))
            else {
                return Err(PyIndexError::new_err(format!("{length} rows from row {start} of episode {episode}")));
            };
            runs.push(StepRange::new(episode, start, length));
        }
        let batch = work(py, || read(&*self.reader()?, &names, &runs, frameskip)).map_err(raised)?;
        // Columns may have more rows than others, so each is a batch of its own.
        let dict = PyDict::new(py);
        for column in batch {
            dict.update(columns(py, Kept::Own(column))?.as_mapping())?;
        }
        Ok(dict)
    }
}

fn read(reader: &dyn Reader, names: &[String], runs: &[StepRange], frameskip: usize) -> Result<Vec<Batch>> {
    let shown: Vec<StepRange> = match frameskip {
        1 => vec![],
        _ => runs
            .iter()
            .flat_map(|run| (0..run.length).step_by(frameskip).map(|at| StepRange::new(run.episode, run.start + at, 1)))
            .collect(),
    };
    let one = |name: &String| {
        let runs = if name == ACTION || frameskip == 1 { runs } else { &shown };
        let spec: ColumnSpec = reader.schema().column(name)?.clone();
        let mut batch = Batch::zeros(&Schema::new([spec])?, runs.iter().map(|run| run.length).sum());
        reader.read_column(name, runs, batch.bytes_mut(0))?;
        Ok(batch)
    };
    names.iter().map(one).collect()
}
