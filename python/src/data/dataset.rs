//! [`Dataset`]: reads the rows of episodes into numpy arrays.

use super::foreign::ForeignReader;
use super::process::detached;
use super::{BatchMemory, Column, columns, described};
use crate::errors::to_py_err;
use crate::held::Held;
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use std::sync::{Arc, Mutex, PoisonError};
use swm::core::columns::ACTION;
use swm::core::{Batch, ColumnSpec, Error, Result, Schema};
use swm::data::{CacheConfig, FORMATS, Mark, Reader, StepRange, views};
use swm::home;

/// A function that opens a reader. A forked process calls the function again.
type Open = Arc<dyn Fn() -> Result<Arc<dyn Reader>> + Send + Sync>;

/// A dataset, or a view of one or several datasets.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Dataset {
    open: Open,
    opened: Mutex<Opened>,
    /// What is compared when another process opens the dataset again. `None` for views, whose parts have their own, for readers in
    /// Python, and if it could not be read.
    mark: Option<Mark>,
}

struct Opened {
    /// The id of the process that opened the reader.
    process: u32,
    reader: Arc<dyn Reader>,
}

impl Dataset {
    /// Opens a dataset with `open`, which forked processes call again.
    ///
    /// # Errors
    /// The error of `open`.
    pub fn of(py: Python<'_>, open: Open) -> PyResult<Self> {
        let reader = detached(py, || open()).map_err(to_py_err)?;
        Ok(Self::with(reader, open, None))
    }

    fn with(reader: Arc<dyn Reader>, open: Open, mark: Option<Mark>) -> Self {
        Self { open, opened: Mutex::new(Opened { process: std::process::id(), reader }), mark }
    }

    /// Returns the reader of this process. A forked process opens a new reader.
    ///
    /// # Errors
    /// If a forked process cannot open its reader, or the dataset was replaced before that.
    pub fn reader(&self) -> Result<Arc<dyn Reader>> {
        let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
        let process = std::process::id();
        if opened.process != process {
            let reader = (self.open)()?;
            self.mark.as_ref().map_or(Ok(()), |mark| mark.check(&*reader))?;
            // Dropping the parent's reader could wait for threads that the forked process does not have.
            std::mem::forget(std::mem::replace(&mut opened.reader, reader));
            opened.process = process;
        }
        Ok(Arc::clone(&opened.reader))
    }

    fn open_reader(&self, py: Python<'_>) -> PyResult<Arc<dyn Reader>> {
        detached(py, || self.reader()).map_err(to_py_err)
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
    /// Opens a dataset by path, URI or name. With the [`Dataset::mark`] of a dataset that was opened before, it must be that one.
    #[new]
    fn new(py: Python<'_>, path: String, format: Option<String>, mark: Option<&str>) -> PyResult<Self> {
        let open: Open = Arc::new(move || {
            let location = home::find_dataset(&path)?;
            match &format {
                Some(format) => FORMATS.get(format)?.open(&location),
                None => swm::data::open(location),
            }
        });
        let known: Option<Mark> = mark.map(serde_json::from_str).transpose().map_err(invalid_mark)?;
        let opened = detached(py, || {
            let reader = open()?;
            // Other columns of a dataset with damaged rows can be read.
            let mark =
                known.map_or_else(|| Ok(Mark::of(&*reader).ok()), |mark| mark.check(&*reader).map(|()| Some(mark)))?;
            Ok((reader, mark))
        });
        let (reader, mark) = opened.map_err(to_py_err)?;
        Ok(Self::with(reader, open, mark))
    }

    /// The mark by which another process recognises the dataset, as JSON.
    fn mark(&self) -> PyResult<Option<String>> {
        self.mark.as_ref().map(serde_json::to_string).transpose().map_err(invalid_mark)
    }

    /// A dataset read by a Python object: see [`ForeignReader`].
    #[staticmethod]
    fn foreign(py: Python<'_>, reader: Py<PyAny>) -> PyResult<Self> {
        let reader: Arc<dyn Reader> = Arc::new(ForeignReader::new(py, reader)?);
        Self::of(py, Arc::new(move || Ok(Arc::clone(&reader))))
    }

    /// The episodes of several datasets, one after another.
    #[staticmethod]
    fn concat(py: Python<'_>, parts: Vec<Py<Self>>) -> PyResult<Self> {
        let parts = Held::new(parts);
        let open = move || views::concat(parts.iter().map(|part| part.get().reader()).collect::<Result<_>>()?);
        Self::of(py, Arc::new(open))
    }

    /// A dataset extended by columns of another dataset with the same episodes.
    #[staticmethod]
    fn merge(py: Python<'_>, base: Py<Self>, other: Py<Self>, names: Vec<String>) -> PyResult<Self> {
        let (base, other) = (Held::new(base), Held::new(other));
        let open = move || {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            views::merge(base.get().reader()?, other.get().reader()?, &names)
        };
        Self::of(py, Arc::new(open))
    }

    /// A view of some columns of the dataset, preceded by the index columns.
    fn select(slf: Py<Self>, py: Python<'_>, names: Vec<String>) -> PyResult<Self> {
        let slf = Held::new(slf);
        let open = move || {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            views::select(slf.get().reader()?, &names)
        };
        Self::of(py, Arc::new(open))
    }

    /// A view of the dataset that caches decoded rows of some columns in memory, up to `bytes` bytes.
    fn cached(slf: Py<Self>, py: Python<'_>, names: Vec<String>, bytes: usize) -> PyResult<Self> {
        let slf = Held::new(slf);
        let open = move || {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            CacheConfig::Memory { bytes }.over(slf.get().reader()?, &names)
        };
        Self::of(py, Arc::new(open))
    }

    /// The columns: name, type and shape of a row.
    fn schema(&self, py: Python<'_>) -> PyResult<Vec<Column>> {
        Ok(described(self.open_reader(py)?.schema()))
    }

    /// The number of rows of every episode, `[episodes]`.
    fn lengths<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let reader = self.open_reader(py)?;
        Ok(PyArray1::from_iter(py, reader.episodes().iter().map(|episode| episode.length as i64)))
    }

