//! The nightly checks: what takes too long for `make test`, in parts of at most two hours together.
//!
//! `make nightly` runs the parts that have not passed on this commit, and writes a row for each into `docs/nightly.md`;
//! `make nightly PART=fuzz` runs one part. A run that was stopped continues with the next part.

mod fuzz;
mod page;

use crate::root;
use anyhow::{Context as _, Result, bail};
use page::{Page, Row};
use std::fs::File;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

/// A part of the nightly checks.
struct Part {
    name: &'static str,
    /// What runs, for the page.
    what: &'static str,
    /// Time limit of the part. All limits together are two hours.
    minutes: u64,
    /// Runs the part and returns what it found.
    run: fn(&Run) -> Result<String>,
}

/// The parts, shortest first.
const PARTS: &[Part] = &[
    Part {
        name: "deny",
        what: "licences, banned libraries and sources of the dependencies (`deny.toml`)",
        minutes: 2,
        run: |run| {
            run.tool("cargo-deny")?;
            run.cargo(&["deny", "check", "licenses", "bans", "sources"], &[])?;
            Ok("no dependency refused".to_owned())
        },
    },
    Part {
        name: "loom",
        what: "the loader's queue and the pool's worker threads under all interleavings of their threads (`loom/`)",
        minutes: 4,
        run: |run| {
            let target = run.target("loom");
            run.cargo(&["test", "--release", "--manifest-path", "loom/Cargo.toml"], &[("CARGO_TARGET_DIR", target)])?;
            run.tests()
        },
    },
    Part {
        name: "soak",
        what: "more than 1,000,000 steps collected by one process, and the doctor's verdict",
        minutes: 5,
        run: soak,
    },
    Part {
        name: "asan",
        what: "tests of the crates with `unsafe` code and no C library (core, simd, kernels, image, raster, gym) under \
               AddressSanitizer",
        minutes: 14,
        run: asan,
    },
    Part {
        name: "kills",
        what: "50 kills of every command and of every writer that keeps what it stored",
        minutes: 9,
        run: |run| {
            run.cargo(
                &["test", "--release", "-p", "swm-data", "-p", "swm", "--test", "it", "kill", "--", "--ignored"],
                &[],
            )?;
            run.tests()
        },
    },
    Part {
        name: "long",
        what: "the tests that `make test` leaves out (`#[ignore]`)",
        minutes: 14,
        run: |run| {
            // Examples marked `ignore` in the documentation do not compile alone.
            let targets = ["test", "--release", "--workspace", "--lib", "--bins", "--tests"];
            let mut arguments = [&targets[..], &["--", "--ignored", "--skip", "kill"]].concat();
            if std::env::var_os("SWM_TORCH_PYTHON").is_none() {
                arguments.extend(["--skip", "exported_checkpoints_load_in_the_reference"]);
            }
            // `make test-browser` installs Chromium and runs them.
            arguments.extend(["--skip", "browser::"]);
            run.cargo(&arguments, &[])?;
            run.tests()
        },
    },
    Part {
        name: "fuzz",
        what: "ten minutes of each fuzzer of `fuzz/`, under AddressSanitizer",
        minutes: 72,
        run: fuzz::run,
    },
];

/// Where a part runs and logs.
struct Run {
    /// The folder of downloads and caches.
    cache: PathBuf,
    /// The page of the results.
    page: PathBuf,
    /// The output of the part.
    log: PathBuf,
    end: Instant,
}

