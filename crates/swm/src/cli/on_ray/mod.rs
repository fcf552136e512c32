//! `--on ray`: hands the cells of a command over to a Ray cluster (`docs/ray.md`).
//!
//! The command checks its options, describes its cells as a request in JSON, and gives the request to the Python package
//! `stable_worldmodel.ray`, which runs every cell as a Ray task: this program with arguments of the command.

pub mod collect;
pub mod convert;
pub mod eval;
mod eval_parts;
pub mod study;
pub mod train;

use super::{Context, emit_json, run_record, signals};
use clap::Args;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::Write as _;
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::str::FromStr;
use std::sync::atomic::Ordering;
use std::time::Duration;
use swm_core::{Error, Result};
use swm_data::{Location, objects};
use swm_gym::Python;

/// The time between two looks at whether a run has ended or the user stops it.
const LOOK: Duration = Duration::from_millis(50);

/// The options of a command that can run on a Ray cluster.
#[derive(Args, Clone, Default)]
pub struct OnRayArgs {
    /// Run on a Ray cluster: ray, or ray://HOST:PORT of its dashboard
    ///
    /// `ray` joins the cluster of this machine, or starts one. ray://HOST:PORT submits a job to another cluster (default
    /// port: 8265). The same command continues a run that was interrupted. docs/ray.md has the details.
    #[arg(long, value_name = "CLUSTER")]
    on: Option<Cluster>,
    /// What one cell takes, such as gpu=1,cpu=4 (default: cpu=1)
    #[arg(long, value_name = "NAME=COUNT", requires = "on")]
    resources: Option<Resources>,
    /// Seconds to wait for a node that has the resources (default: 60)
    ///
    /// The run ends with an error if no node of the cluster has them and none joins in this time. While an autoscaler starts
    /// nodes, the time begins anew.
    #[arg(long, value_name = "SECONDS", requires = "on")]
    wait: Option<u32>,
    /// Folder of the run's records: a path on a shared disk, or a URI
    ///
    /// Default: the output with the suffix .ray
    #[arg(long, value_name = "FOLDER", requires = "on")]
    run_folder: Option<String>,
    /// Print the request and run nothing
    #[arg(long, hide = true, requires = "on")]
    print_request: bool,
}

/// A Ray cluster.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Cluster {
    /// That of this machine, which is started if there is none.
    Local,
    /// The address of a dashboard.
    Jobs(String),
}

impl FromStr for Cluster {
    type Err = String;

    fn from_str(given: &str) -> std::result::Result<Self, String> {
        if given == "ray" {
            return Ok(Self::Local);
        }
        let wrong = || format!("'{given}' is no Ray cluster: write ray, or ray://HOST:PORT with the dashboard's port");
        let address = given.strip_prefix("ray://").filter(|address| !address.is_empty()).ok_or_else(wrong)?;
        let safe = |c: char| c.is_ascii_alphanumeric() || ".-_:[]".contains(c);
        if !address.chars().all(safe) {
            return Err(wrong());
        }
        let has_port = address.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
        Ok(Self::Jobs(if has_port { format!("http://{address}") } else { format!("http://{address}:8265") }))
    }
}

/// What one cell takes of a node, by Ray's names.
#[derive(Clone, Debug, PartialEq)]
struct Resources(BTreeMap<String, f64>);

impl FromStr for Resources {
    type Err = String;

    fn from_str(given: &str) -> std::result::Result<Self, String> {
        let mut counts = BTreeMap::new();
        for part in given.split(',') {
            let count = part.split_once('=').and_then(|(name, count)| Some((name.trim(), count.parse::<f64>().ok()?)));
            let (name, count) = count
                .filter(|(name, count)| !name.is_empty() && (0.0..=1e15).contains(count))
                .ok_or_else(|| format!("'{part}' is no resource: write NAME=COUNT, such as cpu=4"))?;
            if counts.insert(name.to_lowercase(), count).is_some() {
                return Err(format!("{name} is given twice"));
            }
        }
        Ok(Self(counts))
    }
}

/// The work of a command, for the Python package.
pub struct Request<'a> {
    /// The kind of the cells: `collect`, `convert`, `eval`, `study` or `train`.
    pub kind: &'static str,
    /// What is written: a path or a URI.
    pub output: &'a str,
    /// Options of the command that every cell replaces, besides those of this module.
    pub replaced: &'a [&'a str],
    /// What the cells are, by the kind.
    pub cells: Value,
}

impl OnRayArgs {
    /// Whether the command runs on a cluster.
    pub fn is_given(&self) -> bool {
        self.on.is_some()
    }

    /// Refuses options of the command that have no effect on a cluster.
    ///
    /// # Errors
    /// When one of them is given.
    pub fn refuse(&self, options: &[(&str, bool)], fix: &str) -> Result<()> {
        match options.iter().find(|(_, given)| *given) {
            Some((option, _)) => Err(Error::config(*option, "has no effect together with --on", fix)),
            None => Ok(()),
        }
    }

