//! [`Loader`]: shuffled batches, made ahead by threads of the engine.

use super::dataset::Dataset;
use super::process::{is_forked, work};
use super::{Column, Kept, columns, described};
use crate::errors::{json, raised, signals};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;
use swm::core::{Error, Result};
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
struct Threaded<T: Send + 'static> {
    inner: Arc<Mutex<Option<T>>>,
    process: u32,
}

impl<T: Send> Threaded<T> {
    fn new(inner: T) -> Self {
        let inner = Arc::new(Mutex::new(Some(inner)));
        let weak: Weak<Mutex<Option<T>>> = Arc::downgrade(&inner);
        let mut live = lock(&LIVE);
        live.retain(|other| other.strong_count() > 0);
        live.push(weak);
        Self { inner, process: std::process::id() }
    }

    /// Does something with it, if its threads are here.
    fn with<R>(&self, work: impl FnOnce(&mut T) -> Result<R>) -> Result<R> {
        if self.process != std::process::id() {
            let problem = "it was made in the process that this one was forked from";
            return Err(Error::config("loader", problem, "make it in the process that uses it"));
        }
        match &mut *lock(&self.inner) {
            Some(inner) => work(inner),
            None => Err(Error::config("loader", "it ended with the interpreter", "use it before")),
        }
    }
}

impl<T: Send> Drop for Threaded<T> {
    fn drop(&mut self) {
        if self.process == std::process::id() {
            Python::attach(|py| py.detach(|| self.inner.end()));
        } else {
            std::mem::forget(Arc::clone(&self.inner));
        }
    }
}

/// What has threads now.
static LIVE: Mutex<Vec<Weak<dyn End>>> = Mutex::new(vec![]);

/// Something whose threads can be ended.
trait End: Send + Sync {
    fn end(&self);
}

impl<T: Send> End for Mutex<Option<T>> {
    fn end(&self) {
        let inner = lock(self).take();
        drop(inner);
    }
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Ends the threads of all loaders. To be called while the interpreter is sound: a thread that asks for its lock when it is
/// not any more takes the process with it.
#[pyfunction]
pub fn end_loaders(py: Python<'_>) {
    if !is_forked() {
        py.detach(|| {
            let live: Vec<_> = lock(&LIVE).drain(..).collect();
            live.iter().filter_map(Weak::upgrade).for_each(|loader| loader.end());
        });
    }
}

/// Batches of clips, epoch after epoch.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Loader(Threaded<swm::data::Loader>);

/// The batches of one epoch, from one on.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Epoch(Threaded<swm::data::Epoch>);

#[pymethods]
impl Loader {
    #[new]
    fn new(py: Python<'_>, dataset: &Dataset, config: &str) -> PyResult<Self> {
        let config = json::<Wanted>("loader", config)?.config();
        let made = work(py, || swm::data::Loader::new(dataset.reader()?, config));
        made.map(|loader| Self(Threaded::new(loader))).map_err(raised)
    }

    /// The columns of a batch.
    fn schema(&self) -> PyResult<Vec<Column>> {
        self.0.with(|loader| Ok(described(loader.schema()))).map_err(raised)
    }

    /// Clips in an epoch.
    fn clips(&self) -> PyResult<usize> {
        self.0.with(|loader| Ok(loader.clips())).map_err(raised)
    }

    /// Batches in an epoch.
    fn batches(&self) -> PyResult<usize> {
        self.0.with(|loader| Ok(loader.batches_per_epoch())).map_err(raised)
    }

    /// The batches of an epoch, from `first` on.
    fn epoch(&self, py: Python<'_>, epoch: u64, first: usize) -> PyResult<Epoch> {
        let begun = py.detach(|| self.0.with(|loader| Ok(loader.epoch(epoch, first))));
        Ok(Epoch(Threaded::new(begun.map_err(raised)?)))
    }
}

#[pymethods]
impl Epoch {
    /// The next batch, as arrays `[clips, ..]` that look at its memory; `None` where the epoch ends.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let next = work(py, || {
            self.0.with(|epoch| {
                let mut signals = signals();
                while !epoch.wait(Duration::from_millis(20)) {
                    signals()?;
                }
                epoch.next().transpose()
            })
        });
        next.map_err(raised)?.map(|batch| columns(py, Kept::Lent(batch))).transpose()
    }
}