/// Runs the parts of this name, or all that have not passed on this commit.
///
/// # Errors
/// When a part fails or exceeds its time limit. The other parts run nevertheless.
pub fn nightly(only: Option<&str>) -> Result<()> {
    let known: Vec<&str> = PARTS.iter().map(|part| part.name).collect();
    if let Some(name) = only.filter(|name| !known.contains(name)) {
        bail!("there is no part '{name}'; the parts are {}", known.join(", "));
    }
    let commit = commit()?;
    let cache = std::env::var_os("SWM_CACHE").map(PathBuf::from);
    let home = || std::env::home_dir().map(|home| home.join(".cache/swm"));
    let cache = cache.or_else(home).context("no home folder: name a folder in SWM_CACHE")?;
    let logs = cache.join("nightly");
    std::fs::create_dir_all(&logs).with_context(|| format!("creating {}", logs.display()))?;
    let page = root().join("docs/nightly.md");
    let mut failed = vec![];
    for part in PARTS.iter().filter(|part| only.is_none_or(|name| name == part.name)) {
        if only.is_none() && Page::read(&page)?.passed(part.name, &commit) {
            println!("{}: passed on {commit} before", part.name);
            continue;
        }
        println!("{}: {} (at most {} minutes)", part.name, part.what, part.minutes);
        let start = Instant::now();
        let end = start + Duration::from_secs(60 * part.minutes);
        let log = logs.join(format!("{}.log", part.name));
        let run = Run { cache: cache.clone(), page: page.clone(), log, end };
        File::create(&run.log).with_context(|| format!("creating {}", run.log.display()))?;
        let (passed, result) = match (part.run)(&run) {
            Ok(found) => (true, found),
            Err(error) => (false, format!("{error:#}").replace(['\n', '|'], " ")),
        };
        println!("{}: {}: {result}", part.name, if passed { "passed" } else { "FAILED" });
        if !passed {
            println!("  its output is in {}", run.log.display());
            failed.push(part.name);
        }
        let minutes = start.elapsed().as_secs_f64() / 60.0;
        let row = Row { part: part.name, what: part.what, passed, result, minutes, commit: &commit, date: date() };
        Page::update(&page, |page| page.set(row))?;
    }
    match failed.is_empty() {
        true => Ok(()),
        false => bail!("failed: {}", failed.join(", ")),
    }
}

