//! The contracts of a dataset: [`Reader`], [`Writer`], and [`Format`], the registry row that says how one
//! layout on disk is recognised, opened and created.
//!
//! A dataset is a sequence of episodes; an episode is a run of rows. Row `t` holds the observation at `t` and
//! the action taken *from* it. The last row of an episode is its final observation; its action is NaN (float)
//! or -1 (integer).

use crate::{ImageCodec, Location, lance, lance_video, lerobot, video};

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use swm_core::{Batch, ColumnSpec, Error, Manifest, Named, Registry, Result, Schema};

/// What to do with a dataset that is already there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WriteMode {
    /// Refuse: the dataset must be new.
    #[default]
    Create,
    /// Continue it, or make it when there is none.
    Append,
    /// Replace it.
    Overwrite,
}

/// When finished episodes are committed: as soon as one of the limits is reached. A killed process loses at
/// most the episodes of one group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CommitPolicy {
    /// Episodes in a group.
    pub episodes: usize,
    /// Bytes in a group, after encoding; also bounds the writer's memory.
    pub bytes: usize,
    /// Time since the last commit, looked at when an episode arrives.
    pub interval: Duration,
}

impl Default for CommitPolicy {
    fn default() -> Self {
        Self { episodes: usize::MAX, bytes: 64 << 20, interval: Duration::from_secs(2) }
    }
}

/// How a dataset is written.
#[derive(Clone, Debug, Default)]
pub struct WriteOptions {
    /// What to do with a dataset that is already there.
    pub mode: WriteMode,
    /// How pictures are encoded.
    pub codec: ImageCodec,
    /// Where the data come from; stored with them. When appending, it replaces the one stored before.
    pub manifest: Option<Manifest>,
    /// When finished episodes are committed.
    pub commit: CommitPolicy,
}

/// What is the same in every step of an episode and no number, such as the XML of its scene: named bytes (text is
/// UTF-8).
pub type Constants = BTreeMap<String, Vec<u8>>;

/// Stores episodes as they finish. What was committed survives a killed process; dropping a writer commits
/// the rest as well, but only [`Writer::finish`] can say that it failed.
pub trait Writer: Send {
    /// Adds one complete episode and what is the same in all of its steps. The columns `episode_idx` and `step_idx`,
    /// should the batch carry them, are numbered by the writer.
    ///
    /// # Errors
    /// When the columns differ from the writer's schema, the episode breaks the time convention (the last
    /// action NaN or -1, all others finite), a number does not fit its stored type, or the disk refuses.
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()>;

    /// Adds one complete episode without [`Constants`].
    ///
    /// # Errors
    /// As [`Writer::write_episode_with`].
    fn write_episode(&mut self, episode: &Batch) -> Result<()> {
        self.write_episode_with(episode, &Constants::new())
    }

    /// Episodes in the dataset: those present before, and those written, committed or about to be.
    fn episodes(&self) -> usize;

    /// Commits what is not yet committed.
    ///
    /// # Errors
    /// When the disk refuses, or somebody else changed the dataset meanwhile.
    fn finish(self: Box<Self>) -> Result<()>;
}

/// One episode of a dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Episode {
    /// Its number in the column `episode_idx`.
    pub index: i64,
    /// Its rows, the final observation included.
    pub length: usize,
}

/// A run of rows of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepRange {
    /// The episode's position in [`Reader::episodes`].
    pub episode: usize,
    /// The first row, counted from the episode's first.
    pub start: usize,
    /// How many rows.
    pub length: usize,
}

impl StepRange {
    /// A run of rows.
    pub const fn new(episode: usize, start: usize, length: usize) -> Self {
        Self { episode, start, length }
    }
}

/// Something wrong that only the format can tell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Irregularity {
    /// The position of the episode it is about, if it is about one.
    pub episode: Option<usize>,
    /// What it is.
    pub what: String,
}

/// Reads episodes. Safe to share: reads from several threads do not disturb each other.
pub trait Reader: Send + Sync {
    /// The columns: `episode_idx`, `step_idx`, then those that were written, with the types they had.
    fn schema(&self) -> &Schema;

    /// The episodes, in stored order.
    fn episodes(&self) -> &[Episode];

    /// Writes the rows of all ranges of one column to `out`, one after another, in the given order. Pictures
    /// come decoded, `[height, width, 3]` bytes. All ranges of a batch belong in one call, so that the reads
    /// can be planned together.
    ///
    /// # Errors
    /// When the column or a row does not exist, `out` has another length, or the stored data are damaged.
    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()>;

