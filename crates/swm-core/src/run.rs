//! The run protocol: progress events and interruption of long commands.
//!
//! Collecting, training, converting, examining, evaluating, reproducing and the demo all take a [`Control`]. They call
//! [`Control::check`] between steps and [`Control::emit`] with an [`Event`] whenever there is progress to report.

use crate::{Error, Result};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// An event that a run reports to its caller.
///
/// A run is a sequence of stages: [`Event::Started`], any number of other events, [`Event::Finished`]. A stage that
/// fails or is interrupted does not emit [`Event::Finished`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Event<'a> {
    /// A stage starts.
    Started(Stage<'a>),
    /// The progress of the current stage.
    Progress(Progress<'a>),
    /// A one-line message for the user.
    Log(&'a str),
    /// A file or folder was written: a dataset, a checkpoint, a video.
    Saved(&'a Path),
    /// The current stage is done; `metrics` summarise it, such as `success_rate`.
    Finished {
        /// The stage's [`Stage::name`].
        stage: &'static str,
        /// Values by name.
        metrics: &'a [(&'static str, f64)],
    },
}

/// A stage of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stage<'a> {
    /// The name, an imperative verb: `collect`, `train`, `compare`, `convert`, `verify`, `examine`, `evaluate`.
    pub name: &'static str,
    /// The subject, such as the policy and the condition of an evaluation; empty if the run has only one subject.
    pub subject: &'a [&'a str],
    /// The number of units of work.
    pub total: usize,
    /// The unit of work: `episodes`, `steps`, `columns`.
    pub unit: &'static str,
}

/// The progress of a stage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress<'a> {
    /// The stage's [`Stage::name`].
    pub stage: &'static str,
    /// The number of finished units of work.
    pub done: usize,
    /// The number of units of work.
    pub total: usize,
    /// The unit of work: `episodes`, `steps`, `columns`.
    pub unit: &'static str,
    /// Current values by name, such as `loss` or `steps`; the most important ones first.
    pub metrics: &'a [(&'static str, f64)],
}

impl Progress<'_> {
    /// The current value of a metric, if the run reports it.
    pub fn metric(&self, name: &str) -> Option<f64> {
        self.metrics.iter().find(|(known, _)| *known == name).map(|(_, value)| *value)
    }

    /// Whether all units of work are done.
    pub fn is_done(&self) -> bool {
        self.done >= self.total
    }
}

/// A caller's poll, see [`Control::with_poll`].
type Poll<'a> = Box<dyn FnMut() -> Result<()> + Send + 'a>;
/// A caller's event sink, see [`Control::with_events`].
type Sink<'a> = Box<dyn FnMut(Event<'_>) + Send + 'a>;

/// The connection of a caller to a run: an interrupt flag, a poll function and an event sink, each optional.
#[derive(Default)]
pub struct Control<'a> {
    interrupt: Option<Arc<AtomicBool>>,
    poll: Option<Poll<'a>>,
    events: Option<Sink<'a>>,
}

impl<'a> Control<'a> {
    /// A control that never stops the run and drops all events.
    pub fn new() -> Self {
        Self::default()
    }

    /// Stops the run with [`Error::Interrupted`] once `flag` is set, for example by a signal handler.
    #[must_use]
    pub fn with_interrupt(self, flag: Arc<AtomicBool>) -> Self {
        Self { interrupt: Some(flag), ..self }
    }

    /// Calls `poll` at every check and stops the run with its error: for callers that handle signals themselves, such
    /// as Python. Every step calls `poll`, so an expensive function should return early on most calls.
    #[must_use]
    pub fn with_poll(self, poll: impl FnMut() -> Result<()> + Send + 'a) -> Self {
        Self { poll: Some(Box::new(poll)), ..self }
    }

