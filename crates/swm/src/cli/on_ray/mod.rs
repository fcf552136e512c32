//! `--on ray`: hands the cells of a command over to a Ray cluster (`docs/ray.md`).
//!
//! The command checks its options, describes its cells as a request in JSON, and gives the request to the Python package
//! `stable_worldmodel.ray`, which runs every cell as a Ray task: this program with arguments of the command.

pub mod collect;
pub mod convert;
pub mod eval;
pub mod train;

use super::{emit_json, run_record};
use clap::Args;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::Write as _;
use std::process::{Command, Stdio};
use std::str::FromStr;
use swm_core::{Error, Result};
use swm_data::{Location, objects};
use swm_gym::Python;

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

    /// Gives the request to the Python package, and waits until it has run.
    ///
    /// # Errors
    /// When there is no Python with Ray, or the run fails.
    pub fn submit(&self, request: &Request<'_>, json_output: bool) -> anyhow::Result<()> {
        let output = absolute(request.output);
        let own = ["--on", "--resources", "--run-folder"];
        let replaced: Vec<&str> = own.iter().chain(request.replaced).copied().collect();
        let resources =
            self.resources.clone().map_or_else(|| BTreeMap::from([("cpu".to_owned(), 1.0)]), |given| given.0);
        let body = json!({
            "layout": 1,
            "kind": request.kind,
            "version": env!("CARGO_PKG_VERSION"),
            "arguments": without(&run_record::arguments(), &replaced, &["--json", "--print-request"]),
            "directory": std::env::current_dir().unwrap_or_default(),
            "output": output,
            "folder": self.folder(&output),
            "resources": resources,
            "cells": request.cells,
        });
        if self.print_request {
            return emit_json(&body);
        }
        let python = python()?;
        let mut command = Command::new(&python.program);
        command.args(["-m", "stable_worldmodel.ray", "-"]);
        if let Some(Cluster::Jobs(address)) = &self.on {
            command.args(["--job", address]);
        }
        if json_output {
            command.arg("--json");
        }
        let failed = |error| Error::external(format!("running {python}"), error);
        let mut child = command.stdin(Stdio::piped()).spawn().map_err(failed)?;
        if let Some(mut stdin) = child.stdin.take() {
            // If the program ends before it reads, its exit code says why.
            let _ = stdin.write_all(body.to_string().as_bytes());
        }
        match child.wait().map_err(failed)?.code() {
            Some(0) => Ok(()),
            Some(130) => Err(Error::Interrupted.into()),
            _ => {
                let problem = "the run ended with the error above";
                let fix = "correct its cause and give the same command again: finished cells are kept";
                Err(Error::config(format!("the run {}", self.folder(&output)), problem, fix).into())
            }
        }
    }
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
    let output = Command::new(&python.program).args(["-c", script]).stdin(Stdio::null()).output();
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
