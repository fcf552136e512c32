//! Checkpoints in object stores: a copy on this machine for each version of their files.

use std::path::PathBuf;
use swm_core::{Error, Result, files, manifest};
use swm_data::{Location, objects};

/// The folder of the copies.
const CACHE: &str = "remote";

/// Returns the path of a copy of a checkpoint, a folder or a capsule, in an object store. Files that are there already are not
/// copied again.
///
/// # Errors
/// When the store has no such checkpoint or cannot be reached, or the copy cannot be written.
pub fn fetch(given: &str) -> Result<PathBuf> {
    let given = given.trim_end_matches('/');
    let mut found = objects::list_versions(&Location::parse(given)?)?;
    found.retain(|(name, _)| is_of_checkpoint(name));
    if found.is_empty() {
        let fix = "check the URI: that of the folder of a run, or of a capsule";
        return Err(Error::config(given, "there is no checkpoint", fix));
    }
    let key = manifest::hash(format!("{given}\n{found:?}").as_bytes());
    // A capsule is one file, which the empty name stands for; its path keeps its name.
    let name = given.rsplit('/').next().unwrap_or_default();
    let root = swm_core::home::folder()?.join(CACHE).join(&key[..32]).join(name);
    for (file, _) in &found {
        let (path, uri) = match file.as_str() {
            "" => (root.clone(), given.to_owned()),
            file => (root.join(file), format!("{given}/{file}")),
        };
        if path.exists() {
            continue;
        }
        let gone = || Error::config(&uri, "it was removed while it was read", "run the command again");
        let bytes = objects::read_file(&Location::parse(&uri)?)?.ok_or_else(gone)?;
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, "creating the folder", error))?;
        }
        // Another process may write the same bytes meanwhile: files are replaced as a whole.
        files::write(&path, &bytes)?;
    }
    Ok(root)
}

/// Whether a file in the folder of a run belongs to its checkpoint; logs and replay data do not.
fn is_of_checkpoint(name: &str) -> bool {
    let folder = name.split('/').next().unwrap_or_default();
    name.is_empty() || (name.contains('/') && !folder.starts_with("played-")) || name.ends_with(".json")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logs_and_replay_data_are_not_copied() {
        for name in ["", "checkpoint/weights.safetensors", "best/checkpoint/config.json", "run.json"] {
            assert!(is_of_checkpoint(name), "{name}");
        }
        for name in ["train.jsonl", "events.out.tfevents.1.swm", "played-100/replay.lance/data/a.lance"] {
            assert!(!is_of_checkpoint(name), "{name}");
        }
    }
}
