//! Support for forked processes, such as the workers of a torch `DataLoader`. A forked process has the memory of its parent
//! and none of its threads, so waiting for a thread of the parent never returns. Forked processes therefore open datasets
//! again and run the engine on one thread of their own (one, because there are usually several such processes).

use pyo3::prelude::*;
use std::sync::{Mutex, OnceLock, PoisonError};
use swm::core::{Error, Result};

static FIRST: OnceLock<u32> = OnceLock::new();

/// Records the id of the process that loads the engine and owns its threads.
pub fn record_process() {
    FIRST.get_or_init(std::process::id);
}

/// Whether this process was forked from the process that loaded the engine.
pub fn is_forked() -> bool {
    *FIRST.get_or_init(std::process::id) != std::process::id()
}

/// Runs `work` without the GIL; in a forked process, on the thread pool of that process.
///
/// # Errors
/// The error of `work`, or a failure to start the thread of a forked process.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    py.detach(|| if is_forked() { forked_pool()?.install(work) } else { work() })
}

/// The thread pool of this forked process, leaked because it lives until the process ends.
fn forked_pool() -> Result<&'static rayon::ThreadPool> {
    static THREADS: Mutex<Option<(u32, &'static rayon::ThreadPool)>> = Mutex::new(None);
    let mut made = THREADS.lock().unwrap_or_else(PoisonError::into_inner);
    let process = std::process::id();
    if let Some((owner, threads)) = *made
        && owner == process
    {
        return Ok(threads);
    }
    let threads = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let threads = threads.map_err(|error| Error::external("starting the thread of a forked process", error))?;
    let threads = &*Box::leak(Box::new(threads));
    *made = Some((process, threads));
    Ok(threads)
}
