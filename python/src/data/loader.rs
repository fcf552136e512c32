//! [`Loader`]: shuffled batches, made ahead by threads of the engine.

use super::dataset::Dataset;
use super::process::{is_forked, work};
use super::{Column, Kept, columns, described};
use crate::errors::{json, raised, signals};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use swm::core::Result;
use swm::data::{CacheConfig, ClipSpec, GoalSpec, LoaderConfig};

/// What to load and how, from JSON.
#[derive(Deserialize)]
struct Wanted {
    num_steps: usize,
    frameskip: usize,
    columns: Vec<String>,
    goals: Vec<GoalSpec>,
    batch_size: usize,
    shuffle: bool,
    seed: u64,
    drop_last: bool,
    threads: usize,
    prefetch: usize,
    prefetch_bytes: usize,
    episodes: Option<Vec<usize>>,
    /// Bytes of decoded rows to keep.
    cache: usize,
    /// Where to keep them, if not in memory.
    cache_dir: Option<PathBuf>,
}

impl Wanted {
    fn config(self) -> LoaderConfig {
        let cache = match (self.cache, self.cache_dir) {
            (0, _) => CacheConfig::Off,
            (bytes, None) => CacheConfig::Memory { bytes },
            (bytes, Some(folder)) => CacheConfig::Disk { folder, bytes },
        };
        LoaderConfig {
            clip: ClipSpec { num_steps: self.num_steps, frameskip: self.frameskip, columns: self.columns },
            goals: self.goals,
            batch_size: self.batch_size,
            shuffle: self.shuffle,
            seed: self.seed,
            // A forked process loads in the thread that asks: see `process`.
            threads: if is_forked() { 0 } else { self.threads },
            prefetch: self.prefetch,
            prefetch_bytes: self.prefetch_bytes,
            episodes: self.episodes,
            drop_last: self.drop_last,
            cache,
        }
    }
}

/// Something with threads. They end where it goes; but they may wait for Python's lock, and a process forked since has
/// none of them.
struct Threaded<T: Send> {
    inner: Option<T>,
    process: u32,
}

impl<T: Send> Threaded<T> {
    fn new(inner: T) -> Self {
        Self { inner: Some(inner), process: std::process::id() }
    }

    /// It, unless its threads are another process's.
    fn here(&mut self) -> Result<&mut T> {
        let here = self.process == std::process::id();
        self.inner.as_mut().filter(|_| here).ok_or_else(|| {
            swm::core::Error::config(
                "loader",
                "it was made in the process that this one was forked from",
                "make it in the process that uses it",
            )
        })
    }
}

impl<T: Send> Drop for Threaded<T> {
    fn drop(&mut self) {
        let inner = self.inner.take();
        if self.process == std::process::id() {
            Python::attach(|py| py.detach(|| drop(inner)));
        } else {
            std::mem::forget(inner);
        }
    }
}

/// Batches of clips, epoch after epoch.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Loader(Mutex<Threaded<swm::data::Loader>>);

/// The batches of one epoch, from one on.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Epoch(Mutex<Threaded<swm::data::Epoch>>);

#[pymethods]
impl Loader {
    #[new]
    fn new(py: Python<'_>, dataset: &Dataset, config: &str) -> PyResult<Self> {
        let config = json::<Wanted>("loader", config)?.config();
        let made = work(py, || swm::data::Loader::new(dataset.reader()?, config));
        made.map(|loader| Self(Mutex::new(Threaded::new(loader)))).map_err(raised)
    }

    /// The columns of a batch.
    fn schema(&self) -> PyResult<Vec<Column>> {
        Ok(described(self.lock().here().map_err(raised)?.schema()))
    }

    /// Clips in an epoch.
    fn clips(&self) -> PyResult<usize> {
        Ok(self.lock().here().map_err(raised)?.clips())
    }

    /// Batches in an epoch.
    fn batches(&self) -> PyResult<usize> {
        Ok(self.lock().here().map_err(raised)?.batches_per_epoch())
    }

    /// The batches of an epoch, from `first` on.
    fn epoch(&self, py: Python<'_>, epoch: u64, first: usize) -> PyResult<Epoch> {
        let mut loader = self.lock();
        let loader = loader.here().map_err(raised)?;
        let begun = py.detach(|| loader.epoch(epoch, first));
        Ok(Epoch(Mutex::new(Threaded::new(begun))))
    }
}

impl Loader {
    fn lock(&self) -> std::sync::MutexGuard<'_, Threaded<swm::data::Loader>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[pymethods]
impl Epoch {
    /// The next batch, as arrays `[clips, ..]` that look at its memory; `None` where the epoch ends.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let next = work(py, || {
            let mut epoch = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let epoch = epoch.here()?;
            let mut signals = signals();
            while !epoch.wait(Duration::from_millis(20)) {
                signals()?;
            }
            epoch.next().transpose()
        });
        next.map_err(raised)?.map(|batch| columns(py, Kept::Lent(batch))).transpose()
    }
}
