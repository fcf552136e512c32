//! [`WorkerTransport`]: an environment in a separate Python process, over shared memory.
//!
//! The process gets three descriptors: a socket for requests and answers as its standard input, the shared memory as
//! its standard output (an anonymous file, which is deleted when its last descriptor closes), and a pipe as its
//! standard error, whose last lines appear in error messages. The process ends when the transport is dropped, when its
//! socket closes, and, on Linux, when this process ends in any way.

use crate::config::{GymConfig, Python};
use crate::tail::Tail;
use crate::{BRIDGE, CRAFTAX, Description, Failure, Request, Transport, TrustedId, WORKER, answer, assets};
use memmap2::{MmapMut, MmapOptions};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Sender, SyncSender, channel, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use swm_core::{Error, limits};

/// The kinds of answers: done, with warnings; an exception; an unknown id; a missing package; unsupported; an invalid request.
const ANSWERS: &[u8] = b".xumfw";
/// The maximum length of an answer: a description of an environment, or a traceback.
const MAX_ANSWER: usize = 64 << 20;
/// The time that a worker process gets to end by itself.
pub(crate) const EXIT_TIMEOUT: Duration = Duration::from_millis(500);

/// A Python process with one environment.
pub struct WorkerTransport {
    id: TrustedId,
    config: GymConfig,
    process: Option<Process>,
}

struct Process {
    child: Child,
    socket: UnixStream,
    file: File,
    memory: Option<MmapMut>,
    /// Whether the answer to a sent request is not read yet. Meanwhile only the worker accesses the memory.
    pending: bool,
    /// Whether a call that takes long was reported.
    is_reported: bool,
    tail: Tail,
    _counted: Counted,
}

/// The number of running worker processes.
static RUNNING: AtomicUsize = AtomicUsize::new(0);

/// One of the running worker processes.
struct Counted;

impl Counted {
    /// Counts a process.
    ///
    /// # Errors
    /// When there are [`limits::WORKERS`] already.
    fn new() -> swm_core::Result<Self> {
        let running = RUNNING.fetch_add(1, Ordering::Relaxed);
        let counted = Self;
        limits::WORKERS.check(running + 1)?;
        Ok(counted)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        RUNNING.fetch_sub(1, Ordering::Relaxed);
    }
}

impl WorkerTransport {
    /// Starts a process that makes the environment, without waiting for the environment.
    ///
    /// # Errors
    /// When Python cannot be started.
    pub fn new(id: &TrustedId, config: GymConfig) -> swm_core::Result<Self> {
        let mut made = Self { id: id.clone(), config, process: None };
        match made.restart() {
            Ok(()) => Ok(made),
            Err(Failure::Refused(error)) => Err(error),
            Err(Failure::Raised(text) | Failure::Lost(text)) => Err(Error::external("starting a worker", text)),
        }
    }

    /// The id of the process that runs the environment.
    pub fn process_id(&self) -> Option<u32> {
        self.process.as_ref().map(|process| process.child.id())
    }

    /// Ends a process that violates the protocol or a timeout. The failure contains its exit status and last output.
    fn lose(&mut self, problem: &std::io::Error, limit: Duration) -> Failure {
        use std::io::ErrorKind::{InvalidData, TimedOut, WouldBlock};
        let Some(mut process) = self.process.take() else { return Failure::Lost("its worker process is gone".into()) };
        let id = process.child.id();
        let mut how = if matches!(problem.kind(), TimedOut | WouldBlock) {
            format!("worker process {id} did not answer within {limit:?} and was stopped")
        } else if problem.kind() == InvalidData {
            format!("worker process {id} violated the protocol ({problem}) and was stopped")
        } else {
            match process.exit_status() {
                Some(status) => format!("worker process {id} ended with {status}"),
                None => format!("worker process {id} closed its connection ({problem}) and was stopped"),
            }
        };
        process.kill();
        let last = process.tail.lines();
        if !last.is_empty() {
            how.push_str("; its last lines:\n");
            how.push_str(&last.join("\n"));
        }
        Failure::Lost(how)
    }

    /// Sends a request, unless it is pending, and reads the answer.
    fn exchange(&mut self, op: u8, payload: &[u8], limit: Duration) -> Result<(u8, Vec<u8>), Failure> {
        let Some(process) = &mut self.process else { return Err(Failure::Lost("its worker process is gone".into())) };
        let sent = if std::mem::take(&mut process.pending) { Ok(()) } else { process.send(op, payload) };
        let answered = sent.and_then(|()| process.wait_for_call(self.id.id(), op, limit));
        answered.and_then(|head| process.receive(head, limit)).map_err(|problem| self.lose(&problem, limit))
    }

