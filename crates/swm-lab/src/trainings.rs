//! Trainings that pages start: processes of the program itself, which write in the first folder of runs.
//!
//! They are stopped as Ctrl-C stops them: at the next safe point, so that they can be continued. A page that leaves does not
//! stop them; the end of the lab does.

use crate::folders::{Folders, check_name};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use swm_core::{Error, Result, text};

/// Trainings that run at the same time.
const MOST: usize = 2;
/// Ended trainings that are listed.
const MOST_ENDED: usize = 20;
/// The largest number of steps.
const MOST_STEPS: usize = 10_000_000;
/// The end of what a training reports that is kept, in bytes.
const TAIL: usize = 2_000;
/// The longest wait for trainings when the lab ends.
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

/// A training that a page asks for.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Request {
    /// The id of the family.
    pub family: String,
    /// The id of the preset.
    pub preset: String,
    /// The index of the dataset's folder.
    pub folder: usize,
    /// The dataset.
    pub dataset: String,
    /// The plain name of the run.
    pub name: String,
    /// Steps.
    pub steps: usize,
    /// The seed.
    pub seed: u32,
}

/// What the program knows of trainings.
pub trait Training: Send + Sync {
    /// The families that can be trained on a dataset alone.
    fn families(&self) -> Vec<Family>;

    /// The program that trains on the dataset at `data` and writes to the folder `output`. The request is valid.
    ///
    /// # Errors
    /// When the program is not found.
    fn command(&self, request: &Request, data: &Path, output: &Path) -> Result<Command>;

    /// Asks a process to stop, as Ctrl-C does.
    ///
    /// # Errors
    /// When the system refuses.
    fn interrupt(&self, process: &Child) -> Result<()>;

    /// Whether a training that was stopped left something in its folder that continues.
    fn can_continue(&self, output: &Path) -> bool;
}

/// How a training is.
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

/// A training of the list.
#[derive(Clone, Debug, Serialize)]
pub struct Listed {
    /// The name of the run.
    pub name: String,
    /// The family.
    pub family: String,
    /// How it is.
    pub state: State,
    /// The last lines that it reported, if it has failed; that nothing continues, if it was stopped too early for that.
    pub message: String,
}

/// A training that was started.
struct Started {
    name: String,
    family: String,
    output: PathBuf,
    process: Child,
    state: State,
    tail: Arc<Mutex<VecDeque<u8>>>,
    /// Reads the tail, and when the program was first seen to have ended.
    reader: Option<JoinHandle<()>>,
    ended: Option<Instant>,
}

/// The trainings that pages started, the newest last.
#[derive(Clone, Default)]
pub struct Trainings(Arc<Mutex<Vec<Started>>>);

