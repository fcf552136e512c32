//! [`Opened`]: tells whether the dataset at a path is still the one that a reader has opened.

use super::set_aside::Places;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;
use swm_core::{Error, Result};

/// A dataset of column files that is open. Its reader opens files by name when they are needed, and another process may
/// replace the dataset in between: columns that were read before would stand beside those of the other one.
pub struct Opened {
    folder: PathBuf,
    metadata: PathBuf,
    born: Option<(u64, SystemTime)>,
    state: Mutex<Option<State>>,
    /// How often the dataset had been replaced when it was opened.
    pub replaced: u64,
}

/// What changes whenever a file is written anew: its number, its time and its size.
type State = (u64, SystemTime, u64);

impl Opened {
    /// The dataset in a folder, before its metadata is read, which says how often it was replaced.
    pub fn new(folder: &Path, places: &Places) -> Self {
        let metadata = folder.join(places.metadata);
        let state = Mutex::new(state(&metadata));
        Self { born: born(folder), folder: folder.to_owned(), metadata, state, replaced: 0 }
    }

    /// Checks, after something was read, that it belongs to the dataset that was opened. `replaced` reads how often the
    /// dataset has been replaced; it is called only if the metadata was written again, as a writer that appends does.
    ///
    /// # Errors
    /// If the dataset was replaced or is gone.
    pub fn check(&self, replaced: impl FnOnce() -> Result<u64>) -> Result<()> {
        let now = state(&self.metadata);
        let is_same_folder = born(&self.folder) == self.born;
        let mut known = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if is_same_folder && now.is_some() && now == *known {
            return Ok(());
        }
        if is_same_folder && now.is_some() && replaced()? == self.replaced {
            *known = now;
            return Ok(());
        }
        Err(Error::corrupt(&self.folder, "it was replaced since the dataset was opened", "open the dataset again"))
    }
}

#[cfg(unix)]
fn number(metadata: &std::fs::Metadata) -> u64 {
    std::os::unix::fs::MetadataExt::ino(metadata)
}

#[cfg(not(unix))]
fn number(_: &std::fs::Metadata) -> u64 {
    0
}

fn state(path: &Path) -> Option<State> {
    let metadata = path.metadata().ok()?;
    Some((number(&metadata), metadata.modified().ok()?, metadata.len()))
}

/// The number of a folder and the time when it was made, which not every file system knows.
fn born(folder: &Path) -> Option<(u64, SystemTime)> {
    let metadata = folder.metadata().ok()?;
    Some((number(&metadata), metadata.created().unwrap_or(SystemTime::UNIX_EPOCH)))
}
