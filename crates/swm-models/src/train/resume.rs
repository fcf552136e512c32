//! Checks that a stored run can be continued with a given configuration and dataset, and that a new run
//! replaces nothing that no run wrote.

use crate::run_folder::{CONFIG, FOLDER, NEW_FOLDER, OLD_FOLDER};
use crate::stored::{faults, is_begun, is_event_file, is_occupied, locate};
use serde::Deserialize;
use serde_json::Value;
use std::path::Path;
use swm_core::{Error, Manifest, Result, files};

/// The largest log that is recognised as that of an earlier run.
const MAX_LOG_BYTES: u64 = 1 << 30;

/// Returns the error for a new run whose output folder holds an earlier run.
pub(crate) fn refuse_existing(out: &Path) -> Error {
    Error::config(
        out.display().to_string(),
        "holds a training run already",
        "continue the run with --resume (in Python: resume=True), or choose another folder",
    )
}

/// Checks that a new run in the folder `out` replaces only what a run left that ended before its first checkpoint: its
/// log, an unfinished checkpoint, and the best checkpoint. The event file marks the folder of such a run; the configuration marks
/// an unfinished checkpoint.
///
/// # Errors
/// When the folder has a log or files of a checkpoint that no run wrote, or cannot be listed.
pub(crate) fn check_new_run(out: &Path) -> Result<()> {
    let io = |error| Error::io(out, "listing the folder", error);
    let mut has_events = false;
    for entry in std::fs::read_dir(out).map_err(io)? {
        has_events |= is_event_file(&entry.map_err(io)?.file_name().to_string_lossy());
    }
    let log = out.join("train.jsonl");
    // A link or a folder is refused where the log is opened.
    if std::fs::symlink_metadata(&log).is_ok_and(|found| found.is_file()) {
        files::check_own(&log, |path| is_log(path, has_events))?;
    }
    let current = out.join(FOLDER);
    let mut foreign = is_occupied(&current) && !current.join(CONFIG).is_file();
    foreign |= locate(out).is_none() && is_occupied(&out.join(OLD_FOLDER));
    // A training outside this program writes no event file, and its first checkpoint before any log.
    let is_foreign = |place: &Path| !has_events && is_occupied(place) && !is_begun(place);
    foreign |= is_foreign(&out.join(NEW_FOLDER));
    for inner in ["best", "world"] {
        let mut places = [FOLDER, NEW_FOLDER, OLD_FOLDER].map(|folder| out.join(inner).join(folder)).into_iter();
        foreign |=
            places.any(|place| is_foreign(&place) || (is_occupied(&place) && !has_events && locate(out).is_none()));
    }
    if foreign {
        let problem = "has files with the names of a checkpoint, and there is no checkpoint that can be read";
        return Err(Error::config(out.display().to_string(), problem, "move them away, or choose another folder"));
    }
    Ok(())
}

/// Returns whether a file is empty, or is the log of a run, whose last line a kill may have cut off.
fn is_log(path: &Path, has_events: bool) -> bool {
    #[derive(Deserialize)]
    struct Line {
        #[serde(rename = "step")]
        _step: u64,
    }
    let Ok(bytes) = files::read(path, MAX_LOG_BYTES) else { return false };
    let mut lines: Vec<&[u8]> = bytes.split(|&byte| byte == b'\n').collect();
    let last = lines.pop().unwrap_or_default();
    let is_line = |line: &&[u8]| serde_json::from_slice::<Line>(line).is_ok();
    bytes.is_empty() || (has_events && lines.iter().all(is_line) && (last.is_empty() || last.starts_with(b"{")))
}

/// Checks that a stored run has the configuration and the data of the requested run.
///
/// # Errors
/// When the configuration differs, with the settings that differ and their values, or else when the data differ.
pub(crate) fn check_same_run(path: &Path, stored: &Manifest, requested: &Manifest) -> Result<()> {
    // Other data may also change the configuration, by the colours that were found in it.
    if stored.hashes.get("dataset") != requested.hashes.get("dataset") {
        Err(differs(path, "was trained on other data", "the configuration and the data"))
    } else if stored.config != requested.config {
        let differing = differences("", &stored.config, &requested.config);
        let problem = format!("has another configuration ({})", differing.join(", "));
        Err(differs(path, &problem, "the configuration and the data"))
    } else {
        Ok(())
    }
}

/// Checks that a stored online run has the requested time limit. `stored` is `None` for a run of an earlier program, which is
/// continued with any.
///
/// # Errors
/// When the time limit differs, with both values.
pub(crate) fn check_same_time_limit(path: &Path, stored: Option<usize>, requested: usize) -> Result<()> {
    match stored.filter(|stored| *stored != requested) {
        None => Ok(()),
        Some(stored) => {
            let problem = format!("has another time limit of episodes (stored {stored} steps, requested {requested})");
            Err(differs(path, &problem, "the time limit"))
        }
    }
}

/// The error for a run that differs from the requested one.
fn differs(path: &Path, problem: &str, of: &str) -> Error {
    let fix = format!("continue with {of} of the stored run, or choose another folder");
    Error::config(path.display().to_string(), format!("the stored run {problem}"), fix)
}

/// Checks that the best checkpoint in the folder of a run, which the run compares the next ones with, is there and unchanged.
///
/// # Errors
/// When it is missing or damaged; `step` is that of the best weights.
pub(crate) fn check_best(best: &Path, step: usize) -> Result<()> {
    let fault = match faults(best) {
        Ok(faults) if faults.is_empty() => return Ok(()),
        _ if locate(best).is_none() => "are missing".to_owned(),
        Ok(faults) => format!("are damaged: {}", faults.join("; ")),
        Err(error) => format!("are damaged: {error}"),
    };
    let problem = format!("the best weights of the run, those of step {step}, {fault}");
    Err(Error::corrupt(best, problem, "copy the folder back from where you have it, or train again in another folder"))
}

/// The keys in which two configurations differ, with both values.
fn differences(prefix: &str, stored: &Value, requested: &Value) -> Vec<String> {
    match (stored, requested) {
        (Value::Object(left), Value::Object(right)) => {
            let mut keys: Vec<&String> = left.keys().chain(right.keys()).collect();
            keys.sort();
            keys.dedup();
            keys.into_iter()
                .flat_map(|key| {
                    let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                    differences(&name, left.get(key).unwrap_or(&Value::Null), right.get(key).unwrap_or(&Value::Null))
                })
                .collect()
        }
        _ if stored == requested => vec![],
        _ => vec![format!("{prefix}: stored {stored}, requested {requested}")],
    }
}
