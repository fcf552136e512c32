//! [`Mark`]: tells whether a dataset that is opened again is the one that was opened before.

use super::reader::{Reader, StepRange};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, Result};

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

/// The columns of a dataset and their values in the first and the last row of the first `episodes` episodes; images only if there
/// is nothing else.
pub(super) fn first_and_last_row(reader: &(impl Reader + ?Sized), episodes: usize) -> Result<String> {
    let data = || reader.schema().columns().iter().filter(|column| ![EPISODE_IDX, STEP_IDX].contains(&&*column.name));
    let numeric: Vec<&ColumnSpec> = data().filter(|column| !column.is_image()).collect();
    let compared = if numeric.is_empty() { data().collect() } else { numeric };
    let names: Vec<&str> = compared.iter().map(|column| column.name.as_str()).collect();
    let episodes = &reader.episodes()[..episodes];
    let has_rows = |&index: &usize| episodes[index].length > 0;
    let first = (0..episodes.len()).find(has_rows).map(|index| StepRange::new(index, 0, 1));
    let last = (0..episodes.len()).rfind(has_rows).map(|index| StepRange::new(index, episodes[index].length - 1, 1));
    let values = reader.read(&names, &first.into_iter().chain(last).collect::<Vec<_>>())?;
    let mut hasher = blake3::Hasher::new();
    for (index, spec) in compared.iter().enumerate() {
        hasher.update(format!("{} {:?} {:?}", spec.name, spec.dtype, spec.shape).as_bytes());
        hasher.update(values.bytes(index));
    }
    Ok(hasher.finalize().to_hex().to_string())
}
