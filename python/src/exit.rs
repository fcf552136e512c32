//! The end of the interpreter. Python before 3.14 ends a thread that takes the GIL afterwards by unwinding its stack, which aborts the
//! process where the unwinding meets the engine. So the calls of the engine in other threads are stopped before, new ones end their
//! threads, and a thread that Python unwinds out of a user's code stops at [`call`].

use crate::errors::from_py_err;
use crate::warnings;
use pyo3::exceptions::PySystemExit;
use pyo3::ffi::PyObject;
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use std::cell::Cell;
use std::marker::PhantomData;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::{self, ThreadId};
use std::time::{Duration, Instant};
use swm::core::{Error, Result};

/// How long the interpreter waits for calls of the engine in other threads.
const PATIENCE: Duration = Duration::from_secs(5);

/// The number of calls of the engine that run or that call Python.
static CALLS: AtomicUsize = AtomicUsize::new(0);
thread_local! {
    /// Those of this thread.
    static CALLS_HERE: Cell<usize> = const { Cell::new(0) };
}
/// The thread that ends the interpreter.
static ENDED_BY: OnceLock<ThreadId> = OnceLock::new();

/// A call of the engine, which the end of the interpreter waits for: where the engine calls Python while it has the GIL, or releases it.
/// It ends in the thread in which it began.
#[must_use = "the call ends when this is dropped"]
pub struct Call(PhantomData<*const ()>);

impl Call {
    /// Begins a call.
    pub fn begin() -> Self {
        CALLS.fetch_add(1, Ordering::SeqCst);
        CALLS_HERE.set(CALLS_HERE.get() + 1);
        Self(PhantomData)
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        CALLS.fetch_sub(1, Ordering::SeqCst);
        CALLS_HERE.set(CALLS_HERE.get() - 1);
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

/// Runs `work` without the GIL, then issues the warnings of the engine.
///
/// # Errors
/// The error of `work`; a warning that Python turns into an error; `SystemExit`, which ends a thread silently, if the interpreter ends meanwhile.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    let call = Call::begin();
    let outcome = if is_over() { None } else { Some(py.detach(work)) };
    let warned = if is_over() { Ok(()) } else { warnings::issue(py) };
    drop(call);
    match outcome {
        Some(outcome) if !is_over() => outcome.and_then(|value| warned.map(|()| value).map_err(from_py_err)),
        _ => Err(end_of_thread()),
    }
}

/// Notes that this thread ends the interpreter.
pub fn begin_end() {
    ENDED_BY.get_or_init(|| thread::current().id());
}

/// Stops the calls of the engine in other threads and waits for their end. Python calls this function before the interpreter
/// shuts down (`stable_worldmodel/_exit.py`).
#[pyfunction]
pub fn end_calls(py: Python<'_>) {
    begin_end();
    let begun = Instant::now();
    py.detach(|| {
        while CALLS.load(Ordering::SeqCst) > 0 && begun.elapsed() < PATIENCE {
            thread::sleep(Duration::from_millis(1));
        }
    });
    warnings::issue_or_print(py);
}

/// Forgets the calls of other threads, which a forked process does not have, and the warnings of the process before. Python calls this function after a fork.
#[pyfunction]
pub fn forget_calls() {
    drop(warnings::take());
    CALLS.store(CALLS_HERE.get(), Ordering::SeqCst);
}

/// Stops the thread for ever when it is dropped.
struct Halt;

impl Drop for Halt {
    fn drop(&mut self) {
        loop {
            thread::park();
        }
    }
}

#[allow(unsafe_code, reason = "PyO3 declares the functions of Python without the permission to unwind")]
unsafe extern "C-unwind" {
    /// Calls an object with positional arguments. Returns a new reference, or null with an exception.
    fn PyObject_CallObject(callable: *mut PyObject, arguments: *mut PyObject) -> *mut PyObject;
}

/// Calls code of a user, which may outlast the interpreter. If Python unwinds the thread out of it, the thread stops here, until
/// the process ends.
///
/// # Errors
/// The exception of the call.
pub fn call<'py, A>(callable: &Bound<'py, PyAny>, arguments: A) -> PyResult<Bound<'py, PyAny>>
where
    A: IntoPyObject<'py, Target = PyTuple, Output = Bound<'py, PyTuple>>,
{
    let py = callable.py();
    let arguments = arguments.into_pyobject(py).map_err(Into::into)?;
    // Dropped by unwinding only, and first.
    let halt = Halt;
    // SAFETY: the thread holds the GIL, both pointers are those of living objects, the second that of a tuple, and the
    // function may unwind.
    #[allow(unsafe_code, reason = "as above")]
    let returned = unsafe { PyObject_CallObject(callable.as_ptr(), arguments.as_ptr()) };
    std::mem::forget(halt);
    // SAFETY: the function returns a new reference, or null with an exception.
    #[allow(unsafe_code, reason = "as above")]
    unsafe {
        Bound::from_owned_ptr_or_err(py, returned)
    }
}

/// Calls a method of an object of a user, as [`call`] does.
///
/// # Errors
/// The exception of the call; `AttributeError` if there is no such method.
pub fn call_method<'py, A>(object: &Bound<'py, PyAny>, name: &str, arguments: A) -> PyResult<Bound<'py, PyAny>>
where
    A: IntoPyObject<'py, Target = PyTuple, Output = Bound<'py, PyTuple>>,
{
    call(&object.getattr(name)?, arguments)
}
