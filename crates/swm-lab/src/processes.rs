//! Trainings, collections and evaluations that pages start: processes of the program itself, each of which writes in the first
//! folder of its kind.
//!
//! They are stopped as Ctrl-C stops them: at the next safe point, so that they can be continued. A page that leaves does not
//! stop them; the end of the lab does.

use crate::requests::{Kind, Order};
use serde::Serialize;
use std::collections::VecDeque;
use std::ffi::OsString;
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use swm_core::{Error, Result, text};

/// Processes that run at the same time.
const MOST: usize = 2;
/// Ended ones that are listed.
const MOST_ENDED: usize = 20;
/// The end of what a process reports that is kept, in bytes.
const TAIL: usize = 2_000;
/// The longest wait for them when the lab ends.
const ENDING: Duration = Duration::from_secs(60);
/// How often it is looked whether they have ended.
const POLL: Duration = Duration::from_millis(50);
/// How long the last reports of a program that has ended are waited for.
const READING: Duration = Duration::from_secs(2);
/// The exit code of a program that was interrupted.
const INTERRUPTED: i32 = 130;
/// The signal of Ctrl-C, which ends a program that does not handle it yet.
const SIGINT: i32 = 2;

/// A model family that can be trained on a dataset.
#[derive(Clone, Debug, Serialize)]
pub struct Family {
    /// The id.
    pub id: String,
    /// One sentence about it.
    pub summary: String,
    /// Its presets: the id and what it is for.
    pub presets: Vec<(String, String)>,
}

/// What starts this program.
pub trait Program: Send + Sync {
    /// The families that can be trained on a dataset alone.
    fn families(&self) -> Vec<Family>;

    /// The program with these arguments, which are valid.
    ///
    /// # Errors
    /// When the program is not found.
    fn command(&self, arguments: &[OsString]) -> Result<Command>;

    /// Asks a process to stop, as Ctrl-C does.
    ///
    /// # Errors
    /// When the system refuses.
    fn interrupt(&self, process: &Child) -> Result<()>;

    /// Whether a process that was stopped left something in its folder that `--resume` continues.
    fn can_continue(&self, output: &Path) -> bool;
}

/// How a process is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// It runs.
    Running,
    /// It was asked to stop, and has not ended.
    Stopping,
    /// It was stopped.
    Stopped,
    /// It is done.
    Finished,
    /// It has failed.
    Failed,
}

/// A process of the list.
#[derive(Clone, Debug, Serialize)]
pub struct Listed {
    /// What it does.
    pub kind: Kind,
    /// The name of what it writes.
    pub name: String,
    /// What it trains, or what acts.
    pub what: String,
    /// How it is.
    pub state: State,
    /// The last line that it reported, or the last lines if it has failed; that nothing continues, if it was stopped too early
    /// for that.
    pub message: String,
}

/// A process that was started.
struct Started {
    kind: Kind,
    name: String,
    what: String,
    output: PathBuf,
    process: Child,
    state: State,
    tail: Arc<Mutex<VecDeque<u8>>>,
    /// Reads the tail, and when the program was first seen to have ended.
    reader: Option<JoinHandle<()>>,
    ended: Option<Instant>,
}

/// The processes that pages started, the newest last.
#[derive(Clone, Default)]
pub struct Processes(Arc<Mutex<Vec<Started>>>);

