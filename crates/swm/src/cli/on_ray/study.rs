//! What is checked before the datasets of a study are collected: its output, which other studies and other files must not be in.

use super::{OnRayArgs, absolute};
use serde::Deserialize;
use serde::de::IgnoredAny;
use std::path::Path;
use swm_core::results::Until;
use swm_core::{Error, Result, files};
use swm_data::{Location, objects};

/// The largest `study.json`, in bytes.
const MAX_BYTES: u64 = 256 << 20;

/// The fields by which a `study.json` is recognised.
#[derive(Deserialize)]
struct Stored {
    title: String,
    #[serde(rename = "cells")]
    _cells: Vec<IgnoredAny>,
    until: Option<Until>,
}

/// Refuses an output that has another study, or files and no study, and a fixed number of episodes in that of a study which a rule
/// ended. On a cluster, an output whose run was begun is accepted.
///
/// # Errors
/// When it has, or cannot be read.
pub fn check_output(output: &str, title: &str, until: Option<Until>, on: &OnRayArgs) -> Result<()> {
    const FILE: &str = "study.json";
    if on.is_given() && on.has_begun(output)? {
        return Ok(());
    }
    let output = absolute(output);
    let other = |problem: String| Error::config(&output, problem, "give another folder with --output");
    let stored = match Location::parse(&format!("{output}/{FILE}"))? {
        Location::Path(path) if path.exists() => Some(files::read(&path, MAX_BYTES)?),
        Location::Path(_) => None,
        location @ Location::Uri(_) => objects::read_file(&location)?.map(|bytes| bytes.to_vec()),
    };
    let Some(bytes) = stored else {
        let has_files = match Location::parse(&output)? {
            Location::Path(path) if path.exists() => has_files(&path)?,
            Location::Path(_) => false,
            location @ Location::Uri(_) => !objects::list_files(&location)?.is_empty(),
        };
        return if has_files { Err(other(format!("has files and no {FILE}"))) } else { Ok(()) };
    };
    let Ok(found) = serde_json::from_slice::<Stored>(&bytes) else {
        let fix = "move it away, or choose another path";
        return Err(Error::config(format!("{output}/{FILE}"), "exists and was not written by this program", fix));
    };
    if found.title != title {
        return Err(other(format!("holds the study '{}', not '{title}'", found.title)));
    }
    match found.until {
        Some(rule) if until.is_none() => {
            let problem = format!("holds a study that ran with --until {rule}");
            let fix = "intervals for a fixed number of episodes do not hold for it: give --until again, or another folder with \
                       --output";
            Err(Error::config(&output, problem, fix))
        }
        _ => Ok(()),
    }
}

/// Whether a folder has files, without those that a kill leaves of writing one.
fn has_files(folder: &Path) -> Result<bool> {
    let io = |error| Error::io(folder, "reading the folder", error);
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        let name = name.to_string_lossy();
        if !(name.starts_with('.') && name.ends_with(".tmp")) {
            return Ok(true);
        }
    }
    Ok(false)
}