    /// The rows of all ranges, as [`Reader::read_column`] for several columns.
    ///
    /// # Errors
    /// As [`Reader::read_column`].
    fn read(&self, columns: &[&str], ranges: &[StepRange]) -> Result<Batch> {
        let specs: Result<Vec<ColumnSpec>> = columns.iter().map(|name| self.schema().column(name).cloned()).collect();
        let mut batch = Batch::zeros(&Schema::new(specs?)?, ranges.iter().map(|range| range.length).sum());
        for (i, name) in columns.iter().enumerate() {
            self.read_column(name, ranges, batch.bytes_mut(i))?;
        }
        Ok(batch)
    }

    /// What is the same in every step of the episode at this position of [`Reader::episodes`]; nothing, unless the
    /// format stores it.
    ///
    /// # Errors
    /// When the stored data are damaged.
    fn constants(&self, _episode: usize) -> Result<Constants> {
        Ok(Constants::new())
    }

    /// What is wrong with the dataset though its rows can be read, and only the format can tell: rows that belong to no
    /// episode, stored step numbers that do not count up, files that nothing refers to. `swm doctor` asks.
    ///
    /// # Errors
    /// When the stored data are damaged.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        Ok(vec![])
    }

    /// Where the data come from, where that was recorded.
    fn manifest(&self) -> Option<Manifest>;

    /// What takes how many bytes on disk, largest first.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    fn footprint(&self) -> Result<Vec<(String, u64)>>;

    /// A BLAKE3 hash of the content: names and types of the columns, lengths of the episodes, and every stored
    /// value in column and row order (pictures as their encoded bytes). Two datasets with equal content have
    /// equal hashes, however their files are cut.
    ///
    /// # Errors
    /// When the stored data are damaged.
    fn content_hash(&self) -> Result<String>;
}

/// A layout on disk: how it is recognised, opened and created.
pub struct Format {
    /// Its name, such as `lance`.
    pub id: &'static str,
    /// What it is, in a sentence.
    pub summary: &'static str,
    /// Whether a location looks like it, existing or about to be created.
    pub detect: fn(&Location) -> bool,
    /// Opens a dataset.
    pub open: fn(&Location) -> Result<Arc<dyn Reader>>,
    /// Creates, continues or replaces a dataset.
    pub create: fn(&Location, &Schema, WriteOptions) -> Result<Box<dyn Writer>>,
}

impl Named for Format {
    fn id(&self) -> &'static str {
        self.id
    }
}

/// Every layout there is. The first one that recognises a path is used.
pub static FORMATS: Registry<Format> = Registry {
    kind: "dataset format",
    hint: "`swm formats` lists them",
    rows: &[
        // Before `lance`, whose tables are within its folders.
        lance_video::FORMAT,
        lance::FORMAT,
        video::FORMAT,
        crate::folder::FORMAT,
        #[cfg(feature = "hdf5")]
        crate::hdf5::FORMAT,
        lerobot::FORMAT,
    ],
};

fn detect(location: &Location) -> Option<&'static Format> {
    FORMATS.rows.iter().find(|format| (format.detect)(location))
}

/// Opens a dataset of any format.
///
/// # Errors
/// When there is none, it is of no known format, or it is damaged.
pub fn open(location: impl Into<Location>) -> Result<Arc<dyn Reader>> {
    let location = location.into();
    if let Some(format) = detect(&location) {
        return (format.open)(&location);
    }
    let problem = match location.path().map(|path| path.try_exists()) {
        Some(Ok(false)) => "there is no such dataset",
        _ => "is no dataset of a known format",
    };
    let known: Vec<&str> = FORMATS.rows.iter().map(Named::id).collect();
    let fix = format!("`swm formats` says how each is recognised ({})", known.join(", "));
    Err(Error::corrupt(location.label(), problem, fix))
}

/// Creates, continues or replaces a dataset whose episodes have these columns, in the format that the location's name
/// says. Where it says none, take one from [`FORMATS`].
///
/// # Errors
/// When the location names no known format, the dataset exists and must not, the schema differs from the one
/// to continue, or the folder cannot be written.
pub fn create(location: impl Into<Location>, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let location = location.into();
    let Some(format) = detect(&location) else {
        let problem = format!("{location} names no format");
        return Err(Error::config("dataset path", problem, "end it in .lance"));
    };
    (format.create)(&location, schema, options)
}
