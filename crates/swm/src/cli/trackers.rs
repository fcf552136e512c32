//! Experiment trackers of a training: `--log wandb` and `--log trackio` send the lines of `train.jsonl` to the tracker's own Python
//! package while the training runs. `train.jsonl` and a TensorBoard event file are always written.

use super::eprint;
use clap::ValueEnum;
use serde_json::{Value, json};
use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _, Seek as _, SeekFrom, Write as _};
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::Path;
use std::process::{Child, ChildStdin, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::thread::JoinHandle;
use std::time::Duration;
use swm_core::{Error, Result};
use swm_gym::Python;

/// Where the metrics of a training go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Tracker {
    /// An event file in the folder of the run, always written
    Tensorboard,
    /// `train.jsonl` in the folder of the run, always written
    Jsonl,
    /// The package `trackio`, on this machine
    Trackio,
    /// The package `wandb`, with its own login and settings
    Wandb,
}

/// The program that hands lines to a package. Its first line of input is the run, each further one a step.
const SCRIPT: &str = r#"
import importlib, json, os, signal, sys
# What packages print goes to standard error.
answers = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)
run = json.loads(sys.stdin.readline())
# A package that hangs is ended.
signal.signal(signal.SIGALRM, signal.SIG_DFL)
signal.alarm(run["seconds"])
try:
    package = importlib.import_module(run["package"])
except ImportError as error:
    print("missing:", str(error).replace("\n", " "), file=answers)
    sys.exit(1)
tracked = package.init(project=run["project"], name=run["name"], config=run["config"])
print("ready", file=answers)
signal.alarm(0)
for line in sys.stdin:
    metrics = json.loads(line)
    step = metrics.pop("step", None)
    signal.alarm(run["seconds"])
    (tracked if hasattr(tracked, "log") else package).log(metrics, step=step)
    signal.alarm(0)
signal.alarm(run["seconds"])
package.finish()
"#;

/// The time between two looks at the log.
const BETWEEN: Duration = Duration::from_millis(500);
/// The time between two looks at whether the user stops the program.
const LOOK: Duration = Duration::from_millis(100);
/// The variable with the seconds after which a package that does not start, take a line or finish is ended, and its default.
const TIMEOUT: &str = "SWM_TRACKER_TIMEOUT";
const SECONDS: u32 = 300;

/// The trackers of a training that runs. Dropping it sends the last lines and waits for the packages to finish.
pub struct Trackers {
    done: Arc<AtomicBool>,
    follower: Option<JoinHandle<()>>,
}

/// A package in a process of its own.
struct Process {
    package: &'static str,
    child: Child,
    input: Option<ChildStdin>,
}

impl Tracker {
    /// The Python package; `None` for what is always written.
    fn package(self) -> Option<&'static str> {
        match self {
            Self::Tensorboard | Self::Jsonl => None,
            Self::Trackio => Some("trackio"),
            Self::Wandb => Some("wandb"),
        }
    }
}

impl Trackers {
    /// Starts the trackers of a run in the folder `out`, whose configuration is `config`. Lines that the log has already belong to
    /// a run that is continued, and are not sent again.
    ///
    /// # Errors
    /// When Python or a package is missing, a package does not start, or the user stops the program.
    pub fn start(trackers: &[Tracker], out: &Path, config: &Value, interrupt: &AtomicBool) -> Result<Self> {
        let mut packages: Vec<&'static str> = trackers.iter().filter_map(|tracker| tracker.package()).collect();
        packages.dedup();
        let name = out.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let processes: Vec<Process> = packages
            .into_iter()
            .map(|package| Process::start(package, &name, config, interrupt))
            .collect::<Result<_>>()?;
        let done = Arc::new(AtomicBool::new(false));
        if processes.is_empty() {
            return Ok(Self { done, follower: None });
        }
        let log = out.join("train.jsonl");
        let from = std::fs::metadata(&log).map_or(0, |found| found.len());
        let stop = Arc::clone(&done);
        let follow = move || follow(&log, from, processes, &stop);
        let follower = std::thread::Builder::new().name("swm-trackers".to_owned()).spawn(follow);
        let follower = follower.map_err(|error| Error::external("starting the thread of trackers", error))?;
        Ok(Self { done, follower: Some(follower) })
    }
}

