//! [`Tail`]: the last lines of a worker's standard error, which appear in error messages.

use crate::worker::EXIT_TIMEOUT;
use std::collections::VecDeque;
use std::io::{BufRead as _, BufReader, Read as _};
use std::process::ChildStderr;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};

/// The number of last lines of a worker's standard error in error messages.
const LINES: usize = 20;
/// The maximum length of a line of a worker's standard error; the rest of a longer line counts as another line.
const MAX_LINE: u64 = 4096;

/// The last lines of a worker's standard error.
pub struct Tail {
    lines: Arc<Mutex<VecDeque<String>>>,
    /// Disconnected when the pipe closes.
    closed: Receiver<()>,
}

impl Tail {
    /// Collects the lines of a pipe, until it closes. `id` names the environment in the log.
    pub fn of(pipe: Option<ChildStderr>, id: &str) -> Self {
        let lines = Arc::new(Mutex::new(VecDeque::new()));
        let (last, id) = (Arc::clone(&lines), id.to_owned());
        let (open, closed) = channel();
        let read = move || {
            let _dropped_at_the_end: Sender<()> = open;
            let mut pipe = pipe.map(BufReader::new);
            let mut line = vec![];
            while let Some(pipe) = &mut pipe
                && let Ok(1..) = pipe.take(MAX_LINE).read_until(b'\n', &mut line)
            {
                let text = String::from_utf8_lossy(&line).trim_end().to_owned();
                tracing::debug!("{id}: {text}");
                let mut last = last.lock().unwrap_or_else(PoisonError::into_inner);
                if last.len() == LINES {
                    last.pop_front();
                }
                last.push_back(text);
                line.clear();
            }
        };
        // Without this thread, error messages lack the worker's last output.
        if let Err(problem) = std::thread::Builder::new().name("swm-gym-stderr".to_owned()).spawn(read) {
            tracing::debug!("collecting the output of a worker: {problem}");
        }
        Self { lines, closed }
    }

    /// Waits until the pipe closes, for at most [`EXIT_TIMEOUT`], and returns the last lines.
    pub fn lines(&self) -> Vec<String> {
        // A child of the worker may hold the pipe open, so the wait is bounded.
        let _closed_or_timed_out = self.closed.recv_timeout(EXIT_TIMEOUT);
        self.lines.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
    }
}
