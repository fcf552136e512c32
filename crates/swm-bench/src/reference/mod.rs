//! [`Reference`]: the reference implementation in a Python process.
//!
//! The scripts in this folder read requests from standard input, one per line, and answer with lines that start with
//! `SWM `.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _, Seek as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use swm_core::{Error, Result};
use swm_data::ClipSpec;

const ENVS_SCRIPT: &str = include_str!("envs.py");
const PLAN_SCRIPT: &str = include_str!("plan.py");
const MODEL_SCRIPT: &str = include_str!("model.py");
const ONLINE_SCRIPT: &str = include_str!("online.py");
const DATA_SCRIPT: &str = include_str!("data.py");

/// The environment variable that names a Python interpreter with the reference implementation.
pub const REFERENCE_PYTHON: &str = "SWM_REFERENCE_PYTHON";

/// The Python interpreter that [`REFERENCE_PYTHON`] names, if any.
pub(crate) fn reference_python() -> Option<PathBuf> {
    std::env::var_os(REFERENCE_PYTHON).filter(|path| !path.is_empty()).map(PathBuf::from)
}

/// Returns the text that a report contains instead of the reference's version if no Python is given.
pub(crate) fn not_compared() -> String {
    format!("not compared: set {REFERENCE_PYTHON} to a Python that has stable-worldmodel")
}

/// A Python process that runs a part of the reference: a `World`, a solver, a model, or datasets.
pub(crate) struct Reference {
    process: Child,
    requests: ChildStdin,
    answers: BufReader<ChildStdout>,
    log: File,
    /// The version of the reference.
    pub version: String,
}

/// The environment and the sizes of a `World` of the reference; frames are `(height, width)` pixels.
#[derive(Clone, Copy)]
pub(crate) struct Size<'a> {
    pub env: &'a str,
    pub envs: usize,
    pub image: (usize, usize),
    pub episode_steps: usize,
}

impl Reference {
    /// Starts a process with a `World` and waits until it is ready.
    ///
    /// # Errors
    /// When Python cannot be started, or the reference cannot be imported; the message contains the last line that
    /// Python wrote to standard error.
    pub fn start(python: &Path, size: Size<'_>) -> Result<Self> {
        let counts = [size.envs, size.image.0, size.image.1, size.episode_steps].map(|n| n.to_string());
        Self::spawn(python, ENVS_SCRIPT, &[&[size.env.to_owned()][..], &counts].concat())
    }

    /// Starts a process with a CEM solver and a model of precomputed costs: environments, samples, iterations, elites,
    /// horizon, and the dimension of a model step.
    ///
    /// # Errors
    /// As [`Reference::start`].
    pub fn start_solver(python: &Path, sizes: [usize; 6]) -> Result<Self> {
        Self::spawn(python, PLAN_SCRIPT, &sizes.map(|n| n.to_string()))
    }

    /// Starts a process with a LeWM; the file `weights` contains the weights and the inputs of the model.
    ///
    /// # Errors
    /// As [`Reference::start`].
    pub fn start_model(python: &Path, sizes: &serde_json::Value, weights: &Path) -> Result<Self> {
        Self::spawn(python, MODEL_SCRIPT, &[sizes.to_string(), weights.display().to_string()])
    }

    /// Starts a process with a family that is trained online.
    ///
    /// # Errors
    /// As [`Reference::start`].
    pub fn start_online(python: &Path, sizes: &serde_json::Value) -> Result<Self> {
        Self::spawn(python, ONLINE_SCRIPT, &[sizes.to_string()])
    }

    /// Starts a process that loads and converts datasets.
    ///
    /// # Errors
    /// As [`Reference::start`].
    pub fn start_data(python: &Path) -> Result<Self> {
        Self::spawn(python, DATA_SCRIPT, &[])
    }

    fn spawn(python: &Path, script: &str, arguments: &[String]) -> Result<Self> {
        // `python -c` puts the current folder first, where a file may have the name of a module.
        const ISOLATED_PATH: &str = "import sys\nif sys.path[:1] == ['']:\n    del sys.path[0]\n";
        let log =
            tempfile::tempfile().map_err(|e| Error::io("a temporary file", "creating the log of the reference", e))?;
        let errors = log.try_clone().map_err(|e| Error::io("a temporary file", "duplicating the handle", e))?;
        let mut process = Command::new(python)
            .args(["-u", "-c", &format!("{ISOLATED_PATH}{script}")])
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(errors)
            .spawn()
            .map_err(|e| Error::io(python, "starting the reference's Python", e))?;
        let (Some(requests), Some(answers)) = (process.stdin.take(), process.stdout.take()) else {
            return Err(Error::external("starting the reference", "the process has no pipes"));
        };
        let mut reference = Self { process, requests, answers: BufReader::new(answers), log, version: String::new() };
        reference.version = reference.answer()?.split_off(1).join(" ");
        Ok(reference)
    }

