//! [`Mark`]: tells whether a dataset that is opened again is the one that was opened before.

use super::reader::{Reader, StepRange};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, Error, Result};

/// What another process or machine compares when it opens a dataset that this one has opened: the lengths of the episodes, the
/// types of the columns, and their values in the first and the last row. Images are compared only if there is nothing else.
/// Episodes and columns that are added later change nothing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark {
    episodes: usize,
    columns: Vec<String>,
    hash: String,
}

impl Mark {
    /// The mark of a dataset.
    ///
    /// # Errors
    /// If a row cannot be read.
    pub fn of(reader: &dyn Reader) -> Result<Self> {
        let data = || reader.schema().columns().iter().filter(|column| ![EPISODE_IDX, STEP_IDX].contains(&&*column.name));
        let numeric: Vec<&ColumnSpec> = data().filter(|column| !column.is_image()).collect();
        let compared = if numeric.is_empty() { data().collect() } else { numeric };
        let columns: Vec<String> = compared.into_iter().map(|column| column.name.clone()).collect();
        let episodes = reader.episodes().len();
        let hash = hash(reader, &columns, episodes)?;
        Ok(Self { episodes, columns, hash })
    }

    /// Checks that a dataset is the one of the mark.
    ///
    /// # Errors
    /// If it is another one, or a row cannot be read.
    pub fn check(&self, reader: &dyn Reader) -> Result<()> {
        let replaced = || {
            let path = reader.sources().into_iter().next().unwrap_or_else(|| PathBuf::from("dataset"));
            Error::corrupt(path, "it was replaced since the dataset was opened", "open the dataset again")
        };
        let has_columns = self.columns.iter().all(|name| reader.schema().column(name).is_ok());
        if !has_columns || reader.episodes().len() < self.episodes {
            return Err(replaced());
        }
        if hash(reader, &self.columns, self.episodes)? == self.hash { Ok(()) } else { Err(replaced()) }
    }
}

/// The hash of the lengths of the first `episodes` episodes, and of the types of columns and their values in the first and the
/// last row of these episodes.
fn hash(reader: &dyn Reader, columns: &[String], episodes: usize) -> Result<String> {
    let episodes = &reader.episodes()[..episodes];
    let mut hasher = blake3::Hasher::new();
    episodes.iter().for_each(|episode| _ = hasher.update(&(episode.length as u64).to_le_bytes()));
    let has_rows = |&index: &usize| episodes[index].length > 0;
    let first = (0..episodes.len()).find(has_rows).map(|index| StepRange::new(index, 0, 1));
    let last = (0..episodes.len()).rfind(has_rows).map(|index| StepRange::new(index, episodes[index].length - 1, 1));
    let rows: Vec<StepRange> = first.into_iter().chain(last).collect();
    let names: Vec<&str> = columns.iter().map(String::as_str).collect();
    let values = reader.read(&names, &rows)?;
    for (index, spec) in values.schema().columns().iter().enumerate() {
        hasher.update(format!("{} {:?} {:?}", spec.name, spec.dtype, spec.shape).as_bytes());
        hasher.update(values.bytes(index));
    }
    Ok(hasher.finalize().to_hex().to_string())
}