    /// Sends events to `sink`. Every step may send an event, so an expensive sink should drop some events.
    #[must_use]
    pub fn with_events(self, sink: impl FnMut(Event<'_>) + Send + 'a) -> Self {
        Self { events: Some(Box::new(sink)), ..self }
    }

    /// Returns an error if the run is to stop. Costs one atomic load when no poll is set.
    ///
    /// # Errors
    /// [`Error::Interrupted`] when the interrupt flag is set, else the poll's error.
    pub fn check(&mut self) -> Result<()> {
        if self.interrupt.as_ref().is_some_and(|flag| flag.load(Ordering::Relaxed)) {
            return Err(Error::Interrupted);
        }
        self.poll.as_mut().map_or(Ok(()), |poll| poll())
    }

    /// Runs `work` on the threads of `threads` (those of rayon's global pool for `None`), with an interrupt that this
    /// control sets. If there is a poll, this thread calls it meanwhile, because some callers learn of signals in one
    /// thread only.
    ///
    /// # Errors
    /// The error of [`Control::check`] if that interrupted the work, else the error of `work`.
    pub fn install<T: Send>(
        &mut self,
        threads: Option<&rayon::ThreadPool>,
        work: impl FnOnce(&dyn Interrupt) -> Result<T> + Send,
    ) -> Result<T> {
        self.check()?;
        if self.poll.is_none() {
            let never = AtomicBool::new(false);
            let flag = self.interrupt.as_deref().unwrap_or(&never);
            return match threads {
                Some(threads) => threads.install(|| work(flag)),
                None => work(flag),
            };
        }
        let stop = AtomicBool::new(false);
        let (done, result) = channel();
        let stop = &stop;
        let work = move || drop(done.send(work(stop)));
        let mut wait = || {
            let mut failed = None;
            loop {
                match result.recv_timeout(POLL_INTERVAL) {
                    Ok(result) => return failed.map_or(result, Err),
                    Err(RecvTimeoutError::Timeout) => {
                        failed = failed.or_else(|| self.check().err());
                        stop.store(failed.is_some(), Ordering::Relaxed);
                    }
                    // The work panicked, and so does the end of the scope.
                    Err(RecvTimeoutError::Disconnected) => return Err(Error::Interrupted),
                }
            }
        };
        match threads {
            Some(threads) => threads.in_place_scope(|scope| {
                scope.spawn(move |_| work());
                wait()
            }),
            None => rayon::in_place_scope(|scope| {
                scope.spawn(move |_| work());
                wait()
            }),
        }
    }

    /// Runs `work` on this thread, with an interrupt that checks this control.
    ///
    /// # Errors
    /// The error of `work`.
    pub fn on_this_thread<T>(&mut self, work: impl FnOnce(&dyn Interrupt) -> Result<T>) -> Result<T> {
        work(&Mutex::new(self))
    }

    /// Sends an event to the sink, if there is one.
    pub fn emit(&mut self, event: Event<'_>) {
        if let Some(sink) = &mut self.events {
            sink(event);
        }
    }

    /// Emits [`Event::Progress`].
    pub fn progress(&mut self, progress: Progress<'_>) {
        self.emit(Event::Progress(progress));
    }
}

/// The time between two polls while other threads work.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Tells work on any thread whether it is to stop.
pub trait Interrupt: Sync {
    /// Returns an error if the work is to stop.
    ///
    /// # Errors
    /// [`Error::Interrupted`], or the error of a poll.
    fn check(&self) -> Result<()>;
}

/// A flag that is set to stop the work.
impl Interrupt for AtomicBool {
    fn check(&self) -> Result<()> {
        if self.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) }
    }
}

