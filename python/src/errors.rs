//! Conversion between engine errors and Python exceptions; Python's signals and progress in the engine's loops.

use crate::exit::{self, is_over};
use crate::held::Held;
use crate::warnings;
use pyo3::exceptions::{PyFileNotFoundError, PyKeyboardInterrupt, PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use swm::core::Error;
use swm::core::run::{Control, Event};
use swm::core::text::printable;

/// Converts an engine error to a Python exception. Returns an exception that passed through the engine unchanged.
pub fn to_py_err(error: Error) -> PyErr {
    // Names in files of strangers could control a terminal.
    let message = printable(&error.to_string()).into_owned();
    match error {
        Error::Embedder(inner) => match inner.downcast::<Held<PyErr>>() {
            Ok(original) => original.into_inner(),
            Err(_) => PyRuntimeError::new_err(message),
        },
        Error::Interrupted => PyKeyboardInterrupt::new_err(message),
        Error::UnknownName { kind: "dataset" | "checkpoint" | "capsule", .. } => PyFileNotFoundError::new_err(message),
        // Python derives FileNotFoundError, PermissionError, … from the operating system's error number.
        Error::Io { source, path, .. } => match source.raw_os_error() {
            Some(number) => PyOSError::new_err((number, message, path.display().to_string())),
            None => PyOSError::new_err(message),
        },
        Error::Corrupt { .. } | Error::External { .. } => PyRuntimeError::new_err(message),
        _ => PyValueError::new_err(message),
    }
}

/// Wraps a Python exception in an engine error, so that [`to_py_err`] can return it unchanged.
pub fn from_py_err(error: PyErr) -> Error {
    Error::Embedder(Box::new(Held::new(error)))
}

/// Runs `work` in Python, for a thread of the engine. While the interpreter shuts down, there is nothing to call, and the thread is told
/// to stop.
pub fn attached<T>(work: impl FnOnce(Python<'_>) -> PyResult<T>) -> swm::core::Result<T> {
    if is_over() {
        return Err(Error::Interrupted);
    }
    Python::try_attach(work).map_or(Err(Error::Interrupted), |outcome| outcome.map_err(from_py_err))
}

/// Creates a poll function for long loops. The function runs Python's signal handlers at most every 20 ms, so that
/// Ctrl-C raises `KeyboardInterrupt`, and issues the warnings of the engine.
pub fn signal_poll() -> impl FnMut() -> swm::core::Result<()> {
    let mut last = Instant::now();
    move || {
        if is_over() {
            return Err(Error::Interrupted);
        }
        if last.elapsed() < Duration::from_millis(20) {
            return Ok(());
        }
        last = Instant::now();
        attached(|py| {
            warnings::issue(py)?;
            py.check_signals()
        })
    }
}

/// Parses JSON. `what` names the text in the error.
///
/// # Errors
/// `ValueError` if the text is not JSON of this type.
pub fn json<T: serde::de::DeserializeOwned>(what: &str, text: &str) -> PyResult<T> {
    serde_json::from_str(text)
        .map_err(|error| PyValueError::new_err(printable(&format!("{what}: {error}")).into_owned()))
}

/// Creates a run control that runs Python's signal handlers and calls `progress(done, total, steps)` at most ten times
/// a second. An exception from either stops the run.
pub fn control<'a>(progress: Option<Py<PyAny>>) -> Control<'a> {
    let failed = Arc::new(Mutex::new(None));
    let callback_error = Arc::clone(&failed);
    let mut poll = signal_poll();
    let control =
        Control::new().with_poll(move || match failed.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(error) => Err(error),
            None => poll(),
        });
    let Some(call) = progress.map(Held::new) else { return control };
    let mut last: Option<Instant> = None;
    control.with_events(move |event| {
        let Event::Progress(at) = event else { return };
        if !at.is_done() && last.is_some_and(|last| last.elapsed() < Duration::from_millis(100)) {
            return;
        }
        last = Some(Instant::now());
        let steps = at.metric("steps").unwrap_or_default() as usize;
        let outcome = Python::try_attach(|py| exit::call(call.bind(py), (at.done, at.total, steps)).map(drop));
        if let Some(Err(error)) = outcome {
            let error = from_py_err(error);
            callback_error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
    })
}