    /// The folder of the run's records.
    fn folder(&self, output: &str) -> String {
        let default = || format!("{}.ray", output.trim_end_matches('/'));
        self.run_folder.as_deref().map_or_else(default, absolute)
    }

    /// Whether this output belongs to a run that was begun.
    ///
    /// # Errors
    /// When the folder of the run cannot be read.
    pub fn has_begun(&self, output: &str) -> Result<bool> {
        let request = Location::parse(&format!("{}/request.json", self.folder(&absolute(output))))?;
        Ok(objects::read_file(&request)?.is_some())
    }

    /// Refuses an output that has one of these files or folders, unless the run was begun. The cells check again what they
    /// replace.
    ///
    /// # Errors
    /// When there is one, or the output cannot be read.
    pub fn check_new(&self, output: &str, names: &[&str]) -> Result<()> {
        let output = absolute(output);
        if self.has_begun(&output)? {
            return Ok(());
        }
        let found = match Location::parse(&output)? {
            Location::Path(folder) if folder.exists() && !folder.is_dir() => {
                return Err(Error::config(output, "is not a folder", "give a folder with --output"));
            }
            Location::Path(folder) => names.iter().find(|name| is_there(&folder.join(name))),
            location @ Location::Uri(_) => {
                let files = objects::list_files(&location)?;
                let is_below = |file: &String, name: &str| {
                    file.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
                };
                names.iter().find(|name| files.iter().any(|file| is_below(file, name)))
            }
        };
        let fix = "move it away, or choose another output";
        match found {
            Some(name) => Err(Error::config(format!("{output}/{name}"), "exists and was not written by this run", fix)),
            None => Ok(()),
        }
    }

    /// Gives the request to the Python package, and waits until it has run.
    ///
    /// # Errors
    /// When there is no Python with Ray, the run fails, or the user stops it.
    pub fn submit(&self, request: &Request<'_>, context: &Context) -> anyhow::Result<()> {
        let output = absolute(request.output);
        let directory = std::env::current_dir().unwrap_or_default();
        let Some(directory) = directory.to_str() else {
            let (problem, fix) =
                ("its path is not UTF-8, and Ray receives it as text", "run the command in another folder");
            return Err(Error::config(format!("the current folder {}", directory.display()), problem, fix).into());
        };
        let own = ["--on", "--resources", "--wait", "--run-folder"];
        let replaced: Vec<&str> = own.iter().chain(request.replaced).copied().collect();
        let resources =
            self.resources.clone().map_or_else(|| BTreeMap::from([("cpu".to_owned(), 1.0)]), |given| given.0);
        let mut body = json!({
            "layout": 1,
            "kind": request.kind,
            "version": env!("CARGO_PKG_VERSION"),
            "arguments": without(&run_record::arguments(), &replaced, &["--json", "--print-request"]),
            "directory": directory,
            "output": output,
            "folder": self.folder(&output),
            "resources": resources,
            "cells": request.cells,
        });
        if let Some(seconds) = self.wait {
            body["wait"] = json!(seconds);
        }
        if self.print_request {
            return emit_json(&body);
        }
        let python = python()?;
        let mut command = python.module("stable_worldmodel.ray");
        command.arg("-");
        if let Some(Cluster::Jobs(address)) = &self.on {
            command.args(["--job", address]);
        }
        if context.json {
            command.arg("--json");
        }
        let failed = |error| Error::external(format!("running {python}"), error);
        let mut child = start(&mut command).map_err(failed)?;
        if let Some(mut stdin) = child.stdin.take() {
            // If the program ends before it reads, its exit code says why.
            let _ = stdin.write_all(body.to_string().as_bytes());
        }
        let mut told = false;
        let status = loop {
            if let Some(status) = child.try_wait().map_err(failed)? {
                break status;
            }
            if !told && context.interrupt.load(Ordering::SeqCst) {
                told = true;
                interrupt(&child);
            }
            std::thread::sleep(LOOK);
        };
        Ok(outcome(status, told, &self.folder(&output))?)
    }
}

/// Returns how the run with the records in `folder` ended, from the status of the program that runs the cells. `told` says
/// whether it was told to end.
fn outcome(status: ExitStatus, told: bool, folder: &str) -> Result<()> {
    let problem = match (status.code(), status.signal()) {
        (Some(0), _) => return Ok(()),
        (Some(130), _) => return Err(Error::Interrupted),
        // Python that does not catch Ctrl-C yet ends by its signal.
        (_, Some(signal)) if told || signal == libc::SIGINT => return Err(Error::Interrupted),
        (_, Some(signal)) => format!("signal {signal} ended the Python process that runs it"),
        _ => "the run ended with the error above".to_owned(),
    };
    let fix = "correct its cause and give the same command again: finished cells are kept";
    Err(Error::config(format!("the run {folder}"), problem, fix))
}

/// Whether a path names anything but an empty folder.
fn is_there(path: &Path) -> bool {
    match std::fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_some()),
        found => found.is_ok(),
    }
}