impl Interrupt for Mutex<&mut Control<'_>> {
    fn check(&self) -> Result<()> {
        self.lock().unwrap_or_else(PoisonError::into_inner).check()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PROGRESS: Progress<'_> =
        Progress { stage: "train", done: 3, total: 5, unit: "steps", metrics: &[("loss", 0.5), ("lr", 1e-3)] };

    #[test]
    fn default_control_continues_and_drops_events() {
        let mut control = Control::new();
        control.emit(Event::Log("dropped"));
        assert!(control.check().is_ok());
    }

    #[test]
    fn interrupt_flag_is_checked_before_the_poll() {
        let flag = Arc::new(AtomicBool::new(false));
        let mut polls = 0;
        let mut control = Control::new().with_interrupt(Arc::clone(&flag)).with_poll(|| {
            polls += 1;
            if polls < 2 { Ok(()) } else { Err(Error::external("polling", "a signal")) }
        });
        assert!(control.check().is_ok());
        assert!(matches!(control.check(), Err(Error::External { .. })));
        flag.store(true, Ordering::Relaxed);
        assert!(matches!(control.check(), Err(Error::Interrupted)));
        drop(control);
        assert_eq!(polls, 2, "an interrupted run does not poll");
    }

    /// Works until it is interrupted; returns the number of checks.
    fn endless(interrupt: &dyn Interrupt) -> Result<usize> {
        loop {
            interrupt.check()?;
            std::thread::yield_now();
        }
    }

    #[test]
    fn a_flag_and_a_poll_interrupt_work_on_other_threads_and_on_this_one() {
        let threads = crate::pool::threads(2).expect("creating the thread pool");
        let here = std::thread::current().id();
        let flag = Arc::new(AtomicBool::new(false));
        let mut flagged = Control::new().with_interrupt(Arc::clone(&flag));
        let done = flagged.install(Some(&threads), |interrupt| interrupt.check().map(|()| std::thread::current().id()));
        assert!(done.expect("no interrupt") != here, "the work runs in the pool");
        let set = flagged.install(Some(&threads), |interrupt| {
            flag.store(true, Ordering::Relaxed);
            endless(interrupt)
        });
        assert!(matches!(set, Err(Error::Interrupted)));
        assert!(matches!(flagged.on_this_thread(endless), Err(Error::Interrupted)));

        let polls = |mut left: usize| {
            Control::new().with_poll(move || {
                assert_eq!(std::thread::current().id(), here, "signals arrive in this thread");
                left = left.checked_sub(1).ok_or_else(|| Error::external("polling", "a signal"))?;
                Ok(())
            })
        };
        assert_eq!(polls(9).install(Some(&threads), |_| Ok(7)).expect("the work is done first"), 7);
        let everywhere = [
            polls(2).install(Some(&threads), endless),
            polls(2).install(None, endless),
            polls(2).on_this_thread(endless),
        ];
        for failed in everywhere {
            assert!(matches!(failed, Err(Error::External { .. })), "the error of the poll: {failed:?}");
        }
        assert!(polls(0).install(Some(&threads), |_| -> Result<()> { unreachable!("interrupted before") }).is_err());
    }

    #[test]
    fn events_reach_the_sink_in_order() {
        let mut lines = vec![];
        let mut control = Control::new().with_events(|event| {
            lines.push(match event {
                Event::Started(stage) => format!("{} {:?}", stage.name, stage.subject),
                Event::Progress(at) => format!("{}/{} {}", at.done, at.total, at.unit),
                Event::Saved(path) => path.display().to_string(),
                Event::Finished { metrics, .. } => format!("{metrics:?}"),
                Event::Log(line) => line.to_owned(),
            });
        });
        control.emit(Event::Started(Stage { name: "train", subject: &["lewm"], total: 5, unit: "steps" }));
        control.progress(PROGRESS);
        control.emit(Event::Saved(Path::new("out")));
        control.emit(Event::Finished { stage: "train", metrics: &[("loss", 0.25)] });
        drop(control);
        assert_eq!(lines, ["train [\"lewm\"]", "3/5 steps", "out", "[(\"loss\", 0.25)]"]);
    }

    #[test]
    fn progress_finds_metrics_by_name_and_is_done_at_the_total() {
        assert_eq!((PROGRESS.metric("lr"), PROGRESS.metric("norm")), (Some(1e-3), None));
        assert!(!PROGRESS.is_done() && Progress { done: 5, ..PROGRESS }.is_done());
    }
}
