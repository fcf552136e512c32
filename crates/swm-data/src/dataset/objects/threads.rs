//! The threads that run asynchronous code. All of them start before the first request, and a thread that the system
//! cannot start is an error.
//!
//! Tokio by itself waits for ever in two cases: its builder, if the second worker of a runtime cannot be started (it
//! panics, and a destructor waits for the first worker), and Lance's runtime, at its second use after a failed start.
//! Therefore each runtime here has one thread, which this module starts, and one thread for blocking calls, which never
//! ends: tokio queues further calls for it if the system has no more threads.

use futures::FutureExt as _;
use std::convert::Infallible;
use std::future::Future;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError, mpsc};
use std::time::Duration;
use swm_core::{Error, Result};
use tokio::runtime::Handle;

/// Runs a future to completion; may be called from any thread, including threads of another runtime. Returns `None` if
/// the future panics, which damaged files can cause in the libraries that read them.
///
/// # Errors
/// If the threads cannot be started.
pub(crate) fn block_on<T: Send + 'static>(future: impl Future<Output = T> + Send + 'static) -> Result<Option<T>> {
    static HANDLES: PerProcess<Handles> = PerProcess::new();
    let [first, second] = HANDLES.get(start)?;
    let (sender, receiver) = mpsc::sync_channel(1);
    let is_less_busy = |a: &Handle, b: &Handle| a.metrics().num_alive_tasks() <= b.metrics().num_alive_tasks();
    let handle = if is_less_busy(&first, &second) { first } else { second };
    handle.spawn(async move {
        // The receiver below outlives the future, so sending cannot fail.
        let _ = sender.send(AssertUnwindSafe(future).catch_unwind().await);
    });
    Ok(receiver.recv().ok().and_then(std::result::Result::ok))
}

/// Starts the threads on which Lance encodes and decodes, which never end.
///
/// # Errors
/// If they cannot be started, in this call or in an earlier one, or a variable in [`COUNTS`] is no count.
pub(crate) fn start_lance() -> Result<()> {
    for name in COUNTS {
        let Some(value) = std::env::var_os(name) else { continue };
        if value.to_str().and_then(|text| text.parse::<u32>().ok()).is_none_or(|count| count == 0) {
            let problem = format!("is '{}'", value.display());
            return Err(Error::config(
                format!("the environment variable {name}"),
                problem,
                "unset it, or give a number from 1",
            ));
        }
    }
    static STARTED: PerProcess<bool> = PerProcess::new();
    let started = STARTED.get(|| {
        // The future only waits for the result; the threads run without it.
        Ok(catch_unwind(|| drop(lance_core::utils::tokio::spawn_cpu(|| Ok::<(), Infallible>(())))).is_ok())
    })?;
    if started { Ok(()) } else { Err(cannot_start("the system has no memory or no threads for Lance")) }
}

/// Environment variables of Lance that it uses without a check, and so panics.
const COUNTS: [&str; 5] = [
    "LANCE_CPU_THREADS",
    "LANCE_IO_THREADS",
    "LANCE_MAX_IOP_SIZE",
    "LANCE_UPLOAD_CONCURRENCY",
    "LANCE_INITIAL_UPLOAD_SIZE",
];

/// The runtimes, each with one thread.
type Handles = [Handle; 2];

fn start() -> Result<Handles> {
    Ok([start_runtime()?, start_runtime()?])
}

fn start_runtime() -> Result<Handle> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .thread_name("swm-io")
        .thread_keep_alive(Duration::from_secs(u64::MAX))
        .enable_all()
        .build()
        .map_err(cannot_start)?;
    let handle = runtime.handle().clone();
    let wait = move || runtime.block_on(std::future::pending::<()>());
    std::thread::Builder::new().name("swm-io".to_owned()).spawn(wait).map_err(cannot_start)?;
    // Without a thread that could take the call, tokio panics.
    catch_unwind(AssertUnwindSafe(|| drop(handle.spawn_blocking(|| ()))))
        .map_err(|_| cannot_start("the system has no memory or no threads for files"))?;
    Ok(handle)
}

fn cannot_start(problem: impl std::fmt::Display) -> Error {
    Error::external("starting the threads that read and write datasets", problem)
}

/// A value that every process makes once. A forked process (Python forks) does not inherit threads, so it makes its own.
struct PerProcess<T>(Mutex<Option<(u32, T)>>);

impl<T: Clone> PerProcess<T> {
    const fn new() -> Self {
        Self(Mutex::new(None))
    }

    /// The value; made with `make` if this process has none.
    fn get(&self, make: impl FnOnce() -> Result<T>) -> Result<T> {
        let mut made = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let process = std::process::id();
        match &*made {
            Some((owner, value)) if *owner == process => Ok(value.clone()),
            _ => {
                let value = make()?;
                *made = Some((process, value.clone()));
                Ok(value)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn block_on_runs_inside_another_runtime_and_returns_none_after_a_panic() -> Result<()> {
        let outer = tokio::runtime::Builder::new_current_thread().build().expect("creating the runtime");
        assert_eq!(outer.block_on(async { block_on(async { 7 }) })?, Some(7));
        let panics = block_on::<()>(async { std::panic::resume_unwind(Box::new("damaged")) })?;
        assert_eq!(panics, None);
        Ok(())
    }

    #[test]
    fn failed_start_is_not_remembered() {
        let value = PerProcess::new();
        assert!(value.get(|| Err(cannot_start("no threads"))).is_err());
        assert_eq!(value.get(|| Ok(7)).expect("a value"), 7);
        assert_eq!(value.get(|| Ok(8)).expect("a value"), 7);
    }
}
