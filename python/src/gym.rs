//! [`InProcess`]: Gymnasium environments in this very interpreter, through the bridge that worker processes use.

use crate::errors::foreign;
use pyo3::prelude::*;
use pyo3::types::{PyByteArray, PyBytes, PyModule};
use swm::gym::{BRIDGE, CRAFTAX, Description, Failure, Request, Transport};

/// The way to an environment of this interpreter.
pub struct InProcess {
    /// Makes the environment: takes nothing, returns a `Bridge`.
    make: Py<PyAny>,
    bridge: Option<Py<PyAny>>,
    /// What the bridge writes into. Its views keep it from being resized.
    memory: Option<Py<PyByteArray>>,
}

impl InProcess {
    /// The way to what `make` makes.
    pub fn new(make: Py<PyAny>) -> Self {
        Self { make, bridge: None, memory: None }
    }
}

/// Whatever Python raised goes back to it as it is: asking again would raise it again.
fn refused(error: PyErr) -> Failure {
    Failure::Refused(foreign(error))
}

impl Transport for InProcess {
    fn restart(&mut self) -> Result<(), Failure> {
        (self.bridge, self.memory) = (None, None);
        Ok(())
    }

    fn describe(&mut self) -> Result<Description, Failure> {
        Python::attach(|py| {
            let bridge = self.make.bind(py).call0().map_err(refused)?;
            let text: String = bridge.call_method0("describe").and_then(|text| text.extract()).map_err(refused)?;
            let description = Description::parse(&text).map_err(Failure::Refused)?;
            let memory = PyByteArray::new(py, &vec![0; description.size]);
            bridge.call_method1("attach", (&memory,)).map_err(refused)?;
            self.bridge = Some(bridge.unbind());
            self.memory = Some(memory.unbind());
            Ok(description)
        })
    }

    fn call(&mut self, request: Request<'_>) -> Result<(), Failure> {
        Python::attach(|py| {
            let Some(bridge) = &self.bridge else { return Err(Failure::Lost("it was not made yet".to_owned())) };
            let payload = PyBytes::new(py, request.payload());
            bridge.bind(py).call_method1("handle", (request.op(), payload)).map(drop).map_err(refused)
        })
    }

    fn memory(&self) -> &[u8] {
        let Some(memory) = &self.memory else { return &[] };
        // SAFETY: the array is ours and the bridge's, whose views forbid a change of its size. The bridge writes only inside
        // of `call`, which borrows this exclusively.
        #[allow(unsafe_code)]
        Python::attach(|py| unsafe {
            let memory = memory.bind(py);
            std::slice::from_raw_parts(memory.data(), memory.len())
        })
    }

    fn memory_mut(&mut self) -> &mut [u8] {
        let Some(memory) = &self.memory else { return &mut [] };
        // SAFETY: as above; this is borrowed exclusively.
        #[allow(unsafe_code)]
        Python::attach(|py| unsafe {
            let memory = memory.bind(py);
            std::slice::from_raw_parts_mut(memory.data(), memory.len())
        })
    }
}

/// The module with the class `Bridge`, loaded once. With `craftax`, `swm_craftax` becomes importable: it needs JAX.
#[pyfunction]
pub fn bridge(py: Python<'_>, craftax: bool) -> PyResult<Bound<'_, PyModule>> {
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
