//! The engine's warnings as `UserWarning`s of Python. Threads of the engine queue them, because they do not hold the GIL; the end of
//! a call, or the poll of a long one, issues them.

use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use std::ffi::CString;
use std::io::{self, Write};
use std::mem;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use swm::core::text::printable;
use tracing::{Level, Metadata};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

/// The most warnings that wait. Further ones are printed.
const MOST: usize = 100;

static QUEUE: Mutex<Vec<String>> = Mutex::new(Vec::new());
/// Whether a warning waits.
static WAITS: AtomicBool = AtomicBool::new(false);

/// The number of commands that run in this process, whose warnings are printed at once.
static COMMANDS: AtomicUsize = AtomicUsize::new(0);

/// Queues the warnings of the engine from now on. Other messages are printed, where `SWM_LOG` asks for them.
pub fn collect() {
    let filter = EnvFilter::try_from_env("SWM_LOG").unwrap_or_else(|_| EnvFilter::new("warn"));
    let subscriber = tracing_subscriber::fmt().with_env_filter(filter).with_writer(Warnings);
    // A module that is initialised again finds the first one.
    let _ = subscriber.without_time().with_level(false).with_target(false).with_ansi(false).try_init();
}

/// Runs a command, whose messages are printed.
pub fn printing<T>(command: impl FnOnce() -> T) -> T {
    COMMANDS.fetch_add(1, Ordering::Relaxed);
    let outcome = command();
    COMMANDS.fetch_sub(1, Ordering::Relaxed);
    outcome
}

/// Decides where the messages of the engine go.
struct Warnings;

impl<'a> MakeWriter<'a> for Warnings {
    type Writer = Destination;

    fn make_writer(&'a self) -> Destination {
        Destination::Output
    }

    fn make_writer_for(&'a self, about: &Metadata<'_>) -> Destination {
        let is_warning = *about.level() <= Level::WARN && about.target().starts_with("swm");
        match COMMANDS.load(Ordering::Relaxed) {
            0 if is_warning => Destination::Queue,
            // Warnings of libraries concern no user of the Python package.
            0 if std::env::var_os("SWM_LOG").is_none() => Destination::Nowhere,
            _ => Destination::Output,
        }
    }
}

/// Where a message goes; each call of [`Write::write`] is a message.
enum Destination {
    Queue,
    Output,
    Nowhere,
}

/// Issues the warnings that wait.
///
/// # Errors
/// The first warning that a filter of Python turns into an error.
pub fn issue(py: Python<'_>) -> PyResult<()> {
    if !WAITS.load(Ordering::Relaxed) {
        return Ok(());
    }
    let mut outcome = Ok(());
    for message in take() {
        let message = CString::new(printable(&message).as_bytes())?;
        outcome = outcome.and(PyErr::warn(py, &py.get_type::<PyUserWarning>(), &message, 1));
    }
    outcome
}

/// Issues the warnings that wait, where no error can be raised: one that a filter makes of a warning is printed.
pub fn issue_or_print(py: Python<'_>) {
    if let Err(error) = issue(py) {
        error.write_unraisable(py, None);
    }
}

/// Takes the warnings that wait. A process that was forked while another thread held the queue has none.
pub fn take() -> Vec<String> {
    let Ok(mut queue) = QUEUE.try_lock() else { return vec![] };
    WAITS.store(false, Ordering::Relaxed);
    mem::take(&mut *queue)
}

impl Write for Destination {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let message = String::from_utf8_lossy(bytes).trim_end().to_owned();
        match (self, QUEUE.try_lock()) {
            (Self::Nowhere, _) => {}
            (Self::Queue, Ok(mut queue)) if queue.len() < MOST => {
                queue.push(message);
                WAITS.store(true, Ordering::Relaxed);
            }
            // A warning must not wait for a queue of which a forked process does not have the thread.
            _ => writeln!(io::stderr(), "warning: {}", printable(&message))?,
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
