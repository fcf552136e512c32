//! The end of the interpreter. A thread that takes the GIL afterwards is ended by Python, in the middle of the engine, which aborts the
//! process. So the calls of the engine in other threads are stopped before, and new ones end their threads.

use crate::data::process::is_forked;
use crate::errors::from_py_err;
use pyo3::exceptions::PySystemExit;
use pyo3::prelude::*;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::{self, ThreadId};
use std::time::{Duration, Instant};
use swm::core::{Error, Result};

/// How long the interpreter waits for calls of the engine in other threads.
const PATIENCE: Duration = Duration::from_secs(5);

/// The number of calls of the engine that run or that call Python.
static CALLS: AtomicUsize = AtomicUsize::new(0);
/// The thread that ends the interpreter.
static ENDED_BY: OnceLock<ThreadId> = OnceLock::new();

/// A call of the engine, which the end of the interpreter waits for: where the engine calls Python while it has the GIL, or releases it.
#[must_use = "the call ends when this is dropped"]
pub struct Call;

impl Call {
    /// Begins a call.
    pub fn begin() -> Self {
        CALLS.fetch_add(1, Ordering::SeqCst);
        Self
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        CALLS.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Whether the interpreter ends while this thread is another than the one that ends it.
pub fn is_over() -> bool {
    ENDED_BY.get().is_some_and(|by| *by != thread::current().id())
}

/// The error that ends a thread silently: `SystemExit`.
pub fn end_of_thread() -> Error {
    from_py_err(PySystemExit::new_err(()))
}

/// Runs `work` without the GIL.
///
/// # Errors
/// The error of `work`; `SystemExit`, which ends a thread silently, if the interpreter ends meanwhile.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    let call = Call::begin();
    let outcome = if is_over() { None } else { Some(py.detach(work)) };
    drop(call);
    match outcome {
        Some(outcome) if !is_over() => outcome,
        _ => Err(end_of_thread()),
    }
}

/// Notes that this thread ends the interpreter.
pub fn begin_end() {
    ENDED_BY.get_or_init(|| thread::current().id());
}

/// Stops the calls of the engine in other threads and waits for their end. Python calls this function before the interpreter
/// shuts down.
#[pyfunction]
pub fn end_calls(py: Python<'_>) {
    if is_forked() {
        return;
    }
    begin_end();
    let begun = Instant::now();
    py.detach(|| {
        while CALLS.load(Ordering::SeqCst) > 0 && begun.elapsed() < PATIENCE {
            thread::sleep(Duration::from_millis(1));
        }
    });
}
