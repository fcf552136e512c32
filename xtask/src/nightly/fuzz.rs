//! The fuzzers of `fuzz/`: builds them, runs two at a time, and adds their times to the page.

use super::page::{Page, Totals};
use super::{Run, root};
use anyhow::{Context as _, Result, bail};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Fuzzers that run at the same time.
const AT_ONCE: u64 = 2;

/// Seconds that a fuzzer runs at most.
const LONGEST: u64 = 300;

/// Builds the fuzzers and runs each for an equal part of the time that is left.
pub fn run(run: &Run, page: &mut Page) -> Result<String> {
    run.tool("cargo-fuzz")?;
    let target = run.target("fuzz");
    run.cargo_nightly(&["fuzz", "build", "--codegen-units", "16"], &[("CARGO_TARGET_DIR", &target)])?;
    let programs = Path::new(&target).join("x86_64-unknown-linux-gnu/release");
    let names = names()?;
    let left = run.end.saturating_duration_since(Instant::now()).as_secs();
    let rounds = (names.len() as u64).div_ceil(AT_ONCE);
    let seconds = (left / rounds.max(1)).saturating_sub(10).min(LONGEST);
    if seconds == 0 {
        bail!("building the fuzzers took all the time; run this part again");
    }
    let (queue, found) = (Mutex::new(names.iter()), Mutex::new(vec![]));
    std::thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| {
                loop {
                    let next = queue.lock().unwrap_or_else(PoisonError::into_inner).next();
                    let Some(name) = next else { return };
                    let outcome = fuzz(&programs.join(name), name, &run.cache.join("fuzz"), seconds);
                    found.lock().unwrap_or_else(PoisonError::into_inner).push((name, outcome));
                }
            });
        }
    });
    let mut failures = vec![];
    for (name, outcome) in found.into_inner().unwrap_or_else(PoisonError::into_inner) {
        match outcome {
            Ok(totals) => {
                page.add(name, totals);
                if totals.findings > 0 {
                    failures.push(format!("{name} (see {})", run.cache.join("fuzz/findings").join(name).display()));
                }
            }
            Err(error) => failures.push(format!("{name}: {error:#}")),
        }
    }
    match failures.is_empty() {
        true => Ok(format!("{} fuzzers, {seconds} seconds each", names.len())),
        false => bail!("{}", failures.join("; ")),
    }
}

/// The names of the fuzzers.
fn names() -> Result<Vec<String>> {
    let path = root().join("fuzz/Cargo.toml");
    let text = std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
    let manifest: toml::Table = text.parse().with_context(|| format!("parsing {}", path.display()))?;
    let bins = manifest.get("bin").and_then(|bins| bins.as_array()).context("fuzz/Cargo.toml has no fuzzers")?;
    Ok(bins.iter().filter_map(|bin| Some(bin.get("name")?.as_str()?.to_owned())).collect())
}

/// Runs a fuzzer. Its corpus stays in `folder` for the next run; an input with a finding is stored there too.
fn fuzz(program: &Path, name: &str, folder: &Path, seconds: u64) -> Result<Totals> {
    let (corpus, findings) = (folder.join("corpus").join(name), folder.join("findings").join(name));
    for path in [&corpus, &findings] {
        std::fs::create_dir_all(path).with_context(|| format!("creating {}", path.display()))?;
    }
    let start = Instant::now();
    let child = Command::new(program)
        .arg(&corpus)
        .args([format!("-max_total_time={seconds}"), format!("-artifact_prefix={}/", findings.display())])
        .args(["-malloc_limit_mb=256", "-rss_limit_mb=4096", "-timeout=30", "-print_final_stats=1"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("starting {}", program.display()))?;
    let memory = PathBuf::from(format!("/dev/shm/swm-fuzz-{}", child.id()));
    let output = child.wait_with_output().context("waiting for the fuzzer")?;
    let log = String::from_utf8_lossy(&output.stderr);
    std::fs::write(folder.join(format!("{name}.log")), log.as_bytes()).context("writing the log of the fuzzer")?;
    if memory.exists() {
        std::fs::remove_dir_all(&memory).with_context(|| format!("removing {}", memory.display()))?;
    }
    let inputs = log.lines().find_map(|line| line.strip_prefix("stat::number_of_executed_units:"));
    let inputs = inputs.and_then(|text| text.trim().parse().ok()).unwrap_or(0);
    let minutes = start.elapsed().as_secs_f64() / 60.0;
    Ok(Totals { minutes, inputs, findings: u64::from(!output.status.success()) })
}