impl Processes {
    /// The processes, each as it is now.
    fn lock(&self) -> MutexGuard<'_, Vec<Started>> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.iter_mut().for_each(Started::look);
        while all.iter().filter(|started| started.has_ended()).count() > MOST_ENDED {
            let oldest = all.iter().position(Started::has_ended).unwrap_or_default();
            all.remove(oldest);
        }
        all
    }

    /// The processes, the newest first.
    pub fn list(&self, program: &dyn Program) -> Vec<Listed> {
        self.lock().iter().rev().map(|started| started.listed(program)).collect()
    }

    /// Starts a process.
    ///
    /// # Errors
    /// When its output exists, or too many run.
    pub fn start(&self, program: &dyn Program, order: Order) -> Result<()> {
        let Order { kind, name, what, output, arguments } = order;
        // Held until the process is listed: of two requests for one name, the second finds the first.
        let mut all = self.lock();
        let is_running = all.iter().any(|started| started.output == output && !started.has_ended());
        if is_running || output.symlink_metadata().is_ok() {
            let problem = match is_running {
                true => format!("a {kind} of this name runs"),
                false => format!("there is a {} of this name", kind.result()),
            };
            return Err(Error::config(format!("{kind} {name}"), problem, "choose another name"));
        }
        if all.iter().filter(|started| !started.has_ended()).count() >= MOST {
            let problem = format!("{MOST} run already");
            return Err(Error::config(format!("a {kind}"), problem, "stop one, or wait until one is done"));
        }
        let mut command = program.command(&arguments)?;
        // Ctrl-C in a terminal reaches the lab alone, which then asks the process to stop once: twice is at once.
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).process_group(0);
        let mut process = command.spawn().map_err(|error| Error::external(format!("starting a {kind}"), error))?;
        let tail = Arc::<Mutex<VecDeque<u8>>>::default();
        let reader = process.stderr.take().map(|reports| {
            let tail = Arc::clone(&tail);
            std::thread::spawn(move || keep_tail(reports, &tail))
        });
        let (state, ended) = (State::Running, None);
        all.push(Started { kind, name, what, output, process, state, tail, reader, ended });
        Ok(())
    }

    /// Asks a process to stop.
    ///
    /// # Errors
    /// When none of this name runs.
    pub fn stop(&self, program: &dyn Program, kind: Kind, name: &str) -> Result<()> {
        let mut all = self.lock();
        let is_it = |it: &&mut Started| it.kind == kind && it.name == name && it.state == State::Running;
        let none = || Error::config(format!("{kind} {name}"), "it does not run", "reload the page");
        all.iter_mut().find(is_it).ok_or_else(none)?.stop(program)
    }

    /// Asks all processes to stop.
    pub fn stop_all(&self, program: &dyn Program) {
        for started in self.lock().iter_mut().filter(|started| started.state == State::Running) {
            started.stop(program).ok();
        }
    }

    /// Stops all processes, and waits for them. One that does not end is killed.
    pub fn end(&self, program: &dyn Program) {
        self.stop_all(program);
        let until = Instant::now() + ENDING;
        while self.lock().iter().any(|started| !started.has_ended()) {
            if Instant::now() >= until {
                self.lock().iter_mut().for_each(|started| drop(started.process.kill()));
            }
            std::thread::sleep(POLL);
        }
    }
}

impl Started {
    fn has_ended(&self) -> bool {
        !matches!(self.state, State::Running | State::Stopping)
    }

    /// Looks whether it has ended.
    fn look(&mut self) {
        if self.has_ended() {
            return;
        }
        let Ok(Some(status)) = self.process.try_wait() else { return };
        // What it reported last may not have been read yet; a program that it started may keep the pipe open.
        let is_read = self.reader.as_ref().is_none_or(JoinHandle::is_finished);
        if !is_read && self.ended.get_or_insert_with(Instant::now).elapsed() < READING {
            return;
        }
        // One that was asked to stop may be done before, or fail.
        self.state = match status {
            _ if status.success() => State::Finished,
            _ if was_interrupted(status) => State::Stopped,
            _ => State::Failed,
        };
    }

    fn stop(&mut self, program: &dyn Program) -> Result<()> {
        program.interrupt(&self.process)?;
        self.state = State::Stopping;
        Ok(())
    }

    /// The last lines that it reported, at most so many.
    fn reported(&self, most: usize) -> String {
        let tail: Vec<u8> = self.tail.lock().unwrap_or_else(PoisonError::into_inner).iter().copied().collect();
        let reported = String::from_utf8_lossy(&tail);
        let lines: Vec<&str> = reported.lines().rev().take(most).collect();
        text::printable(&lines.into_iter().rev().collect::<Vec<_>>().join(" ")).into_owned()
    }

    fn listed(&self, program: &dyn Program) -> Listed {
        let message = match self.state {
            State::Failed => self.reported(3),
            State::Running | State::Stopping => self.reported(1),
            State::Stopped if !program.can_continue(&self.output) => {
                let again = if self.output.exists() { "start it again under another name" } else { "start it again" };
                format!("it was stopped before it stored anything, so that there is nothing to continue: {again}")
            }
            _ => String::new(),
        };
        Listed { kind: self.kind, name: self.name.clone(), what: self.what.clone(), state: self.state, message }
    }
}

/// Whether a program ended because it was asked to, as by Ctrl-C.
fn was_interrupted(status: ExitStatus) -> bool {
    status.code() == Some(INTERRUPTED) || status.signal() == Some(SIGINT)
}

/// Keeps the end of what a process reports, until it ends.
fn keep_tail(mut reports: impl std::io::Read, tail: &Mutex<VecDeque<u8>>) {
    let mut bytes = [0; 1024];
    while let Ok(count @ 1..) = reports.read(&mut bytes) {
        let mut tail = tail.lock().unwrap_or_else(PoisonError::into_inner);
        tail.extend(&bytes[..count]);
        let surplus = tail.len().saturating_sub(TAIL);
        tail.drain(..surplus);
    }
}
