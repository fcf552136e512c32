//! [`Mark`]: tells whether a dataset that is opened again is the one that was opened before.

use super::reader::Reader;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use swm_core::Result;

/// What another process or machine compares when it opens a dataset that this one has opened: the lengths of the episodes and
/// [`Reader::identity`]. Episodes that are added later change nothing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark {
    episodes: usize,
    hash: String,
}

impl Mark {
    /// The mark of a dataset.
    ///
    /// # Errors
    /// If what is compared cannot be read.
    pub fn of(reader: &dyn Reader) -> Result<Self> {
        let episodes = reader.episodes().len();
        Ok(Self { episodes, hash: hash(reader, episodes)? })
    }

    /// Checks that a dataset is the one of the mark.
    ///
    /// # Errors
    /// If it is another one, or what is compared cannot be read.
    pub fn check(&self, reader: &dyn Reader) -> Result<()> {
        if reader.episodes().len() >= self.episodes && hash(reader, self.episodes)? == self.hash {
            return Ok(());
        }
        let path = reader.sources().into_iter().next().unwrap_or_else(|| PathBuf::from("dataset"));
        Err(crate::formats::replaced(&path))
    }
}

fn hash(reader: &dyn Reader, episodes: usize) -> Result<String> {
    let mut hasher = blake3::Hasher::new();
    reader.episodes()[..episodes].iter().for_each(|episode| _ = hasher.update(&(episode.length as u64).to_le_bytes()));
    hasher.update(reader.identity(episodes)?.as_bytes());
    Ok(hasher.finalize().to_hex().to_string())
}