    /// Converts an answer that reports a failure into a [`Failure`].
    fn failure(&self, kind: u8, text: Vec<u8>) -> Failure {
        let text = String::from_utf8_lossy(&text).into_owned();
        let (id, python) = (self.id.id(), &self.config.python);
        let refused = match kind {
            b'x' => return Failure::Raised(text),
            b'u' => {
                let known: Vec<String> = serde_json::from_str(&text).unwrap_or_default();
                let hint = format!(
                    "it is not among the {} environments registered with Gymnasium in {python}; check the spelling, or install \
                     the package that registers it",
                    known.len()
                );
                Error::unknown("environment", id, known.iter().map(String::as_str), hint)
            }
            b'm' => {
                let missing: BTreeMap<String, String> = serde_json::from_str(&text).unwrap_or_default();
                let of = |key: &str| missing.get(key).cloned().unwrap_or_default();
                Error::config(id, format!("{} in {python}", of("message")), python.fix(&of("asset")))
            }
            b'w' => {
                let [problem, fix]: [String; 2] = serde_json::from_str(&text).unwrap_or_default();
                Error::config(id, problem, fix)
            }
            _ => Error::config(
                id,
                text,
                format!("install the required packages in {python}, or choose another environment"),
            ),
        };
        Failure::Refused(refused)
    }
}

impl Transport for WorkerTransport {
    fn restart(&mut self) -> Result<(), Failure> {
        self.process = None;
        let modules = BTreeMap::from([("swm_bridge", BRIDGE), ("swm_craftax", CRAFTAX)]);
        let request = serde_json::json!({"id": self.id.id(), "options": self.id.options(), "modules": modules});
        let mut process = Process::start(self.id.id(), &self.config.python).map_err(Failure::Refused)?;
        // If the process does not receive the request, `describe` returns the error.
        if let Err(problem) = process.send(b'm', request.to_string().as_bytes()) {
            tracing::debug!("{}: its worker did not receive the first request: {problem}", self.id.id());
        }
        self.process = Some(process);
        Ok(())
    }

    fn describe(&mut self) -> Result<Description, Failure> {
        let limit = self.config.start_timeout;
        let Some(process) = &mut self.process else { return Err(Failure::Lost("its worker process is gone".into())) };
        let answer = process.wait_to_start(self.id.id(), limit).and_then(|head| process.receive(head, limit));
        let (kind, text) = answer.map_err(|problem| match self.lose(&problem, limit) {
            // A new worker would exceed the same timeout.
            Failure::Lost(how) if problem.kind() == std::io::ErrorKind::WouldBlock => {
                Failure::Refused(Error::external(format!("making the environment {}", self.id.id()), how))
            }
            failure => failure,
        })?;
        if kind != b'.' {
            self.process = None;
            return Err(self.failure(kind, text));
        }
        let description = Description::parse(&String::from_utf8_lossy(&text)).map_err(Failure::Refused)?;
        if let Some(process) = &mut self.process {
            let opened = process.open(description.size, self.config.call_timeout);
            opened.map_err(|error| Failure::Refused(Error::external("sharing memory with a worker", error)))?;
        }
        Ok(description)
    }

    fn runs_in_parallel(&self) -> bool {
        true
    }

    /// If the worker cannot receive the request, [`Transport::call`] returns the error.
    fn dispatch(&mut self, request: Request<'_>) -> bool {
        let Some(process) = &mut self.process else { return false };
        process.pending = process.pending || process.send(request.op(), request.payload()).is_ok();
        process.pending
    }

    fn call(&mut self, request: Request<'_>) -> Result<(), Failure> {
        match self.exchange(request.op(), request.payload(), self.config.call_timeout)? {
            (b'.', warnings) => {
                warn(&String::from_utf8_lossy(&warnings));
                Ok(())
            }
            (kind, text) => Err(self.failure(kind, text)),
        }
    }

    fn memory(&self) -> &[u8] {
        let process = self.process.as_ref().filter(|process| !process.pending);
        process.and_then(|process| process.memory.as_deref()).unwrap_or_default()
    }

    fn memory_mut(&mut self) -> &mut [u8] {
        let process = self.process.as_mut().filter(|process| !process.pending);
        process.and_then(|process| process.memory.as_deref_mut()).unwrap_or_default()
    }
}

