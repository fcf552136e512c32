//! The names of the files that training writes to the folder of a run, and the removal of a run.

use crate::train::failed_batch;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};
use swm_data::FORMATS;

/// The folder of the checkpoint inside the folder of a run.
pub const FOLDER: &str = "checkpoint";
/// The folder in which a checkpoint is written before it replaces [`FOLDER`]. Hidden, as the next one, because users keep copies in
/// folders such as `checkpoint.old`.
pub const NEW_FOLDER: &str = ".checkpoint.new";
/// The folder of the checkpoint that [`FOLDER`] replaces, until it is deleted.
pub const OLD_FOLDER: &str = ".checkpoint.old";
/// Family, configuration and statistics of the dataset.
pub(crate) const CONFIG: &str = "config.json";
/// Provenance, and the hashes of the other files.
pub(crate) const MANIFEST: &str = "manifest.json";
/// The weights of the model.
pub(crate) const WEIGHTS: &str = "weights.safetensors";
/// The trained weights, where [`WEIGHTS`] holds their moving average.
pub(crate) const RAW: &str = "raw.safetensors";
/// The state of the optimizer.
pub(crate) const OPTIMIZER: &str = "optimizer.safetensors";
/// The state of the run.
pub(crate) const STATE: &str = "state.json";
/// The folder of the world model inside the folder of an inverse-dynamics run.
pub(crate) const WORLD_MODEL: &str = "world";
/// The files of a checkpoint.
pub(crate) const CHECKPOINT_FILES: &[&str] = &[CONFIG, MANIFEST, WEIGHTS, RAW, OPTIMIZER, STATE];
/// The files of a checkpoint, and what a kill leaves of [`files::write`], as patterns of [`files::delete`].
pub(crate) const CHECKPOINT_PATTERNS: &[&str] = &[
    CONFIG,
    MANIFEST,
    WEIGHTS,
    RAW,
    OPTIMIZER,
    STATE,
    ".config.json.*.tmp",
    ".manifest.json.*.tmp",
    ".weights.safetensors.*.tmp",
    ".raw.safetensors.*.tmp",
    ".optimizer.safetensors.*.tmp",
    ".state.json.*.tmp",
];

/// The file with the weights of the checkpoint in the folder of a run.
pub fn weights(run: &Path) -> PathBuf {
    run.join(FOLDER).join(WEIGHTS)
}

/// The start of the name of a folder with the data of an online run; the gradient step follows.
pub(crate) const PLAYED: &str = "played-";
/// The replay buffer in such a folder: a Lance dataset.
pub(crate) const REPLAY: &str = "replay.lance";
/// The state of the episodes in such a folder.
pub(crate) const COLLECTOR: &str = "place.json";
/// Logs and reports of failures, as patterns of [`files::delete`].
const LOG_FILES: &[&str] = &["run.json", ".run.json.*.tmp", "train.jsonl", "events.out.tfevents.*.swm"];

/// The folders of a run that may hold a checkpoint; the empty name is the folder of the run.
const CHECKPOINT_FOLDERS: &[&str] = &[
    "",
    "checkpoint/",
    ".checkpoint.new/",
    ".checkpoint.old/",
    "best/checkpoint/",
    "best/.checkpoint.new/",
    "best/.checkpoint.old/",
    "world/checkpoint/",
    "world/.checkpoint.new/",
    "world/.checkpoint.old/",
];

/// The folders with the data of an online run in the folder of a run, sorted.
///
/// # Errors
/// When the folder cannot be listed.
pub(crate) fn saved_data(run: &Path) -> Result<Vec<PathBuf>> {
    let io = |error| Error::io(run, "listing the folder of a run", error);
    let is_step = |step: &str| !step.is_empty() && step.bytes().all(|byte| byte.is_ascii_digit());
    let mut folders = vec![];
    for entry in std::fs::read_dir(run).map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.file_name();
        let is_played = name.to_str().and_then(|name| name.strip_prefix(PLAYED)).is_some_and(is_step);
        if is_played && entry.file_type().map_err(io)?.is_dir() {
            folders.push(entry.path());
        }
    }
    folders.sort();
    Ok(folders)
}

/// Deletes the replay buffer and the state of the episodes in a folder of [`saved_data`], then the folder if it is empty.
/// Of the replay buffer, only files that it names, or that are named by the hash of their content, are deleted.
///
/// # Errors
/// When the replay buffer is damaged, or a file cannot be removed. A missing folder is not an error.
pub(crate) fn remove_saved_data(folder: &Path) -> Result<()> {
    files::check_no_link(folder)?;
    let replay = folder.join(REPLAY);
    if replay.exists() {
        FORMATS.get("lance")?.remove(&replay)?;
    }
    files::delete(folder, &[COLLECTOR])?;
    files::remove_empty_folder(folder)
}

/// Deletes the checkpoints, logs and replay data in the folder of a run; files with other names stay. Returns the entries
/// that remain; the folder is removed if none remain.
///
/// # Errors
/// When the folder or one of a checkpoint in it is a symbolic link, a training writes to it, or a file cannot be removed.
pub fn remove(run: &Path) -> Result<Vec<PathBuf>> {
    // What is behind a link stays.
    CHECKPOINT_FOLDERS.iter().try_for_each(|folder| files::check_no_link(&run.join(folder)))?;
    let _lock = Lock::folder(run)?;
    let checkpoints = CHECKPOINT_FOLDERS
        .iter()
        .flat_map(|folder| CHECKPOINT_PATTERNS.iter().map(move |file| format!("{folder}{file}")));
    let logs = LOG_FILES.iter().map(ToString::to_string);
    let patterns: Vec<String> = checkpoints.chain(logs).collect();
    for folder in saved_data(run)? {
        match remove_saved_data(&folder) {
            // The files of a damaged replay buffer are unknown, so they stay.
            Err(Error::Corrupt { .. }) => {}
            removed => removed?,
        }
    }
    let failed = run.join(failed_batch::FILE);
    if failed_batch::is_own(&failed) {
        files::delete_named(run, &[failed_batch::FILE.into()])?;
    }
    let mut remaining = files::delete(run, &patterns.iter().map(String::as_str).collect::<Vec<_>>())?;
    // A kill right after the folder of a checkpoint was made leaves it empty.
    let new = run.join(NEW_FOLDER);
    if remaining.contains(&new) {
        files::remove_empty_folder(&new)?;
        remaining.retain(|path| *path != new || path.exists());
        files::remove_empty_folder(run)?;
    }
    Ok(remaining)
}
