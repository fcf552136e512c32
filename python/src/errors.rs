//! Conversion between engine errors and Python exceptions, and Python's signals in the engine's loops.

use pyo3::exceptions::{PyFileNotFoundError, PyKeyboardInterrupt, PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use std::time::{Duration, Instant};
use swm::core::Error;

/// Converts an engine error to a Python exception. Returns an exception that passed through the engine unchanged.
pub fn to_py_err(error: Error) -> PyErr {
    let message = error.to_string();
    match error {
        Error::Embedder(inner) => match inner.downcast::<PyErr>() {
            Ok(original) => *original,
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
    Error::Embedder(Box::new(error))
}

/// Creates a poll function for long loops. The function runs Python's signal handlers at most every 20 ms, so that
/// Ctrl-C raises `KeyboardInterrupt`.
pub fn signal_poll() -> impl FnMut() -> swm::core::Result<()> {
    let mut last = Instant::now();
    move || {
        if last.elapsed() < Duration::from_millis(20) {
            return Ok(());
        }
        last = Instant::now();
        Python::attach(|py| py.check_signals()).map_err(from_py_err)
    }
}

/// Parses JSON. `what` names the text in the error.
///
/// # Errors
/// `ValueError` if the text is not JSON of this type.
pub fn json<T: serde::de::DeserializeOwned>(what: &str, text: &str) -> PyResult<T> {
    serde_json::from_str(text).map_err(|error| PyValueError::new_err(format!("{what}: {error}")))
}