impl Process {
    fn start(id: &str, python: &Python) -> swm_core::Result<Self> {
        let counted = Counted::new()?;
        let file = shared_file().map_err(|error| Error::external("making shared memory", error))?;
        let io = |error| Error::external("starting a worker", error);
        let (socket, remote) = UnixStream::pair().map_err(io)?;
        let mut command = python.script(WORKER);
        command.args([&std::process::id().to_string(), id]);
        command.stdin(Stdio::from(OwnedFd::from(remote)));
        command.stdout(Stdio::from(file.try_clone().map_err(io)?)).stderr(Stdio::piped());
        // In a separate process group, a worker gets no terminal signals. This process gets them and ends its workers.
        command.process_group(0);
        // Each worker uses at most one core, because there are as many workers as environments. Variables that are
        // already set keep their values.
        let cache = assets::folder().join("jax-cache");
        let defaults = [
            ("OMP_NUM_THREADS", "1".as_ref()),
            ("OPENBLAS_NUM_THREADS", "1".as_ref()),
            ("MKL_NUM_THREADS", "1".as_ref()),
            ("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1".as_ref()),
            ("JAX_PLATFORMS", "cpu".as_ref()),
            ("JAX_COMPILATION_CACHE_DIR", cache.as_os_str()),
            ("SDL_VIDEODRIVER", "dummy".as_ref()),
            ("SDL_AUDIODRIVER", "dummy".as_ref()),
            ("PYGAME_HIDE_SUPPORT_PROMPT", "1".as_ref()),
        ];
        // Without a display, MuJoCo's Python package can render only through EGL.
        let headless = std::env::var_os("DISPLAY").is_none().then_some(("MUJOCO_GL", "egl".as_ref()));
        for (name, value) in defaults.into_iter().chain(headless) {
            if std::env::var_os(name).is_none() {
                command.env(name, value);
            }
        }
        let mut child = spawn(command).map_err(|error| {
            Error::config("Python", format!("{python} cannot be started: {error}"), python.fix("gymnasium"))
        })?;
        let tail = Tail::of(child.stderr.take(), id);
        Ok(Self { child, socket, file, memory: None, pending: false, is_reported: false, tail, _counted: counted })
    }

    fn send(&mut self, op: u8, payload: &[u8]) -> std::io::Result<()> {
        let n = u32::try_from(payload.len()).map_err(std::io::Error::other)?;
        let mut head = [0; 5];
        head[0] = op;
        head[1..].copy_from_slice(&n.to_le_bytes());
        self.socket.write_all(&head)?;
        if payload.is_empty() { Ok(()) } else { self.socket.write_all(payload) }
    }

    /// Waits until the first answer begins. A message names after a while what it waits for.
    fn wait_to_start(&mut self, id: &str, limit: Duration) -> std::io::Result<answer::Head> {
        answer::prepare(&self.socket, limit)?;
        let report = || {
            tracing::warn!(
                "{id} is still being made (imports, compilation, a first reset and step); after {} s it is given up \
                 ($SWM_GYM_START_TIMEOUT changes this)",
                limit.as_secs()
            );
        };
        answer::head(&mut self.socket, limit, report)
    }

    /// Waits until the answer to a call begins. A message names after a while, once for each process, what it waits for.
    fn wait_for_call(&mut self, id: &str, op: u8, limit: Duration) -> std::io::Result<answer::Head> {
        let (worker, is_reported) = (self.child.id(), &mut self.is_reported);
        let report = || {
            if !std::mem::replace(is_reported, true) {
                let what = what_is_called(op);
                tracing::warn!(
                    "{id} has not answered its {what} yet (worker process {worker}); after {} s it is given up \
                     ($SWM_GYM_TIMEOUT changes this)",
                    limit.as_secs()
                );
            }
        };
        answer::head(&mut self.socket, limit, report)
    }

    /// Receives the text of an answer with this head; it may take `limit`.
    fn receive(&mut self, head: answer::Head, limit: Duration) -> std::io::Result<(u8, Vec<u8>)> {
        let [kind, n @ ..] = head;
        let n = u32::from_le_bytes(n) as usize;
        if !ANSWERS.contains(&kind) {
            return Err(violation(format!("an answer of unknown kind {kind}")));
        }
        // An environment can write to the connection, so the length may be any.
        if n > MAX_ANSWER {
            return Err(violation(format!("its answer has {n} bytes, more than {MAX_ANSWER}")));
        }
        // Most answers are empty, and an empty vector allocates nothing.
        let mut text = vec![0; n];
        if n > 0 {
            self.socket.set_read_timeout(Some(limit))?;
            self.socket.read_exact(&mut text)?;
            answer::prepare(&self.socket, limit)?;
        }
        Ok((kind, text))
    }

    /// Maps the memory that the worker allocated.
    fn open(&mut self, size: usize, limit: Duration) -> std::io::Result<()> {
        answer::prepare(&self.socket, limit)?;
        self.socket.set_write_timeout(Some(limit))?;
        seal(&self.file)?;
        let allocated = self.file.metadata()?.len();
        if allocated < size as u64 {
            return Err(std::io::Error::other(format!("the shared file has {allocated} bytes of {size}")));
        }
        self.memory = Some(map(&self.file, size)?);
        Ok(())
    }