/// The commit that is checked out, with a `+` if files other than the page differ from it.
fn commit() -> Result<String> {
    let git = |arguments: &[&str]| -> Result<String> {
        let output = Command::new("git").args(arguments).current_dir(root()).output().context("running git")?;
        Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let changed = git(&["status", "--porcelain", "--", ".", ":!docs/nightly.md"])?;
    Ok(format!("{}{}", git(&["rev-parse", "--short", "HEAD"])?, if changed.is_empty() { "" } else { "+" }))
}

/// The date in UTC, as `2026-01-31`.
fn date() -> String {
    let output = Command::new("date").args(["-u", "+%F"]).output();
    output.map_or_else(|_| "unknown".to_owned(), |output| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

impl Run {
    /// The target folder of the workspace.
    fn target_folder(&self) -> String {
        std::env::var("CARGO_TARGET_DIR").unwrap_or_else(|_| root().join("target").display().to_string())
    }

    /// The target folder of builds with other flags, next to that of the workspace.
    fn target(&self, name: &str) -> String {
        format!("{}-{name}", self.target_folder())
    }

    /// A command in the root of the repository that stops at the time limit and writes to the log.
    fn command(&self, program: &str, arguments: &[&str]) -> Result<Command> {
        let left = self.end.saturating_duration_since(Instant::now()).as_secs().max(1);
        let log = File::options().append(true).create(true).open(&self.log).context("opening the log")?;
        let mut command = Command::new("timeout");
        command.args(["--kill-after=10", &left.to_string(), program]).args(arguments).current_dir(root());
        command.stdout(log.try_clone().context("opening the log")?).stderr(log);
        crate::forget_own_package(&mut command);
        let tools = self.cache.join("tools/bin").display().to_string();
        command.env("PATH", format!("{tools}:{}", std::env::var("PATH").unwrap_or_default()));
        Ok(command)
    }

    fn check(&self, mut command: Command, what: &str) -> Result<()> {
        let status = command.status().with_context(|| format!("starting {what}"))?;
        match status.code() {
            Some(0) => Ok(()),
            Some(124 | 137) => bail!("{what} exceeded the time limit"),
            _ => bail!("{what} failed ({status})"),
        }
    }

    /// Runs cargo.
    fn cargo(&self, arguments: &[&str], variables: &[(&str, String)]) -> Result<()> {
        let mut command = self.command("cargo", arguments)?;
        command.envs(variables.iter().map(|(name, value)| (name, value)));
        self.check(command, &format!("cargo {}", arguments.join(" ")))
    }

    /// The variable with which cargo instruments the crates of the workspace. Libraries of ordinary builds are used as they
    /// are, in the same target folder.
    fn instrumented(&self) -> (&'static str, String) {
        ("RUSTC_WORKSPACE_WRAPPER", root().join("xtask/instrument.sh").display().to_string())
    }

    /// Installs a tool of cargo where it is missing.
    fn tool(&self, name: &str) -> Result<()> {
        let subcommand = name.trim_start_matches("cargo-");
        let found = self.command("cargo", &[subcommand, "--version"])?.status();
        if found.is_ok_and(|status| status.success()) {
            return Ok(());
        }
        let folder = self.cache.join("tools").display().to_string();
        self.cargo(&["install", "--locked", "--root", &folder, name], &[])
    }

    /// The number of passed tests in the log.
    fn tests(&self) -> Result<String> {
        let log = std::fs::read_to_string(&self.log).context("reading the log")?;
        let passed = log.lines().filter(|line| line.starts_with("test ") && line.ends_with("... ok")).count();
        Ok(format!("{passed} tests"))
    }
}

/// Runs the tests of crates with `unsafe` code under AddressSanitizer.
fn asan(run: &Run) -> Result<String> {
    let crates = ["swm-core", "swm-simd", "swm-kernels", "swm-image", "swm-raster", "swm-gym"];
    let packages = crates.iter().flat_map(|name| ["-p", name]);
    let all: Vec<&str> = ["test", "--release", "--lib", "--tests"].into_iter().chain(packages).collect();
    // Threads of the program that still run at its end keep their memory.
    run.cargo(&all, &[run.instrumented(), ("ASAN_OPTIONS", "detect_leaks=0".to_owned())])?;
    run.tests()
}

/// Collects a million steps in one process and watches its memory.
fn soak(run: &Run) -> Result<String> {
    /// The most memory that the process may use, in MiB; a leak of a kilobyte a step would be a gibibyte.
    const LIMIT: u64 = 1024;
    run.cargo(&["build", "--release", "-p", "swm", "--bins"], &[])?;
    let home = run.cache.join("nightly/soak");
    let program = format!("{}/release/swm", run.target_folder());
    let command = |arguments: &[&str]| -> Result<Command> {
        let mut command = run.command(&program, arguments)?;
        command.env("STABLEWM_HOME", &home);
        Ok(command)
    };
    let collect = "collect swm/TwoRoom-v1 --policy random --output soak --image 32 --episodes 11000 --max-steps 100 \
                   --overwrite --json";
    let mut child = command(&collect.split_whitespace().collect::<Vec<_>>())?.spawn().context("starting swm")?;
    let mut peak = 0;
    let status = loop {
        if let Some(status) = child.try_wait().context("waiting for swm")? {
            break status;
        }
        peak = peak.max(memory(child.id()));
        std::thread::sleep(Duration::from_millis(500));
    };
    if !status.success() {
        bail!("swm collect failed ({status})");
    }
    run.check(command(&["doctor", "soak"])?, "swm doctor")?;
    let log = std::fs::read_to_string(&run.log).context("reading the log")?;
    let steps = log.lines().rev().find_map(|line| line.trim().strip_prefix("\"steps\": ")).unwrap_or("?");
    std::fs::remove_dir_all(&home).context("removing the dataset")?;
    let found = format!("{} steps, at most {peak} MiB of memory", steps.trim_end_matches(','));
    if peak > LIMIT { bail!("{found}, of {LIMIT}") } else { Ok(found) }
}

/// The memory of the children of a process, in MiB: `timeout` starts the program as its child.
fn memory(process: u32) -> u64 {
    let children = std::fs::read_to_string(format!("/proc/{process}/task/{process}/children")).unwrap_or_default();
    let resident = |id: &str| {
        let status = std::fs::read_to_string(format!("/proc/{id}/status")).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<u64>().ok()).unwrap_or(0) >> 10
    };
    children.split_whitespace().map(resident).sum()
}
