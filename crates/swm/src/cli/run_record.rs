//! `run.json` beside the manifest of a training or an evaluation: the command lines, when, where and with what they ran.
//!
//! A manifest holds what determines a result, so that equal runs have equal manifests. This file holds the rest, and no
//! hash includes it.

mod git;

use super::{Cli, train_folder};
use crate::capsule::cpu_level;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};

/// The name of the file.
pub const FILE: &str = "run.json";
/// The largest file that is read.
const MAX_BYTES: u64 = 1 << 24;

/// The arguments of the command that runs, the program's name first.
static ARGUMENTS: Mutex<Vec<String>> = Mutex::new(vec![]);

/// The content of a `run.json`.
#[derive(Default, Serialize, Deserialize)]
pub struct RunRecord {
    /// The command lines: the first, and those that continued it.
    pub commands: Vec<Invocation>,
}

/// One command line, and the machine it ran on.
#[derive(Serialize, Deserialize)]
pub struct Invocation {
    /// The arguments, the program's name first.
    pub command: Vec<String>,
    /// The program that trained, if it was another than this one, such as `stable_worldmodel.train (torch)`. The command is then the one that
    /// continues it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub program: Option<String>,
    /// The folder in which it ran.
    #[serde(serialize_with = "files::serialize_path")]
    pub folder: PathBuf,
    /// When it began, in UTC.
    pub started: String,
    /// The commit of the repository around the folder, with `-dirty` if tracked files differ; `None` outside one.
    pub git: Option<String>,
    /// The version of stable-worldmodel.
    pub version: String,
    /// Architecture, vector instructions and name of the processor, and the number of its threads.
    pub cpu: String,
    /// The operating system.
    pub os: String,
    /// Versions of third-party assets that are installed, such as MuJoCo.
    pub assets: BTreeMap<String, String>,
    /// The datasets and checkpoints of the hub that were read, with their commits.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub hub: Vec<String>,
}

/// Remembers the arguments of the command that runs. An embedding program runs several, one after the other.
pub fn remember(arguments: &[OsString]) {
    let texts = arguments.iter().map(|argument| argument.to_string_lossy().into_owned()).collect();
    *ARGUMENTS.lock().unwrap_or_else(PoisonError::into_inner) = texts;
}

