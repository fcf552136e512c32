//! [`Loader`]: shuffled batches, prefetched by threads of the engine.

use super::dataset::Dataset;
use super::process::{detached, is_forked};
use super::{BatchMemory, Column, columns, described};
use crate::errors::{json, signal_poll, to_py_err};
use crate::exit;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;
use swm::core::{Error, Result};
use swm::data::{BatchSlice, CacheConfig, ClipSpec, GoalSpec, LoaderConfig};

/// The settings of a loader, from JSON.
#[derive(Deserialize)]
struct Options {
    num_steps: usize,
    frameskip: usize,
    columns: Vec<String>,
    goals: Vec<GoalSpec>,
    batch_size: usize,
    shuffle: bool,
    seed: u64,
    drop_last: bool,
    /// The rank of this process, and the number of processes.
    rank: usize,
    ranks: usize,
    threads: usize,
    prefetch: usize,
    prefetch_bytes: usize,
    episodes: Option<Vec<usize>>,
    /// Size of the cache of decoded rows in bytes; 0 disables it.
    cache: usize,
    /// The folder of a cache on disk; `None` selects a cache in memory.
    cache_dir: Option<PathBuf>,
}

impl Options {
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
            // A forked process loads in the calling thread: see `process`.
            threads: if is_forked() { 0 } else { self.threads },
            prefetch: self.prefetch,
            prefetch_bytes: self.prefetch_bytes,
            episodes: self.episodes,
            drop_last: self.drop_last,
            slice: BatchSlice { rank: self.rank, ranks: self.ranks },
            cache,
        }
    }
}

/// An object that owns threads. Dropping the object releases the GIL, because the threads may wait for it, and ends the
/// threads. A forked process leaks the object, because that process does not have the threads.
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

    /// Calls `work` with the inner object.
    ///
    /// # Errors
    /// The error of `work`; an error if the object belongs to another process, or if its threads have ended.
    fn with<R>(&self, work: impl FnOnce(&mut T) -> Result<R>) -> Result<R> {
        if self.process != std::process::id() {
            let problem = "it was created before this process was forked";
            return Err(Error::config("loader", problem, "create it in the process that uses it"));
        }
        match &mut *lock(&self.inner) {
            Some(inner) => work(inner),
            None if exit::is_over() => Err(exit::end_of_thread()),
            None => Err(Error::config(
                "loader",
                "its threads ended when the interpreter shut down",
                "use it before the interpreter exits",
            )),
        }
    }
}

impl<T: Send> Drop for Threaded<T> {
    fn drop(&mut self) {
        if self.process == std::process::id() {
            // At the end of the interpreter, the threads have ended already.
            Python::try_attach(|py| py.detach(|| self.inner.end()));
        } else {
            std::mem::forget(Arc::clone(&self.inner));
        }
    }
}

/// All objects with running threads.
static LIVE: Mutex<Vec<Weak<dyn End>>> = Mutex::new(vec![]);

/// Ends the threads of an object.
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

/// Ends the threads of all loaders. Python calls this function before the interpreter shuts down, because a thread that
/// takes the GIL during the shutdown crashes the process.
#[pyfunction]
pub fn end_loaders(py: Python<'_>) {
    if !is_forked() {
        exit::begin_end();
        py.detach(|| {
            let live: Vec<_> = lock(&LIVE).drain(..).collect();
            live.iter().filter_map(Weak::upgrade).for_each(|loader| loader.end());
        });
    }
}

/// Loads batches of clips, epoch by epoch.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Loader(Threaded<swm::data::Loader>);

/// An iterator over the remaining batches of one epoch.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Epoch(Threaded<swm::data::Epoch>);

#[pymethods]
impl Loader {
    #[new]
    fn new(py: Python<'_>, dataset: &Dataset, config: &str) -> PyResult<Self> {
        let config = json::<Options>("loader", config)?.config();
        let made = detached(py, || swm::data::Loader::new(dataset.reader()?, config));
        made.map(|loader| Self(Threaded::new(loader))).map_err(to_py_err)
    }

    /// The columns of a batch: name, type and shape of a row.
    fn schema(&self) -> PyResult<Vec<Column>> {
        self.0.with(|loader| Ok(described(loader.schema()))).map_err(to_py_err)
    }

    /// The number of clips in an epoch.
    fn clips(&self) -> PyResult<usize> {
        self.0.with(|loader| Ok(loader.clips())).map_err(to_py_err)
    }

    /// The number of batches in an epoch.
    fn batches(&self) -> PyResult<usize> {
        self.0.with(|loader| Ok(loader.batches_per_epoch())).map_err(to_py_err)
    }

    /// The batches of an epoch, from batch `first` on.
    fn epoch(&self, py: Python<'_>, epoch: u64, first: usize) -> PyResult<Epoch> {
        let begun = exit::detached(py, || self.0.with(|loader| Ok(loader.epoch(epoch, first))));
        Ok(Epoch(Threaded::new(begun.map_err(to_py_err)?)))
    }
}

#[pymethods]
impl Epoch {
    /// The next batch as arrays `[clips, ..]` that share its memory; `None` at the end of the epoch.
    fn next<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let next = detached(py, || {
            self.0.with(|epoch| {
                let mut poll = signal_poll();
                while !epoch.wait(Duration::from_millis(20)) {
                    poll()?;
                }
                epoch.next().transpose()
            })
        });
        next.map_err(to_py_err)?.map(|batch| columns(py, BatchMemory::Loaded(batch))).transpose()
    }
}
