//! The names of the files that training writes to the folder of a run, and the removal of a run.

use std::path::{Path, PathBuf};
use swm_core::Result;
use swm_core::files::{self, Lock};

/// The folder of the checkpoint inside the folder of a run.
pub(crate) const FOLDER: &str = "checkpoint";
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
/// The files of such a folder, as patterns of [`files::delete`].
pub(crate) const SAVED_DATA_FILES: &[&str] = &[
    COLLECTOR,
    "replay.lance/data/*.lance",
    "replay.lance/_versions/*.manifest",
    "replay.lance/_versions/latest_version_hint.json",
    "replay.lance/_transactions/*.txn",
];

/// Logs and reports of failures, as patterns of [`files::delete`].
const LOG_FILES: &[&str] = &["run.json", "train.jsonl", "events.out.tfevents.*.swm", "failed-batch.safetensors"];

/// The folders of a run that may hold a checkpoint; the empty name is the folder of the run.
const CHECKPOINT_FOLDERS: &[&str] = &[
    "",
    "checkpoint/",
    "checkpoint.new/",
    "checkpoint.old/",
    "best/checkpoint/",
    "best/checkpoint.new/",
    "best/checkpoint.old/",
    "world/checkpoint/",
    "world/checkpoint.new/",
    "world/checkpoint.old/",
];

/// Deletes the checkpoints, logs and replay data in the folder of a run; files with other names stay. Returns the entries
/// that remain; the folder is removed if none remain.
///
/// # Errors
/// When the folder is a symbolic link, a training writes to it, or a file cannot be removed.
pub fn remove(run: &Path) -> Result<Vec<PathBuf>> {
    files::check_no_link(run)?;
    let _lock = Lock::folder(run)?;
    let checkpoints =
        CHECKPOINT_FOLDERS.iter().flat_map(|folder| CHECKPOINT_FILES.iter().map(move |file| format!("{folder}{file}")));
    let saved_data = SAVED_DATA_FILES.iter().map(|file| format!("{PLAYED}*/{file}"));
    let logs = LOG_FILES.iter().map(ToString::to_string);
    let patterns: Vec<String> = checkpoints.chain(saved_data).chain(logs).collect();
    files::delete(run, &patterns.iter().map(String::as_str).collect::<Vec<_>>())
}
