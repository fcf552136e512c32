//! The contract for reading episodes: [`Reader`] and the types it uses.
//!
//! A dataset is a sequence of episodes; an episode is a sequence of rows. Row `t` holds the observation at step `t` and
//! the action that follows this observation. The last row of an episode is its final observation; its action is NaN
//! (float) or -1 (integer).

use super::identity::sampled_rows;
use std::collections::BTreeMap;
use std::path::PathBuf;
use swm_core::{Batch, ColumnSpec, Manifest, Result, Schema};

/// Named bytes that are constant over an episode, such as the XML of its scene. Text is UTF-8.
pub type Constants = BTreeMap<String, Vec<u8>>;

/// One episode of a dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Episode {
    /// Value of the episode in the column `episode_idx`.
    pub index: i64,
    /// Number of rows, including the final observation.
    pub length: usize,
}

/// Consecutive rows of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepRange {
    /// Position of the episode in [`Reader::episodes`].
    pub episode: usize,
    /// First row, counted from the start of the episode.
    pub start: usize,
    /// Number of rows.
    pub length: usize,
}

impl StepRange {
    /// `length` rows of an episode, starting at row `start`.
    pub const fn new(episode: usize, start: usize, length: usize) -> Self {
        Self { episode, start, length }
    }
}

/// A defect of a dataset that only its format can detect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Irregularity {
    /// Position of the affected episode in [`Reader::episodes`]; `None` if the whole dataset is affected.
    pub episode: Option<usize>,
    /// Human-readable description.
    pub what: String,
}

/// Reads episodes. Several threads may read at the same time.
pub trait Reader: Send + Sync {
    /// The columns: `episode_idx`, `step_idx`, then the written columns with their original types.
    fn schema(&self) -> &Schema;

    /// The episodes, in stored order.
    fn episodes(&self) -> &[Episode];

    /// Reads the rows of all `ranges` of one column into `out`, one after another, in the given order. Callers pass all
    /// ranges of a batch in one call, because formats merge and parallelise the reads of a call.
    ///
    /// # Shapes
    /// `out` is `[rows, shape…]` in bytes, with the column's shape and type. Images are decoded to
    /// `[height, width, 3]` bytes.
    ///
    /// # Errors
    /// If the column or a row does not exist, `out` has another length, or the stored data is damaged.
    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()>;

    /// Reads the rows of all `ranges` of several columns, as [`Reader::read_column`] does for one column.
    ///
    /// # Errors
    /// As [`Reader::read_column`].
    fn read(&self, columns: &[&str], ranges: &[StepRange]) -> Result<Batch> {
        let specs: Result<Vec<ColumnSpec>> = columns.iter().map(|name| self.schema().column(name).cloned()).collect();
        let rows = ranges.iter().fold(0_usize, |rows, range| rows.saturating_add(range.length));
        let mut batch = Batch::try_zeros(&Schema::new(specs?)?, rows)?;
        for (i, name) in columns.iter().enumerate() {
            self.read_column(name, ranges, batch.bytes_mut(i))?;
        }
        Ok(batch)
    }

    /// The constants of the episode at this position of [`Reader::episodes`]. Empty if the format does not store
    /// constants.
    ///
    /// # Errors
    /// If the stored data is damaged.
    fn constants(&self, _episode: usize) -> Result<Constants> {
        Ok(Constants::new())
    }

    /// Defects that do not prevent reading and that only the format can detect: rows that belong to no episode, stored
    /// step indices that do not count up, unreferenced files. `swm doctor` reports them.
    ///
    /// # Errors
    /// If the stored data is damaged.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        Ok(vec![])
    }

    /// Compares the files with the hashes that are known of them, where reading rows does not: Lance tables in object stores.
    ///
    /// # Errors
    /// If a file has another hash, or cannot be read.
    fn check_files(&self) -> Result<()> {
        Ok(())
    }

    /// The paths and URIs of the datasets that this reader reads, none of which may be replaced meanwhile. Empty if it reads
    /// memory.
    fn sources(&self) -> Vec<PathBuf> {
        vec![]
    }

    /// The parts of a third-party dataset that are not read, because they are neither numbers nor images: text, complex
    /// numbers, groups and soft links of HDF5.
    fn unread(&self) -> Vec<String> {
        vec![]
    }

    /// The manifest, which records the provenance of the data, if the dataset stores one.
    fn manifest(&self) -> Option<Manifest>;

    /// Bytes on disk per part of the dataset (usually a column), largest first.
    ///
    /// # Errors
    /// If the dataset's files cannot be listed.
    fn footprint(&self) -> Result<Vec<(String, u64)>>;

    /// A BLAKE3 hash of the content: names and types of the columns, lengths of the episodes, and every stored value in
    /// column and row order (images as their encoded bytes). The division of the content into files does not affect the
    /// hash.
    ///
    /// # Errors
    /// If the stored data is damaged.
    fn content_hash(&self) -> Result<String>;

    /// What tells the first `episodes` episodes from those of another dataset with the same lengths: equal for a copy of the files,
    /// and after this program added episodes. Cheaper than [`Reader::content_hash`], and no proof: by default, the values of
    /// some rows; the formats say what else. Other after another program wrote the same rows into other files.
    ///
    /// # Errors
    /// If the stored data is damaged.
    fn identity(&self, episodes: usize) -> Result<String> {
        sampled_rows(self, episodes)
    }

    /// A key for caches of decoded rows, which datasets share: equal keys mean equal rows, whatever program wrote the files. It is
    /// [`Reader::content_hash`], except where that is only stated by the files.
    ///
    /// # Errors
    /// If the stored data is damaged.
    fn cache_key(&self) -> Result<String> {
        self.content_hash()
    }
}