    /// Waits for the process to end and returns its exit status; `None` after [`EXIT_TIMEOUT`].
    fn exit_status(&mut self) -> Option<std::process::ExitStatus> {
        let polls = 100;
        for _ in 0..polls {
            if let Ok(Some(status)) = self.child.try_wait() {
                return Some(status);
            }
            std::thread::sleep(EXIT_TIMEOUT / polls);
        }
        None
    }

    fn kill(&mut self) {
        // The process may have ended already.
        if let Err(problem) = self.child.kill().and_then(|()| self.child.wait()) {
            tracing::debug!("stopping a worker: {problem}");
        }
    }
}

impl Drop for Process {
    /// Gives the worker time to close its environment.
    fn drop(&mut self) {
        let closed = self.socket.shutdown(std::net::Shutdown::Write);
        if closed.and_then(|()| self.socket.set_read_timeout(Some(EXIT_TIMEOUT))).is_ok() {
            // The worker's end of the socket closes when the worker ends.
            let mut rest = [0; 64];
            while matches!(self.socket.read(&mut rest), Ok(1..)) {}
        }
        self.kill();
    }
}

/// The most different warnings of workers.
const MOST_WARNINGS: usize = 1000;

/// Warns of each line that a worker reports, once for all workers.
fn warn(lines: &str) {
    static REPORTED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    for line in lines.lines() {
        let mut reported = REPORTED.lock().unwrap_or_else(PoisonError::into_inner);
        let is_new = reported.len() < MOST_WARNINGS && reported.insert(line.to_owned());
        drop(reported);
        if is_new {
            tracing::warn!("{line}");
        }
    }
}

/// The name of a call, for messages.
fn what_is_called(op: u8) -> &'static str {
    match op {
        b'r' => "reset",
        b'p' => "rendering",
        _ => "step",
    }
}

/// The error of a worker that violates the protocol.
fn violation(problem: String) -> std::io::Error {
    std::io::Error::new(std::io::ErrorKind::InvalidData, problem)
}

/// An anonymous file in memory, which a worker sizes.
#[cfg(target_os = "linux")]
fn shared_file() -> std::io::Result<File> {
    use rustix::fs::{MemfdFlags, memfd_create};
    Ok(File::from(memfd_create("swm-gym", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?))
}

/// Fixes the size of the file for all processes, because an access to memory beyond its end is a SIGBUS.
#[cfg(target_os = "linux")]
fn seal(file: &File) -> std::io::Result<()> {
    use rustix::fs::{SealFlags, fcntl_add_seals};
    Ok(fcntl_add_seals(file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?)
}

/// An anonymous file, which a worker sizes.
#[cfg(not(target_os = "linux"))]
fn shared_file() -> std::io::Result<File> {
    tempfile::tempfile()
}

/// Only Linux can fix the size of a file.
#[cfg(not(target_os = "linux"))]
fn seal(_: &File) -> std::io::Result<()> {
    Ok(())
}

#[allow(unsafe_code, reason = "shared memory is mapped from a file")]
fn map(file: &File, size: usize) -> std::io::Result<MmapMut> {
    // SAFETY: the file is anonymous; only this process and its worker hold a descriptor of it, and `seal` has fixed its
    // size. The worker writes to the memory only between a request and its answer, when
    // this process holds no reference: `Transport::dispatch` and `call` borrow the transport mutably, and between the two
    // calls the transport returns no reference to the memory. A worker that does not answer in time is killed before the
    // memory is accessed again.
    unsafe { MmapOptions::new().len(size).map_mut(file) }
}

/// A command and the channel that receives its child.
type Job = (Command, SyncSender<std::io::Result<Child>>);

/// Starts a process from a thread that lives as long as this process, because the kernel kills a child when the
/// thread that started it ends (`PR_SET_PDEATHSIG`).
fn spawn(command: Command) -> std::io::Result<Child> {
    static STARTER: Mutex<Option<(u32, Sender<Job>)>> = Mutex::new(None);
    let (answer, child) = sync_channel(1);
    let mut starter = STARTER.lock().unwrap_or_else(PoisonError::into_inner);
    // A forked process does not have the threads of its parent.
    let current = std::process::id();
    let jobs = match &*starter {
        Some((process, jobs)) if *process == current => jobs.clone(),
        _ => {
            let (jobs, queue) = channel::<Job>();
            std::thread::Builder::new().name("swm-gym-starter".to_owned()).spawn(move || {
                for (mut command, answer) in queue {
                    // The receiver may be gone.
                    let _received = answer.send(command.spawn());
                }
            })?;
            *starter = Some((current, jobs.clone()));
            jobs
        }
    };
    drop(starter);
    jobs.send((command, answer)).map_err(std::io::Error::other)?;
    child.recv().map_err(std::io::Error::other)?
}