impl Drop for Trackers {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Release);
        if let Some(follower) = self.follower.take() {
            follower.thread().unpark();
            // A panic of the thread was printed; the training is not affected.
            let _ = follower.join();
        }
    }
}

impl Process {
    fn start(package: &'static str, name: &str, config: &Value, interrupt: &AtomicBool) -> Result<Self> {
        let python = Python::of_user();
        let what = format!("--log {package}");
        let failed = |problem: String| {
            let fix = format!("install it (pip install {package}) in {}, or set $SWM_PYTHON", python.program.display());
            Error::config(what.clone(), problem, fix)
        };
        let mut command = python.script(SCRIPT);
        // Packages start Python as well.
        command.env("PYTHONSAFEPATH", "1");
        // Ctrl-C is for the training: the package then receives the last lines, and finishes.
        command.process_group(0);
        let spawned = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child =
            spawned.map_err(|error| failed(format!("{} does not start: {error}", python.program.display())))?;
        let mut input = child.stdin.take();
        let given = std::env::var(TIMEOUT).ok().and_then(|text| text.parse().ok());
        let seconds = given.filter(|seconds| *seconds > 0).unwrap_or(SECONDS);
        let run = json!({
            "package": package, "project": "stable-worldmodel", "name": name, "config": config, "seconds": seconds,
        });
        let sent = input.as_mut().map(|input| writeln!(input, "{run}"));
        let answers = BufReader::new(child.stdout.take().ok_or_else(|| failed("has no output".to_owned()))?).lines();
        let (sender, lines) = std::sync::mpsc::channel();
        std::thread::spawn(move || answers.map_while(std::io::Result::ok).try_for_each(|line| sender.send(line)));
        let answer = loop {
            match lines.recv_timeout(LOOK) {
                Ok(line) => break Some(line),
                Err(RecvTimeoutError::Disconnected) => break None,
                Err(RecvTimeoutError::Timeout) if interrupt.load(Ordering::SeqCst) => {
                    drop((child.kill(), child.wait()));
                    return Err(Error::Interrupted);
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
        };
        if answer.as_deref() == Some("ready") {
            return Ok(Self { package, child, input });
        }
        drop((sent, input));
        let ended = child.wait().ok().and_then(|status| status.signal());
        Err(match answer.as_deref().and_then(|line| line.strip_prefix("missing: ")) {
            Some(missing) => failed(missing.to_owned()),
            None if ended == Some(libc::SIGALRM) => {
                let problem = format!("the package did not start within {seconds} s (${TIMEOUT} changes this)");
                Error::external(what.clone(), problem)
            }
            None => Error::external(what.clone(), "the package did not start; its message is above"),
        })
    }
}

/// Sends the lines of a log after byte `from` to the processes, until the training is done and all lines are sent.
fn follow(log: &Path, mut from: u64, mut processes: Vec<Process>, done: &AtomicBool) {
    let mut rest = String::new();
    loop {
        // Before the file is read, so that no line is missed.
        let is_last = done.load(Ordering::Acquire);
        if let Ok(mut file) = File::open(log)
            && file.seek(SeekFrom::Start(from)).is_ok()
            && let Ok(count) = file.read_to_string(&mut rest)
        {
            from += count as u64;
            let complete = rest.rfind('\n').map_or(0, |end| end + 1);
            let lines: String = rest.drain(..complete).collect();
            processes.iter_mut().for_each(|process| process.send(&lines));
        }
        if is_last {
            break;
        }
        std::thread::park_timeout(BETWEEN);
    }
    for mut process in processes {
        drop(process.input.take());
        if process.child.wait().is_ok_and(|status| !status.success()) {
            eprint(&format!("warning: {} did not finish; the run is complete in {}\n", process.package, log.display()));
        }
    }
}

impl Process {
    fn send(&mut self, lines: &str) {
        let Some(input) = &mut self.input else { return };
        if input.write_all(lines.as_bytes()).and_then(|()| input.flush()).is_err() {
            eprint(&format!("warning: {} has ended; the training continues without it\n", self.package));
            self.input = None;
        }
    }
}
