//! Support for forked processes, such as the workers of a torch `DataLoader`.
//!
//! A forked process has the memory of its parent but not the parent's threads, so waiting for such a thread never
//! ends. A forked process therefore opens datasets again, and runs the engine on one new thread. One thread is
//! enough, because several forked processes usually run in parallel.

use crate::exit;
use pyo3::prelude::*;
use std::sync::{Mutex, OnceLock, PoisonError};
use swm::core::{Error, Result};

/// The id of the process that loaded the engine.
static LOADING_PROCESS: OnceLock<u32> = OnceLock::new();

/// Records the id of the process that loads the engine and owns its threads.
pub fn record_process() {
    LOADING_PROCESS.get_or_init(std::process::id);
}

/// Whether this process was forked from the process that loaded the engine.
pub fn is_forked() -> bool {
    *LOADING_PROCESS.get_or_init(std::process::id) != std::process::id()
}

/// A value with threads, files or locks of the process that made it. A forked process can neither use the value nor drop it,
/// because it does not have the threads and would write to the same files: there, the value is leaked.
pub struct Owned<T> {
    /// `None` while it is dropped only.
    value: Option<T>,
    process: u32,
}

impl<T> Owned<T> {
    /// Makes this process the owner of a value.
    pub fn new(value: T) -> Self {
        Self { value: Some(value), process: std::process::id() }
    }

    /// Returns the value; `what` names it in errors.
    ///
    /// # Errors
    /// In a process that was forked after the value was made.
    pub fn get(&self, what: &str) -> Result<&T> {
        match &self.value {
            Some(value) if self.process == std::process::id() => Ok(value),
            _ => {
                let problem = "it was created before this process was forked";
                Err(Error::config(what, problem, "create it in the process that uses it"))
            }
        }
    }
}

impl<T> Drop for Owned<T> {
    fn drop(&mut self) {
        if self.process != std::process::id() {
            std::mem::forget(self.value.take());
        }
    }
}

/// Runs `work` without the GIL; in a forked process, on the thread pool of that process.
///
/// # Errors
/// The error of `work`, or a failure to start the thread of a forked process.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    in_pool(py, work)?
}

/// As [`detached`], for work with errors of its own.
///
/// # Errors
/// A failure to start the thread of a forked process.
pub fn in_pool<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> Result<T> {
    exit::detached(py, || if is_forked() { Ok(forked_pool()?.install(work)) } else { Ok(work()) })
}

/// The thread pool of this forked process, leaked because it lives until the process ends.
fn forked_pool() -> Result<&'static rayon::ThreadPool> {
    static POOL: Mutex<Option<(u32, &'static rayon::ThreadPool)>> = Mutex::new(None);
    let mut made = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    let process = std::process::id();
    if let Some((owner, pool)) = *made
        && owner == process
    {
        return Ok(pool);
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let pool = pool.map_err(|error| Error::external("starting the thread of a forked process", error))?;
    let pool = &*Box::leak(Box::new(pool));
    *made = Some((process, pool));
    Ok(pool)
}
