//! Forked processes, such as a torch `DataLoader`'s workers: they have the memory of their parent and none of its threads.
//! Whoever waits for one of those waits for ever. So they open datasets again, and work on a thread of their own; one, as
//! there are several such processes.

use pyo3::prelude::*;
use std::sync::{Mutex, OnceLock, PoisonError};
use swm::core::{Error, Result};

static FIRST: OnceLock<u32> = OnceLock::new();

/// Notes which process has the threads of the engine: the one that loads it.
pub fn begin() {
    FIRST.get_or_init(std::process::id);
}

/// Whether this process was forked from the one that loaded the engine.
pub fn is_forked() -> bool {
    *FIRST.get_or_init(std::process::id) != std::process::id()
}

/// Does something without holding Python's lock, on threads that are there.
///
/// # Errors
/// Its own, or when the system has no threads left.
pub fn work<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    py.detach(|| if is_forked() { own_threads()?.install(work) } else { work() })
}

/// The threads of this forked process. They are never ended.
fn own_threads() -> Result<&'static rayon::ThreadPool> {
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