/// Starts the program that runs the cells. It ends when this process does. The signals of a terminal go to this process only,
/// which hands them over.
#[allow(unsafe_code, reason = "asking the kernel for a signal is a function of the C library")]
fn start(command: &mut Command) -> std::io::Result<Child> {
    command.stdin(Stdio::piped()).process_group(0);
    signals::react_to_interrupts(command);
    // SAFETY: `prctl` may be called between fork and exec.
    #[cfg(target_os = "linux")]
    unsafe {
        command.pre_exec(|| {
            libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGTERM);
            Ok(())
        });
    }
    command.spawn()
}

/// Sends Ctrl-C to the program that runs the cells.
#[allow(unsafe_code, reason = "sending a signal is a function of the C library")]
fn interrupt(child: &Child) {
    // SAFETY: the child has not been waited for, so its id is its own.
    unsafe { libc::kill(child.id().cast_signed(), libc::SIGINT) };
}

/// A local path as an absolute path; a URI unchanged.
fn absolute(given: &str) -> String {
    match Location::parse(given) {
        Ok(Location::Path(path)) => {
            std::path::absolute(&path).map_or_else(|_| given.to_owned(), |path| path.to_string_lossy().into_owned())
        }
        _ => given.trim_end_matches('/').to_owned(),
    }
}

/// Arguments without the program's name, these options with their values, and these flags.
fn without(arguments: &[String], options: &[&str], flags: &[&str]) -> Vec<String> {
    let (mut left, mut arguments) = (vec![], arguments.iter().skip(1));
    while let Some(argument) = arguments.next() {
        if flags.contains(&argument.as_str()) {
            continue;
        }
        if options.contains(&argument.as_str()) {
            arguments.next();
            continue;
        }
        // `--name=value`, and `-nvalue` of an option with one letter.
        let joined = options.iter().any(|option| match argument.strip_prefix(option) {
            Some(rest) => rest.starts_with('=') || (option.len() == 2 && !argument.starts_with("--")),
            None => false,
        });
        if !joined {
            left.push(argument.clone());
        }
    }
    left
}

/// Finds a Python with Ray and this package.
fn python() -> Result<Python> {
    let own = std::env::var_os("SWM_RAY_PYTHON").filter(|value: &OsString| !value.is_empty());
    let python =
        own.map_or_else(Python::find, |program| Python { program: program.into(), origin: "named by $SWM_RAY_PYTHON" });
    let fix = "install it there with pip install \"stable-worldmodel-rs[ray]\", or set SWM_RAY_PYTHON to a Python that has it";
    let missing = |problem: String| Error::config(format!("--on ray with {python}"), problem, fix);
    let script =
        "import importlib.util as u; print(*[n for n in ('ray', 'stable_worldmodel') if u.find_spec(n) is None])";
    let output = python.script(script).stdin(Stdio::null()).output();
    let output = output.map_err(|error| missing(format!("it cannot be started ({error})")))?;
    let names = String::from_utf8_lossy(&output.stdout);
    match names.split_whitespace().next() {
        _ if !output.status.success() => {
            let text = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            Err(missing(format!("it does not run ({text})")))
        }
        Some(name) => Err(missing(format!("it has no package {name}"))),
        None => Ok(python),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clusters_are_this_machine_or_the_address_of_a_dashboard() {
        assert_eq!("ray".parse(), Ok(Cluster::Local));
        assert_eq!("ray://head:8300".parse(), Ok(Cluster::Jobs("http://head:8300".to_owned())));
        assert_eq!("ray://head".parse(), Ok(Cluster::Jobs("http://head:8265".to_owned())));
        for wrong in ["slurm", "ray://", "ray:head", "ray://a b"] {
            assert!(wrong.parse::<Cluster>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn ctrl_c_interrupts_a_python_that_does_not_catch_it() {
        let ended = |signal, told| outcome(ExitStatus::from_raw(signal), told, "run");
        for (signal, told) in [(libc::SIGINT, false), (libc::SIGINT, true), (libc::SIGTERM, true)] {
            assert!(matches!(ended(signal, told), Err(Error::Interrupted)), "signal {signal}");
        }
        let error = ended(libc::SIGKILL, false).expect_err("a signal").to_string();
        assert!(error.contains("signal 9 ended"), "{error}");
        assert!(ended(0, true).is_ok());
    }

    #[test]
    fn resources_are_named_counts() {
        let found: Resources = "gpu=1,CPU=0.5".parse().expect("resources");
        assert_eq!(found.0, BTreeMap::from([("cpu".to_owned(), 0.5), ("gpu".to_owned(), 1.0)]));
        for wrong in ["", "gpu", "gpu=x", "gpu=-1", "=1", "cpu=1,cpu=2"] {
            assert!(wrong.parse::<Resources>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn arguments_lose_the_options_that_cells_replace() {
        let arguments = "swm --json collect Env -o a --on ray --output=b -oc --outputs d --episodes 3 -- e";
        let arguments: Vec<String> = arguments.split(' ').map(str::to_owned).collect();
        let left = without(&arguments, &["--on", "-o", "--output"], &["--json"]);
        assert_eq!(left.join(" "), "collect Env --outputs d --episodes 3 -- e");
    }
}
