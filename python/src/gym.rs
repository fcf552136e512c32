//! [`InProcess`]: Gymnasium environments in this interpreter, through the bridge that worker processes also use.

use crate::errors::from_py_err;
use crate::exit::{self, is_over};
use crate::held::Held;
use pyo3::prelude::*;
use pyo3::types::{PyByteArray, PyBytes, PyModule};
use std::cell::Cell;
use swm::core::Error;
use swm::gym::{BRIDGE, CRAFTAX, Description, Failure, Request, Transport};

/// A [`Transport`] to an environment in this interpreter.
pub struct InProcess {
    /// A callable without arguments that creates the environment and returns its `Bridge`.
    make: Held<Py<PyAny>>,
    bridge: Option<Held<Py<PyAny>>>,
    /// The memory that the bridge reads and writes. The bridge's memory views prevent a resize.
    memory: Option<Memory>,
}

impl InProcess {
    /// Creates a transport to the environment that `make` creates.
    pub fn new(make: Py<PyAny>) -> Self {
        Self { make: Held::new(make), bridge: None, memory: None }
    }
}

thread_local! {
    /// The number of calls of environments that run on this thread, each inside the one before it.
    static CALLS: Cell<usize> = const { Cell::new(0) };
}

/// Whether this thread runs an environment. No other thread can run one then: environments of one process run one at a
/// time.
pub fn is_in_call() -> bool {
    CALLS.get() > 0
}

/// Counts a call of an environment.
struct Call;

impl Call {
    fn begin() -> Self {
        CALLS.set(CALLS.get() + 1);
        Self
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        CALLS.set(CALLS.get() - 1);
    }
}

/// The memory of a byte array, which the engine reads and writes without the GIL.
struct Memory {
    /// The address of the first byte.
    address: usize,
    size: usize,
    _owner: Held<Py<PyByteArray>>,
}

/// Converts a Python exception to a failure that is not retried, because a retry would raise the exception again.
fn refused(error: PyErr) -> Failure {
    Failure::Refused(from_py_err(error))
}

/// Runs `work` in Python, unless the interpreter ends.
fn in_python<T>(work: impl FnOnce(Python<'_>) -> Result<T, Failure>) -> Result<T, Failure> {
    let ended = || Err(Failure::Refused(Error::Interrupted));
    if is_over() { ended() } else { Python::try_attach(work).unwrap_or_else(ended) }
}

impl Transport for InProcess {
    fn restart(&mut self) -> Result<(), Failure> {
        (self.bridge, self.memory) = (None, None);
        Ok(())
    }

    fn describe(&mut self) -> Result<Description, Failure> {
        in_python(|py| {
            let bridge = exit::call(self.make.bind(py), ()).map_err(refused)?;
            let text: String =
                exit::call_method(&bridge, "describe", ()).and_then(|text| text.extract()).map_err(refused)?;
            let description = Description::parse(&text).map_err(Failure::Refused)?;
            let memory = PyByteArray::new(py, &vec![0; description.size]);
            exit::call_method(&bridge, "attach", (&memory,)).map_err(refused)?;
            self.bridge = Some(Held::new(bridge.unbind()));
            let address = memory.data().expose_provenance();
            self.memory = Some(Memory { address, size: memory.len(), _owner: Held::new(memory.unbind()) });
            Ok(description)
        })
    }

    fn call(&mut self, request: Request<'_>) -> Result<(), Failure> {
        in_python(|py| {
            let Some(bridge) = &self.bridge else {
                return Err(Failure::Lost("the environment was not described yet".to_owned()));
            };
            let payload = PyBytes::new(py, request.payload());
            let _call = Call::begin();
            exit::call_method(bridge.bind(py), "handle", (request.op(), payload)).map(drop).map_err(refused)
        })
    }

    fn memory(&self) -> &[u8] {
        let Some(Memory { address, size, .. }) = &self.memory else { return &[] };
        // SAFETY: only this object and the bridge hold the byte array, and the bridge's memory views prevent a resize.
        // The bridge writes only during `call`, which borrows `self` exclusively.
        #[allow(unsafe_code, reason = "the bridge shares its memory with the engine")]
        unsafe {
            std::slice::from_raw_parts(std::ptr::with_exposed_provenance(*address), *size)
        }
    }

    fn memory_mut(&mut self) -> &mut [u8] {
        let Some(Memory { address, size, .. }) = &self.memory else { return &mut [] };
        // SAFETY: as in `memory`; `self` is borrowed exclusively.
        #[allow(unsafe_code, reason = "the bridge shares its memory with the engine")]
        unsafe {
            std::slice::from_raw_parts_mut(std::ptr::with_exposed_provenance_mut(*address), *size)
        }
    }
}

/// Returns the Python module with the class `Bridge`, which is loaded once. If `craftax` is set, also loads
/// `swm_craftax`, which needs JAX.
#[pyfunction]
pub fn bridge(py: Python<'_>, craftax: bool) -> PyResult<Bound<'_, PyModule>> {
    let _call = exit::Call::begin();
    let modules = py.import("sys")?.getattr("modules")?;
    let load = |source: &str, name: &str| -> PyResult<Bound<'_, PyModule>> {
        if let Ok(known) = modules.get_item(name) {
            return Ok(known.cast_into()?);
        }
        let text = |text: &str| {
            std::ffi::CString::new(text).map_err(|e| pyo3::exceptions::PyValueError::new_err(e.to_string()))
        };
        let module = PyModule::from_code(py, &text(source)?, &text(&format!("<{name}>"))?, &text(name)?)?;
        modules.set_item(name, &module)?;
        Ok(module)
    };
    if craftax {
        load(CRAFTAX, "swm_craftax")?;
    }
    load(BRIDGE, "swm_bridge")
}
