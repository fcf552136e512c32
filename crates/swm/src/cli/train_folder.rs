//! Checks of the folder of a training before the work: links that it would write through, and finished runs of another program.
//! The record of a training there, which goes again if the training is refused.

use super::run_record;
use serde_json::Value;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::DirEntry;
use std::path::Path;
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};
use swm_models::StoredCheckpoint;
use swm_models::run_folder::{FOLDER, NEW_FOLDER, OLD_FOLDER};

/// The largest state of a run that is read.
const MAX_STATE: u64 = 1 << 24;
/// What a training writes to the folder of a run, beside the data of an online run.
const NAMES: &[&str] = &[FOLDER, NEW_FOLDER, OLD_FOLDER, "best", "world", "train.jsonl", "failed-batch.safetensors"];
/// The start of the names of folders with the data of an online run.
const PLAYED: &str = "played-";

/// The record that a training wrote to its folder, with what the folder held before.
pub struct Record<'a> {
    run: &'a Path,
    /// Keeps other trainings away while this one has not locked the folder yet, or no more.
    _lock: Lock,
    earlier: Option<Vec<u8>>,
    content: BTreeSet<(OsString, u64)>,
}

impl<'a> Record<'a> {
    /// Writes the record of a run before its first step, so that the run can be continued from it. A folder that holds another
    /// run keeps its record: the training refuses it.
    ///
    /// # Errors
    /// When the folder has links that the training would replace, PyTorch has finished the run that is to continue, or the record
    /// cannot be written.
    pub fn write(run: &'a Path, resume: bool) -> Result<Option<Self>> {
        check_links(run)?;
        if resume {
            check_unfinished(run, "burn")?;
        }
        let path = run.join(run_record::FILE);
        if !resume && path.exists() && StoredCheckpoint::read(run).is_ok() {
            return Ok(None);
        }
        run_record::check(run)?;
        // Another training that runs in the folder keeps its record as well, and so does one that prepares its data.
        let _folder = Lock::folder(run)?;
        drop(path.exists().then(|| Lock::file(&path)).transpose()?);
        let earlier = files::exists(&path)?.then(|| files::read(&path, MAX_STATE)).transpose()?;
        let written = run_record::write(run, resume);
        // The error of the record is the one to report.
        let _ = written.is_err().then(|| files::remove_empty_folder(run));
        written?;
        Ok(Some(Self { run, _lock: Lock::file(&path)?, earlier, content: content(run) }))
    }

    /// Puts the earlier record back, or deletes the new one and the empty folder, if the training failed before it wrote
    /// anything, such as one that was refused: it begins or continues a log. An interrupted training keeps its record.
    pub fn withdraw(&self, error: &Error) {
        let lock = (!matches!(error, Error::Interrupted)).then(|| Lock::folder(self.run).ok()).flatten();
        if lock.is_none() || content(self.run) != self.content {
            return;
        }
        // The error of the training is the one to report.
        let _ = match &self.earlier {
            Some(text) => files::write(&self.run.join(run_record::FILE), text),
            None => files::delete(self.run, &[run_record::FILE]).and_then(|_| files::remove_empty_folder(self.run)),
        };
    }
}

/// The names in a folder, with the sizes of the files.
fn content(folder: &Path) -> BTreeSet<(OsString, u64)> {
    let size = |entry: &DirEntry| entry.metadata().map_or(0, |metadata| metadata.len());
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| (entry.file_name(), size(&entry))).collect()
}

/// Checks that nothing that a training writes is a symbolic link. It could not replace a linked folder at its first checkpoint,
/// or would write to where the link points. The folder of the run itself may be one.
///
/// # Errors
/// When there is such a link, or the folder cannot be listed.
pub fn check_links(run: &Path) -> Result<()> {
    for folder in [run.to_owned(), run.join("best"), run.join("world")] {
        let Ok(entries) = std::fs::read_dir(&folder) else { continue };
        for entry in entries {
            let entry = entry.map_err(|error| Error::io(&folder, "listing the folder", error))?;
            let (name, path) = (entry.file_name(), entry.path());
            let name = name.to_string_lossy();
            let is_written = name == run_record::FILE || NAMES.contains(&&*name) || name.starts_with(PLAYED);
            if is_written && entry.file_type().is_ok_and(|kind| kind.is_symlink()) {
                let fix = "move what it points to in its place, or make the folder of the run itself a link";
                let problem = "is a symbolic link, and a training replaces what has this name";
                return Err(Error::config(path.display().to_string(), problem, fix));
            }
        }
    }
    Ok(())
}

/// Checks that a run that is continued is not a finished one of a program with another library: with nothing left to train, its
/// checkpoint would be written again and name the wrong program. `library` is the one of the program that continues.
///
/// # Errors
/// When the run is such a one.
pub fn check_unfinished(run: &Path, library: &str) -> Result<()> {
    let Ok(stored) = StoredCheckpoint::read(run) else { return Ok(()) };
    let manifest = stored.manifest();
    let Some((other, program)) = [("torch", "PyTorch (python -m stable_worldmodel.train)"), ("burn", "`swm train`")]
        .into_iter()
        .find(|(other, _)| *other != library && manifest.libraries.contains_key(*other))
    else {
        return Ok(());
    };
    let states = [FOLDER, OLD_FOLDER].map(|folder| run.join(folder).join("state.json"));
    let state = states.iter().find_map(|path| files::read(path, MAX_STATE).ok());
    let state: Value = state.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default();
    let (Some(done), Some(steps)) = (state["step"].as_u64(), manifest.config["schedule"]["steps"].as_u64()) else {
        return Ok(());
    };
    let patience = manifest.config["validation"]["patience"].as_u64().unwrap_or(0);
    let stopped_early = patience > 0 && state["looks"].as_u64().unwrap_or(0) >= patience;
    if done < steps && !stopped_early {
        return Ok(());
    }
    let version = manifest.libraries.get(other).map_or("", String::as_str);
    let problem = format!("is a finished run of {program}, {other} {version}, with {done} of {steps} steps");
    let fix = "nothing is left to train, and nothing was changed: use it as it is, or train longer in another folder";
    Err(Error::config(run.display().to_string(), problem, fix))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn links_that_a_training_would_replace_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let (run, other) = (folder.path().join("run"), folder.path().join("other"));
        check_links(&run).expect("a folder that does not exist");
        fs::create_dir_all(run.join("best")).expect("creating folders");
        fs::create_dir(&other).expect("creating a folder");
        symlink(&other, run.join("notes")).expect("making a link");
        check_links(&run).expect("a link of the user");
        for name in ["checkpoint", "run.json", "train.jsonl", "played-20", "best/.checkpoint.new"] {
            symlink(&other, run.join(name)).expect("making a link");
            let error = check_links(&run).expect_err(name).to_string();
            assert!(error.contains(name) && error.contains("symbolic link"), "{error}");
            fs::remove_file(run.join(name)).expect("removing the link");
        }
        fs::remove_dir(run.join("best")).expect("removing a folder");
        symlink(&other, run.join("best")).expect("making a link");
        assert!(check_links(&run).is_err());
    }
}