    /// Steps with random actions for about `seconds`; returns environment steps per second.
    pub fn step(&mut self, seconds: f64) -> Result<f64> {
        self.rate(&format!("step\t{seconds}"))
    }

    /// Steps environments without frames and without a `World`; returns environment steps per second.
    pub fn bare(&mut self, seconds: f64) -> Result<f64> {
        self.rate(&format!("bare\t{seconds}"))
    }

    /// Collects a Lance dataset; returns environment steps per second.
    pub fn collect(&mut self, path: &Path, episodes: usize, seed: u64) -> Result<f64> {
        self.rate(&format!("collect\t{}\t{episodes}\t{seed}", path.display()))
    }

    /// Plans for about `seconds`; returns iterations of the solver per second.
    pub fn solve(&mut self, seconds: f64) -> Result<f64> {
        self.rate(&format!("solve\t{seconds}"))
    }

    /// Executes a workload of the model `count` times; returns repetitions per second.
    pub fn run(&mut self, work: &str, count: usize) -> Result<f64> {
        self.rate(&format!("run\t{work}\t{count}"))
    }

    /// Executes a workload of the model and returns its outputs, flattened in row-major order.
    pub fn outputs(&mut self, work: &str) -> Result<Vec<f32>> {
        let words = self.request(&format!("outputs\t{work}"))?;
        let outputs = words.iter().map(|word| word.parse());
        outputs
            .collect::<std::result::Result<_, _>>()
            .map_err(|error| Error::external("reading an output of the reference", error))
    }

    /// Loads shuffled batches of clips with the columns `pixels` and `action` for about `seconds`; returns clips per
    /// second.
    pub fn load(
        &mut self,
        format: &str,
        path: &Path,
        workers: usize,
        clip: &ClipSpec,
        batch: usize,
        seconds: f64,
    ) -> Result<f64> {
        let (path, steps, skip) = (path.display(), clip.num_steps, clip.frameskip);
        self.rate(&format!("load\t{format}\t{path}\t{workers}\t{steps}\t{skip}\t{batch}\t{seconds}"))
    }

    /// Converts a dataset; returns conversions per second.
    pub fn convert(&mut self, source: &Path, format: &str, target: &Path) -> Result<f64> {
        self.rate(&format!("convert\t{}\t{format}\t{}", source.display(), target.display()))
    }

    /// Sends a request whose answer is a count and seconds; returns the count per second.
    fn rate(&mut self, request: &str) -> Result<f64> {
        let words = self.request(request)?;
        if let Some(("error", why)) = words.split_first().map(|(first, why)| (first.as_str(), why)) {
            return Err(Error::external("running the reference", why.join(" ")));
        }
        let values: Vec<f64> = words.iter().filter_map(|word| word.parse().ok()).collect();
        match values[..] {
            [count, seconds] if seconds > 0.0 => Ok(count / seconds),
            _ => Err(Error::external(
                "a request to the reference",
                format!("the answer is {words:?}, expected a count and seconds"),
            )),
        }
    }

    /// Sends a request and returns the words of the answer.
    fn request(&mut self, request: &str) -> Result<Vec<String>> {
        let lost = |error| Error::external("sending a request to the reference", error);
        writeln!(self.requests, "{request}").and_then(|()| self.requests.flush()).map_err(lost)?;
        self.answer()
    }

    /// Reads the words of the next answer.
    fn answer(&mut self) -> Result<Vec<String>> {
        let mut line = String::new();
        loop {
            line.clear();
            let read = self
                .answers
                .read_line(&mut line)
                .map_err(|e| Error::external("reading an answer of the reference", e))?;
            if read == 0 {
                return Err(Error::external("running the reference", self.last_line()));
            }
            if let Some(words) = line.strip_prefix("SWM ") {
                return Ok(words.split_whitespace().map(str::to_owned).collect());
            }
        }
    }

    /// The last line that the process wrote to standard error.
    fn last_line(&mut self) -> String {
        let mut log = vec![];
        // The log only explains the error, so a failure to read it is ignored.
        let _ = self.log.rewind().and_then(|()| self.log.read_to_end(&mut log));
        let text = String::from_utf8_lossy(&log);
        let last = text.lines().map(str::trim).rfind(|line| !line.is_empty());
        last.unwrap_or("the process ended without output").to_owned()
    }
}

impl Drop for Reference {
    fn drop(&mut self) {
        // Both calls fail if the process has already ended.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