impl Trainings {
    /// The trainings, each as it is now.
    fn lock(&self) -> MutexGuard<'_, Vec<Started>> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.iter_mut().for_each(Started::look);
        while all.iter().filter(|started| started.has_ended()).count() > MOST_ENDED {
            let oldest = all.iter().position(Started::has_ended).unwrap_or_default();
            all.remove(oldest);
        }
        all
    }

    /// The trainings, the newest first.
    pub fn list(&self, training: &dyn Training) -> Vec<Listed> {
        self.lock().iter().rev().map(|started| started.listed(training)).collect()
    }

    /// Starts a training.
    ///
    /// # Errors
    /// When the request is invalid, the run exists, or too many run.
    pub fn start(&self, training: &dyn Training, request: &Request, data: &Path, runs: &Folders) -> Result<()> {
        check(training, request)?;
        let no_folder = || Error::config("a training", "the lab has no folder of runs", "set STABLEWM_HOME");
        let output = runs.paths().first().ok_or_else(no_folder)?.join(&request.name);
        // Held until the training is listed: of two requests for one name, the second finds the first.
        let mut all = self.lock();
        let is_running = all.iter().any(|started| started.output == output && !started.has_ended());
        if is_running || output.symlink_metadata().is_ok() {
            let problem = if is_running { "a training of this name runs" } else { "there is a run of this name" };
            return Err(Error::config(format!("run {}", request.name), problem, "choose another name"));
        }
        if all.iter().filter(|started| !started.has_ended()).count() >= MOST {
            let problem = format!("{MOST} run already");
            return Err(Error::config("a training", problem, "stop one, or wait until one is done"));
        }
        let mut command = training.command(request, data, &output)?;
        // Ctrl-C in a terminal reaches the lab alone, which then asks the training to stop once: twice is at once.
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).process_group(0);
        let mut process = command.spawn().map_err(|error| Error::external("starting a training", error))?;
        let tail = Arc::<Mutex<VecDeque<u8>>>::default();
        let reader = process.stderr.take().map(|reports| {
            let tail = Arc::clone(&tail);
            std::thread::spawn(move || keep_tail(reports, &tail))
        });
        let (name, family) = (request.name.clone(), request.family.clone());
        let (state, ended) = (State::Running, None);
        all.push(Started { name, family, output, process, state, tail, reader, ended });
        Ok(())
    }

    /// Asks a training to stop.
    ///
    /// # Errors
    /// When no training of this name runs.
    pub fn stop(&self, training: &dyn Training, name: &str) -> Result<()> {
        let mut all = self.lock();
        let running = all.iter_mut().find(|started| started.name == name && started.state == State::Running);
        let none = || Error::config(format!("training {name}"), "it does not run", "reload the page");
        running.ok_or_else(none)?.stop(training)
    }

    /// Stops all trainings, and waits for them. One that does not end is killed.
    pub fn end(&self, training: &dyn Training) {
        for started in self.lock().iter_mut().filter(|started| started.state == State::Running) {
            started.stop(training).ok();
        }
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
        // A training that was asked to stop may be done before, or fail.
        self.state = match status {
            _ if status.success() => State::Finished,
            _ if was_interrupted(status) => State::Stopped,
            _ => State::Failed,
        };
    }

    fn stop(&mut self, training: &dyn Training) -> Result<()> {
        training.interrupt(&self.process)?;
        self.state = State::Stopping;
        Ok(())
    }

    fn listed(&self, training: &dyn Training) -> Listed {
        let message = match self.state {
            State::Failed => {
                let tail: Vec<u8> = self.tail.lock().unwrap_or_else(PoisonError::into_inner).iter().copied().collect();
                let reported = String::from_utf8_lossy(&tail);
                let lines: Vec<&str> = reported.lines().rev().take(3).collect();
                text::printable(&lines.into_iter().rev().collect::<Vec<_>>().join(" ")).into_owned()
            }
            State::Stopped if !training.can_continue(&self.output) => {
                let again = if self.output.exists() { "start it again under another name" } else { "start it again" };
                format!("it was stopped before it stored anything, so that there is nothing to continue: {again}")
            }
            _ => String::new(),
        };
        Listed { name: self.name.clone(), family: self.family.clone(), state: self.state, message }
    }
}

/// Whether a program ended because it was asked to, as by Ctrl-C.
fn was_interrupted(status: ExitStatus) -> bool {
    status.code() == Some(INTERRUPTED) || status.signal() == Some(SIGINT)
}

/// Checks everything that a page chose but the dataset, which is looked up.
fn check(training: &dyn Training, request: &Request) -> Result<()> {
    check_name("the name of a run", &request.name)?;
    let families = training.families();
    let family = families.iter().find(|family| family.id == request.family).ok_or_else(|| {
        let known = families.iter().map(|family| family.id.as_str());
        Error::unknown("model", &request.family, known, "reload the page, which lists the models")
    })?;
    if !family.presets.iter().any(|(id, _)| *id == request.preset) {
        let known = family.presets.iter().map(|(id, _)| id.as_str());
        return Err(Error::unknown("preset", &request.preset, known, "reload the page, which lists the presets"));
    }
    if !(1..=MOST_STEPS).contains(&request.steps) {
        let fix = format!("choose 1 to {MOST_STEPS}");
        return Err(Error::config("the steps of a training", request.steps.to_string(), fix));
    }
    Ok(())
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
