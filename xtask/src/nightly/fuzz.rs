//! The fuzzers of `fuzz/`: builds them, runs those that ran least, and adds their times to the page.

use super::page::{Page, Totals};
use super::{Run, root};
use anyhow::{Context as _, Result, bail};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Seconds that a fuzzer runs. Every run starts with the inputs that the runs before found.
const SECONDS: u64 = 600;

/// Seconds of the part's time limit that remain after the last fuzzer.
const MARGIN: u64 = 30;

/// The shortest run that is worth its start, in seconds.
const SHORTEST: u64 = 60;

/// Builds the fuzzers and runs them, those with the shortest time on the page first, one per processor, until the time of the
/// part has passed.
pub fn run(run: &Run) -> Result<String> {
    run.cargo(&["build", "--release", "-p", "swm-fuzz", "--features", "libfuzzer"], &[run.instrumented()])?;
    let programs = Path::new(&run.target_folder()).join("release");
    let totals = Page::read(&run.page)?;
    let mut names = names()?;
    names.sort_by(|a, b| totals.minutes(a).total_cmp(&totals.minutes(b)));
    let (queue, ended) = (Mutex::new(names.iter()), Mutex::new(vec![]));
    let at_once = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..at_once {
            scope.spawn(|| {
                while let Some(seconds) = seconds_left(run) {
                    let next = queue.lock().unwrap_or_else(PoisonError::into_inner).next();
                    let Some(name) = next else { return };
                    let outcome = fuzz(&programs.join(name), name, &run.cache.join("fuzz"), seconds);
                    let mut ended = ended.lock().unwrap_or_else(PoisonError::into_inner);
                    // The page is written under the lock.
                    ended.push((name.as_str(), outcome.and_then(|totals| record(run, name, totals))));
                }
            });
        }
    });
    verdict(ended.into_inner().unwrap_or_else(PoisonError::into_inner))
}

/// The seconds that the next fuzzer may run; `None` if the part has no time for it.
fn seconds_left(run: &Run) -> Option<u64> {
    let left = run.end.saturating_duration_since(Instant::now()).as_secs().saturating_sub(MARGIN);
    Some(left.min(SECONDS)).filter(|&seconds| seconds >= SHORTEST)
}

/// Adds the totals of a run to the page. A finding is an error.
fn record(run: &Run, name: &str, totals: Totals) -> Result<()> {
    Page::update(&run.page, |page| page.add(name, totals))?;
    if totals.findings > 0 {
        bail!("a finding, in {}", run.cache.join("fuzz/findings").join(name).display());
    }
    Ok(())
}

/// The result of the part: the fuzzers that ran, or those that failed.
fn verdict(mut ended: Vec<(&str, Result<()>)>) -> Result<String> {
    if ended.is_empty() {
        bail!("building the fuzzers took all the time; run this part again");
    }
    ended.sort_by_key(|(name, _)| *name);
    let ran: Vec<&str> = ended.iter().map(|(name, _)| *name).collect();
    let ran = format!("{} ran at most {} minutes each", ran.join(", "), SECONDS / 60);
    let failed = ended.iter().filter_map(|(name, outcome)| Some(format!("{name}: {:#}", outcome.as_ref().err()?)));
    match failed.collect::<Vec<_>>()[..] {
        [] => Ok(ran),
        ref failed => bail!("{}; {ran}", failed.join("; ")),
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
    let child = command(program)
        .arg(&corpus)
        .args([format!("-max_total_time={seconds}"), format!("-artifact_prefix={}/", findings.display())])
        .arg("-print_final_stats=1")
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
    let found = !output.status.success() && !slow_by_load(program, &log)?;
    Ok(Totals { minutes, inputs, findings: u64::from(found) })
}

/// A fuzzer with the limits of time and memory for one input. It keeps all seeds: those that replace a file of a dataset by
/// itself reach the same code, so that it would keep the smallest only.
fn command(program: &Path) -> Command {
    let mut command = Command::new(program);
    command.args(["-malloc_limit_mb=256", "-rss_limit_mb=4096", "-timeout=30", "-print_funcs=0", "-keep_seed=1"]);
    command
}

/// Whether the fuzzer stopped at an input that passes when it runs again: the time limit includes the time in which a loaded
/// machine runs other programs. Removes such an input from the findings.
fn slow_by_load(program: &Path, log: &str) -> Result<bool> {
    let Some(input) = timed_out(log) else { return Ok(false) };
    let again = command(program).arg(input).stdout(Stdio::null()).stderr(Stdio::null()).status();
    let passed = again.with_context(|| format!("starting {}", program.display()))?.success();
    if passed {
        std::fs::remove_file(input).with_context(|| format!("removing {input}"))?;
    }
    Ok(passed)
}

/// The file of the input that exceeded the time limit.
fn timed_out(log: &str) -> Option<&str> {
    let written = log.lines().find_map(|line| Some(line.split_once("Test unit written to ")?.1));
    written.filter(|_| log.contains("ERROR: libFuzzer: timeout"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::anyhow;

    #[test]
    fn result_names_the_fuzzers_that_ran_and_those_that_failed() {
        let passed = verdict(vec![("npz", Ok(())), ("hdf5", Ok(()))]).expect("no failure");
        assert_eq!(passed, "hdf5, npz ran at most 10 minutes each");
        let failed = verdict(vec![("npz", Ok(())), ("hdf5", Err(anyhow!("a finding")))]).expect_err("a failure");
        assert_eq!(failed.to_string(), "hdf5: a finding; hdf5, npz ran at most 10 minutes each");
        assert!(verdict(vec![]).is_err());
    }

    #[test]
    fn only_inputs_that_exceed_the_time_limit_run_again() {
        let log =
            |error: &str| format!("artifact_prefix='/f/'; Test unit written to /f/input-1\n==7== ERROR: {error}\n");
        assert_eq!(timed_out(&log("libFuzzer: timeout after 70 seconds")), Some("/f/input-1"));
        assert_eq!(timed_out(&log("AddressSanitizer: heap-buffer-overflow")), None);
    }
}
