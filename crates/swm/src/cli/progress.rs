//! Progress of long work: a bar on a terminal, a plain line every few seconds elsewhere, on standard error.

use super::complain;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::cell::Cell;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

/// Seconds between plain lines.
const PLAIN_EVERY: Duration = Duration::from_secs(10);

/// How far one piece of long work has come.
pub struct Progress {
    name: &'static str,
    bar: ProgressBar,
    plain: Option<Cell<Instant>>,
}

impl Progress {
    /// Progress of `total` units of work.
    pub fn new(name: &'static str, total: usize) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let target = if terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(total as u64), target);
        if let Ok(style) =
            ProgressStyle::with_template("{prefix:>9} {bar:20.cyan/dim} {pos}/{len} eta {eta} {wide_msg}")
        {
            bar.set_style(style.progress_chars("━╸─"));
        }
        bar.set_prefix(name);
        Self { name, bar, plain: (!terminal).then(|| Cell::new(Instant::now())) }
    }

    /// `done` units are done; `message` says what the work looks like now.
    pub fn at(&self, done: usize, message: impl Into<String>) {
        let message = message.into();
        if let Some(last) = &self.plain
            && last.get().elapsed() >= PLAIN_EVERY
        {
            last.set(Instant::now());
            let total = self.bar.length().unwrap_or_default();
            complain(&format!("{}: {done}/{total} {message}\n", self.name));
        }
        self.bar.set_position(done as u64);
        self.bar.set_message(message);
    }

    /// The work is done; `message` is what stays on the screen.
    pub fn done(&self, message: &str) {
        self.bar.finish_and_clear();
        complain(&format!("{:>9}: {message}\n", self.name));
    }
}