/// Returns the arguments of the command that runs, the program's name first.
pub fn arguments() -> Vec<String> {
    ARGUMENTS.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// Checks, before the work, that `run.json` can be written to a folder.
///
/// # Errors
/// When the folder has a file of this name that is no record of a run.
pub fn check(folder: &Path) -> Result<()> {
    files::check_own(&folder.join(FILE), |path| read_file(path).is_ok())
}

/// Writes `run.json` to the folder of a run, which must exist. `continued` adds this command line to those that are there.
///
/// # Errors
/// When the folder has a file of this name that is no record of a run, or cannot be written to.
pub fn write(folder: &Path, continued: bool) -> Result<()> {
    append(folder, Invocation::now(), continued)
}

/// Writes `run.json` with another command line than the one that runs, such as that of the run that a cell belongs to.
///
/// # Errors
/// As [`write`].
pub fn write_command(folder: &Path, command: Vec<String>) -> Result<()> {
    append(folder, Invocation { command, ..Invocation::now() }, false)
}

/// Checks the folder of a training that another program begins, or continues.
///
/// # Errors
/// When the folder has a file `run.json` that is no record of a run, links that the training would replace, or a run that
/// `swm train` has finished.
pub fn check_training(folder: &Path, continued: bool) -> Result<()> {
    check(folder)?;
    train_folder::check_links(folder)?;
    if continued { train_folder::check_unfinished(folder, "torch") } else { Ok(()) }
}

/// Writes `run.json` to the folder of a training that another program runs. The caller holds the lock of the folder, so that the
/// file has the command lines of trainings that ran.
///
/// `command` is the command line of `swm train` with the same model, dataset and settings: `swm train --output RUN --resume`
/// repeats it. `program` is what trains.
///
/// # Errors
/// When the folder has a file of this name that is no record of a run, or cannot be written to.
pub fn record_training(folder: &Path, (command, program): (Vec<String>, &str), continued: bool) -> Result<()> {
    let path = folder.join(FILE);
    // A training of `swm train` that prepares its data holds it.
    drop(files::exists(&path)?.then(|| Lock::file(&path)).transpose()?);
    append(folder, Invocation { command, program: Some(program.to_owned()), ..Invocation::now() }, continued)
}

fn append(folder: &Path, invocation: Invocation, continued: bool) -> Result<()> {
    check(folder)?;
    files::delete_temporary(folder, |name| name == FILE)?;
    let path = folder.join(FILE);
    let mut record = if continued && path.exists() { read_file(&path)? } else { RunRecord::default() };
    record.commands.push(invocation);
    let text = serde_json::to_string_pretty(&record).map_err(|error| Error::external("writing run.json", error))?;
    files::write(&path, (text + "\n").as_bytes())
}

/// Reads the `run.json` of a run.
///
/// # Errors
/// When there is none, or it is damaged.
pub fn read(folder: &Path) -> Result<RunRecord> {
    read_file(&folder.join(FILE))
}

fn read_file(path: &Path) -> Result<RunRecord> {
    let text = files::read(path, MAX_BYTES)?;
    serde_json::from_slice(&text)
        .map_err(|error| Error::corrupt(path, format!("is no record of a run: {error}"), "move it away"))
}

impl RunRecord {
    /// Parses the first command line, as the program does; `None` if it is not one of this version.
    pub fn first(&self) -> Option<(Cli, &Path)> {
        let first = self.commands.first()?;
        let cli = super::parse(first.command.iter().map(OsString::from).collect()).ok()?;
        Some((cli, &first.folder))
    }
}

impl Invocation {
    fn now() -> Self {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let cpu = processor().map_or_else(String::new, |name| format!(", {name}"));
        let assets = swm_mujoco::assets::status()
            .filter(|(_, status)| *status == swm_mujoco::assets::Status::Installed)
            .map(|(asset, _)| (asset.name.to_owned(), asset.version.to_owned()));
        Self {
            command: arguments(),
            program: None,
            folder: std::env::current_dir().unwrap_or_default(),
            started: now(),
            git: git::commit(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            cpu: format!("{}{cpu}, {threads} threads", cpu_level()),
            os: system(),
            assets: assets.collect(),
            hub: crate::home::pinned_uris(),
        }
    }
}

/// The name of the processor, on Linux.
fn processor() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

/// The operating system, with its release on Linux.
fn system() -> String {
    let release = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    format!("{} {}", std::env::consts::OS, release.trim()).trim().to_owned()
}

/// What the clock shows, in UTC, as `2026-11-24T01:02:03Z`.
pub fn now() -> String {
    utc(SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs()))
}

/// Formats seconds since 1970 as `2026-11-24T01:02:03Z`.
fn utc(seconds: u64) -> String {
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Days from 1 March of year 0, in eras of 400 years (Hinnant, "chrono-compatible low-level date algorithms").
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 { shifted_month + 3 } else { shifted_month - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", rest / 3600, rest / 60 % 60, rest % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (seconds, date) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_795_482_458, "2026-11-24T01:07:38Z"),
            (4_107_542_399, "2100-02-28T23:59:59Z"),
        ] {
            assert_eq!(utc(seconds), date);
        }
    }

    #[test]
    fn a_record_keeps_its_command_lines_and_spares_other_files() {
        let folder = tempfile::tempdir().expect("a folder");
        write(folder.path(), false).expect("a new record");
        write(folder.path(), true).expect("a continued record");
        assert_eq!(read(folder.path()).expect("a record").commands.len(), 2);
        let left = folder.path().join(".run.json.12.tmp");
        std::fs::write(&left, "{").expect("what a kill leaves");
        record_training(folder.path(), (vec![], "torch"), true).expect("a continued training");
        assert!(!left.exists());
        let preparing = Lock::file(&folder.path().join(FILE)).expect("a training that prepares its data");
        let refused = record_training(folder.path(), (vec![], "torch"), false).expect_err("two trainings").to_string();
        assert!(refused.contains("another process writes to it"), "{refused}");
        drop(preparing);
        std::fs::write(folder.path().join(FILE), "{\"mine\": 1}").expect("writing a file");
        assert!(write(folder.path(), false).is_err());
        assert!(check_training(folder.path(), false).is_err(), "refused before the work");
        assert!(record_training(folder.path(), (vec![], "torch"), false).is_err());
    }
}
