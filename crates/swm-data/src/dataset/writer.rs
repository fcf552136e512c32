//! The contract for storing episodes: [`Writer`] and its options.

use super::reader::{Constants, Reader};
use std::fmt::Display;
use std::time::Duration;
use swm_core::{Batch, Error, Manifest, Result};
use swm_image::ImageCodec;

/// The treatment of an existing dataset at the location to write.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WriteMode {
    /// Returns an error if the dataset exists.
    #[default]
    Create,
    /// Appends to the dataset, or creates it if it does not exist.
    Append,
    /// Replaces the dataset. It stays until the first episode is ready to be written, or the writer is finished.
    Overwrite,
}

/// Limits of uncommitted data. Finished episodes are committed as soon as one limit is reached. A killed process loses
/// at most the uncommitted episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CommitPolicy {
    /// Maximum number of episodes per commit.
    pub episodes: usize,
    /// Maximum number of encoded bytes per commit; this also bounds the writer's memory.
    pub bytes: usize,
    /// Maximum time between commits. It is checked when an episode arrives. LeRobot datasets ignore it, because every
    /// commit begins new files, and equal collections have equal files.
    pub interval: Duration,
}

impl Default for CommitPolicy {
    fn default() -> Self {
        Self { episodes: usize::MAX, bytes: 64 << 20, interval: Duration::from_secs(2) }
    }
}

/// Options of a writer.
#[derive(Clone, Debug, Default)]
pub struct WriteOptions {
    /// The treatment of an existing dataset.
    pub mode: WriteMode,
    /// The codec of images.
    pub codec: ImageCodec,
    /// Provenance of the data, stored in the dataset. When appending, this manifest replaces the stored one.
    pub manifest: Option<Manifest>,
    /// Limits at which finished episodes are committed.
    pub commit: CommitPolicy,
    /// Whether this must be the only writer. An exclusive writer fails when another writer adds to the dataset at the
    /// same time, instead of adding its episodes after those of the other. Collections are exclusive, because two that
    /// continue the same dataset would store the same episodes twice. Formats other than Lance, and writers that replace
    /// a dataset, have one writer anyway.
    pub exclusive: bool,
    /// What the caller read of the dataset that it continues. A writer that finds another dataset, which replaced that one before
    /// the writer had the lock, changes nothing and fails. Shards ignore it.
    pub continues: Option<Continued>,
}

/// The episodes of a dataset that a caller read before it appends to them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Continued {
    episodes: usize,
    identity: String,
}

impl Continued {
    /// Returns what tells the episodes of a dataset from those of another one.
    ///
    /// # Errors
    /// If the dataset is damaged.
    pub fn of(reader: &dyn Reader) -> Result<Self> {
        let episodes = reader.episodes().len();
        Ok(Self { episodes, identity: reader.identity(episodes)? })
    }

    /// Checks that a dataset has these episodes. `label` names it in the error.
    ///
    /// # Errors
    /// If it was replaced by another dataset, or is damaged.
    pub fn check(&self, reader: &dyn Reader, label: &dyn Display) -> Result<()> {
        if reader.episodes().len() < self.episodes || reader.identity(self.episodes)? != self.identity {
            let problem = "another program replaced it while it was to be continued; nothing was added to it";
            return Err(Error::config(format!("dataset {label}"), problem, "run the command again"));
        }
        Ok(())
    }
}

/// Whether an error means that the disk, a quota or the largest possible file is full.
pub(crate) fn is_full(error: &Error) -> bool {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    let full = |kind| matches!(kind, StorageFull | QuotaExceeded | FileTooLarge);
    matches!(error, Error::Io { source, .. } if full(source.kind()))
}

/// Adds the number of episodes that are stored to an error of writing.
pub(crate) fn with_stored(error: Error, episodes: usize) -> Error {
    match error {
        Error::Io { path, action, source } => {
            let stored = if episodes == 1 { "1 episode is".to_owned() } else { format!("{episodes} episodes are") };
            Error::Io { path, action: format!("{action} ({stored} stored)"), source }
        }
        other => other,
    }
}

/// Stores complete episodes. Committed episodes survive a killed process. Dropping a writer commits the remaining
/// episodes, but only [`Writer::finish`] reports errors of that last commit.
pub trait Writer: Send {
    /// Adds one complete episode and its constants. The writer computes the columns `episode_idx` and `step_idx` and
    /// ignores their values in `episode`.
    ///
    /// # Errors
    /// If the columns differ from the writer's schema, the episode breaks the time convention (the last action is NaN
    /// or -1, all other actions are finite), a value does not fit its stored type, or writing fails.
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()>;

    /// Adds one complete episode without [`Constants`].
    ///
    /// # Errors
    /// As [`Writer::write_episode_with`].
    fn write_episode(&mut self, episode: &Batch) -> Result<()> {
        self.write_episode_with(episode, &Constants::new())
    }

    /// Commits the written episodes and waits until they are stored. Formats that store an episode when it is written do
    /// nothing.
    ///
    /// # Errors
    /// When storing fails.
    fn sync(&mut self) -> Result<()> {
        Ok(())
    }

    /// Number of episodes in the dataset, including those that are not committed yet.
    fn episodes(&self) -> usize;

    /// Commits the remaining episodes; the dataset, or the shard, is complete.
    ///
    /// # Errors
    /// If writing fails, or another process changed the dataset in the meantime.
    fn finish(self: Box<Self>) -> Result<()>;

    /// As [`Writer::finish`], if more episodes are to follow after an interruption or an error: a shard stays unfinished.
    ///
    /// # Errors
    /// As [`Writer::finish`].
    fn pause(self: Box<Self>) -> Result<()> {
        self.finish()
    }
}
