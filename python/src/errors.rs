//! Our errors as Python's exceptions, and Python's signals in our loops.

use pyo3::exceptions::{PyFileNotFoundError, PyKeyboardInterrupt, PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use std::time::{Duration, Instant};
use swm::core::Error;

/// The exception that says what an error says. What Python raised comes back as it was raised.
pub fn raised(error: Error) -> PyErr {
    let message = error.to_string();
    match error {
        Error::Embedder(inner) => match inner.downcast::<PyErr>() {
            Ok(original) => *original,
            Err(_) => PyRuntimeError::new_err(message),
        },
        Error::Interrupted => PyKeyboardInterrupt::new_err(message),
        Error::UnknownName { kind: "dataset" | "checkpoint", .. } => PyFileNotFoundError::new_err(message),
        // The system's number makes Python choose FileNotFoundError, PermissionError and their like.
        Error::Io { source, path, .. } => match source.raw_os_error() {
            Some(number) => PyOSError::new_err((number, message, path.display().to_string())),
            None => PyOSError::new_err(message),
        },
        Error::Corrupt { .. } | Error::External { .. } => PyRuntimeError::new_err(message),
        _ => PyValueError::new_err(message),
    }
}

/// An exception on its way through the engine.
pub fn foreign(error: PyErr) -> Error {
    Error::Embedder(Box::new(error))
}

/// A poll for long loops: lets Python handle its signals, so that Ctrl-C raises `KeyboardInterrupt`, at most every twenty
/// milliseconds.
pub fn signals() -> impl FnMut() -> swm::core::Result<()> {
    let mut last = Instant::now();
    move || {
        if last.elapsed() < Duration::from_millis(20) {
            return Ok(());
        }
        last = Instant::now();
        Python::attach(|py| py.check_signals()).map_err(foreign)
    }
}

/// Text that should be JSON.
pub fn json<T: serde::de::DeserializeOwned>(what: &str, text: &str) -> PyResult<T> {
    serde_json::from_str(text).map_err(|error| PyValueError::new_err(format!("{what}: {error}")))
}