    /// The index of every episode, `[episodes]`.
    fn episode_indices<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<i64>>> {
        let reader = self.open_reader(py)?;
        Ok(PyArray1::from_iter(py, reader.episodes().iter().map(|episode| episode.index)))
    }

    /// The manifest (provenance) of the dataset as JSON, if it has one.
    fn manifest(&self, py: Python<'_>) -> PyResult<Option<String>> {
        let manifest = self.open_reader(py)?.manifest();
        let text = manifest.map(|manifest| serde_json::to_string(&manifest)).transpose();
        text.map_err(|error| to_py_err(Error::external("writing a manifest", error)))
    }

    /// The constants of an episode, by name.
    fn constants<'py>(&self, py: Python<'py>, episode: usize) -> PyResult<Bound<'py, PyDict>> {
        let constants = detached(py, || self.reader()?.constants(episode)).map_err(to_py_err)?;
        let dict = PyDict::new(py);
        for (name, bytes) in constants {
            dict.set_item(name, PyBytes::new(py, &bytes))?;
        }
        Ok(dict)
    }

    /// Reads the rows `starts[i] .. starts[i] + lengths[i]` of `episodes[i]` for all `i` (runs) in one pass, and
    /// concatenates them. The `action` column has all rows of a run; other columns have every `frameskip`-th row, from
    /// the first row of the run on.
    ///
    /// # Shapes
    /// `episodes`, `starts`, `lengths`: `[runs]`; each column: `[rows, ..]`.
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
                "read: expected frameskip >= 1 and arrays of episodes, starts and lengths of the same length",
            ));
        }
        let mut runs = Vec::with_capacity(episodes.len());
        for ((&episode, &start), &length) in episodes.iter().zip(starts).zip(lengths) {
            let (Ok(episode), Ok(start), Ok(length)) =
                (usize::try_from(episode), usize::try_from(start), usize::try_from(length))
            else {
                return Err(PyIndexError::new_err(format!(
                    "read: got {length} rows from row {start} of episode {episode}, expected no negative values"
                )));
            };
            runs.push(StepRange::new(episode, start, length));
        }
        let batch = detached(py, || read(&*self.reader()?, &names, &runs, frameskip)).map_err(to_py_err)?;
        // The columns differ in their number of rows, so each column is a separate batch.
        let dict = PyDict::new(py);
        for column in batch {
            dict.update(columns(py, BatchMemory::Owned(column))?.as_mapping())?;
        }
        Ok(dict)
    }
}

fn invalid_mark(error: serde_json::Error) -> PyErr {
    PyValueError::new_err(format!("the mark of a dataset: {error}"))
}

/// Reads each column as one batch: all rows of `action`, every `frameskip`-th row of other columns.
fn read(reader: &dyn Reader, names: &[String], runs: &[StepRange], frameskip: usize) -> Result<Vec<Batch>> {
    // Before memory for the rows is reserved.
    for run in runs {
        let rows = reader.episodes().get(run.episode).map_or(0, |episode| episode.length);
        if run.start.checked_add(run.length).is_none_or(|end| end > rows) {
            let given = format!("{} rows from row {} of episode {}", run.length, run.start, run.episode);
            return Err(Error::mismatch("reading rows", given, format!("rows of its {rows}")));
        }
    }
    let skipped: Vec<StepRange> = match frameskip {
        1 => vec![],
        _ => runs
            .iter()
            .flat_map(|run| (0..run.length).step_by(frameskip).map(|at| StepRange::new(run.episode, run.start + at, 1)))
            .collect(),
    };
    let read_one = |name: &String| {
        let runs = if name == ACTION || frameskip == 1 { runs } else { &skipped };
        let spec: ColumnSpec = reader.schema().column(name)?.clone();
        let mut batch = Batch::zeros(&Schema::new([spec])?, runs.iter().map(|run| run.length).sum());
        reader.read_column(name, runs, batch.bytes_mut(0))?;
        Ok(batch)
    };
    names.iter().map(read_one).collect()
}
