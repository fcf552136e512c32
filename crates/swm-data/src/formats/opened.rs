//! [`Opened`]: tells whether the dataset at a path is still the one that a reader has opened.

use super::set_aside::Places;
use std::borrow::Cow;
use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;
use swm_core::{Error, Result, files};

/// A dataset of column files that is open. Its reader opens files by name when they are needed, and another process may
/// replace the dataset in between: columns that were read before would stand beside those of the other one.
pub struct Opened {
    folder: PathBuf,
    metadata: PathBuf,
    born: Option<(u64, SystemTime)>,
    state: Mutex<Option<State>>,
}

/// What changes whenever a file is written anew: its number, its time and its size.
pub type State = (u64, SystemTime, u64);

impl Opened {
    /// The dataset in a folder, before its metadata is read.
    pub fn new(folder: &Path, places: &Places) -> Self {
        let metadata = folder.join(places.metadata);
        let state = Mutex::new(state(&metadata));
        Self { born: born(folder), folder: folder.to_owned(), metadata, state }
    }

    /// Checks, after something was read, that it belongs to the dataset that was opened. `is_same` compares the dataset that is
    /// there now; it is called only if the metadata was written again, as a writer that appends does.
    ///
    /// # Errors
    /// If the dataset was replaced or is gone.
    pub fn check(&self, is_same: impl FnOnce() -> Result<bool>) -> Result<()> {
        let now = state(&self.metadata);
        let is_same_folder = born(&self.folder) == self.born;
        let mut known = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if is_same_folder && now.is_some() && now == *known {
            return Ok(());
        }
        if is_same_folder && now.is_some() && is_same()? {
            *known = now;
            return Ok(());
        }
        Err(replaced(&self.folder))
    }
}

/// The error of a dataset that was replaced.
pub fn replaced(path: &Path) -> Error {
    Error::corrupt(path, "its files were replaced since the dataset was opened", "open the dataset again")
}

/// The error of reading videos, which are opened again for every read: that of a video that is missing, if one is.
pub fn or_missing<'a>(error: Error, mut videos: impl Iterator<Item = Cow<'a, Path>>) -> Error {
    match videos.find(|path| files::exists(path).is_ok_and(|exists| !exists)) {
        Some(path) => Error::corrupt(path, "the video is missing", "move it back, or restore it from a copy"),
        None => error,
    }
}

/// Whether a dataset was never replaced; then its metadata do not count it.
pub fn is_zero(replaced: &u64) -> bool {
    *replaced == 0
}

#[cfg(unix)]
fn number(metadata: &Metadata) -> u64 {
    std::os::unix::fs::MetadataExt::ino(metadata)
}

#[cfg(not(unix))]
fn number(_: &Metadata) -> u64 {
    0
}

/// The state of a file; `None` if it is gone.
pub fn state(path: &Path) -> Option<State> {
    state_of(&path.metadata().ok()?)
}

/// The state of a file with this metadata.
pub fn state_of(metadata: &Metadata) -> Option<State> {
    Some((number(metadata), metadata.modified().ok()?, metadata.len()))
}

/// The number of a folder and the time when it was made, which not every file system knows.
fn born(folder: &Path) -> Option<(u64, SystemTime)> {
    let metadata = folder.metadata().ok()?;
    Some((number(&metadata), metadata.created().unwrap_or(SystemTime::UNIX_EPOCH)))
}
