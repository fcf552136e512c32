//! [`Loader`]: shuffled and prefetched batches of clips.
//!
//! The order of clips depends only on `(seed, epoch)`, so any batch of any epoch can be loaded again. Training
//! therefore resumes exactly where it stopped, with any number of threads.
//!
//! - `batch`: selects the rows of a batch; one call of [`Reader::read_column`] reads all rows of a column.
//! - `workers`: threads that prefetch batches within a budget of bytes.
//! - [`LoadedBatch`]: a batch whose memory the loader reuses.

mod batch;
mod workers;

pub(crate) use batch::{BatchFiller, BatchRows};
pub(crate) use workers::{BatchPool, BatchSource, Workers};
pub use workers::{Epoch, LoadedBatch};

use crate::dataset::cache::CacheConfig;
use crate::dataset::clips::{ClipSpec, Clips};
use crate::dataset::goals::{GoalSpec, Goals};
use crate::dataset::reader::Reader;
use crate::dataset::sync::lock;
use rand::Rng as _;
use std::collections::HashSet;
use std::ops::Range;
use std::sync::{Arc, Mutex};
use swm_core::{Error, Key, Result, Schema, limits};

/// Settings of a [`Loader`].
#[derive(Clone, Debug)]
pub struct LoaderConfig {
    /// Shape and columns of clips.
    pub clip: ClipSpec,
    /// Goals to draw for every clip.
    pub goals: Vec<GoalSpec>,
    /// Clips per batch.
    pub batch_size: usize,
    /// Whether clips come in random order (over the whole dataset) or in stored order.
    pub shuffle: bool,
    /// Seed of the random order and of the goals; combined with the epoch.
    pub seed: u64,
    /// Prefetching threads; 0 loads in the caller's thread. Images are decoded by these threads and by rayon's thread
    /// pool.
    pub threads: usize,
    /// Maximum number of prefetched batches.
    pub prefetch: usize,
    /// Maximum number of bytes of prefetched batches; at least one batch is prefetched.
    pub prefetch_bytes: usize,
    /// Positions of the episodes to use, each once; all for `None`.
    pub episodes: Option<Vec<usize>>,
    /// Whether an incomplete last batch is dropped.
    pub drop_last: bool,
    /// The slice of every batch that is loaded.
    pub slice: BatchSlice,
    /// Cache of decoded rows, so that later epochs need not decode them again.
    pub cache: CacheConfig,
}

impl Default for LoaderConfig {
    fn default() -> Self {
        Self {
            clip: ClipSpec { num_steps: 1, frameskip: 1, columns: vec![] },
            goals: vec![],
            batch_size: 64,
            shuffle: true,
            seed: 0,
            threads: 2,
            prefetch: 4,
            prefetch_bytes: 512 << 20,
            episodes: None,
            drop_last: false,
            slice: BatchSlice::default(),
            cache: CacheConfig::Memory { bytes: 512 << 20 },
        }
    }
}

/// The slice of every batch that one process of a distributed training loads. The slices of all ranks, one after another,
/// are the batch; their sizes differ by at most 1, so the slices of a short batch may be empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BatchSlice {
    /// The index of the process, below `ranks`.
    pub rank: usize,
    /// The number of processes.
    pub ranks: usize,
}

impl Default for BatchSlice {
    fn default() -> Self {
        Self { rank: 0, ranks: 1 }
    }
}

impl BatchSlice {
    /// Returns the positions of the slice in a batch of `clips` clips.
    fn range(self, clips: usize) -> Range<usize> {
        let (size, larger) = (clips / self.ranks, clips % self.ranks);
        let start = self.rank * size + self.rank.min(larger);
        start..start + size + usize::from(self.rank < larger)
    }

    fn check(self) -> Result<()> {
        if self.rank < self.ranks {
            return Ok(());
        }
        let given = format!("rank {} of {} processes", self.rank, self.ranks);
        Err(Error::config("rank", given, "give a rank from 0 to one less than the number of processes"))
    }
}

/// Yields batches of clips for any epoch.
pub struct Loader {
    source: Arc<Source>,
    workers: Arc<Workers>,
    shuffle: bool,
    batches: usize,
    prefetch: usize,
}

impl Loader {
    /// Creates a loader. Dropping the loader stops its threads.
    ///
    /// # Errors
    /// If a column or an episode does not exist, an episode is chosen twice, no episode is long enough for a clip, a
    /// size in `config` is 0, the rank is out of range, a batch is too large, a goal's probabilities are invalid, or
    /// the cache's folder cannot be used.
    pub fn new(reader: Arc<dyn Reader>, config: LoaderConfig) -> Result<Self> {
        config.slice.check()?;
        let filler = BatchFiller::new(reader.schema(), config.clip, config.goals)?;
        let positions = match config.episodes {
            Some(positions) => check_once(positions)?,
            None => (0..reader.episodes().len()).collect(),
        };
        let clips = Clips::reaching(filler.clip(), filler.reach(), reader.episodes(), &positions)?;
        check_batch(filler.schema(), config.batch_size.min(clips.len()))?;
        if u32::try_from(clips.len()).is_err() {
            let problem = format!("{} clips are more than a loader can shuffle", clips.len());
            return Err(Error::config("clips", problem, "load fewer episodes at once"));
        }
        let batches =
            if config.drop_last { clips.len() / config.batch_size } else { clips.len().div_ceil(config.batch_size) };
        if batches == 0 {
            return Err(Error::config(
                "batch_size",
                format!("{} clips do not fill one batch of {}", clips.len(), config.batch_size),
                "use a smaller batch_size, or keep the last batch (drop_last = false)",
            ));
        }
        let goals = Goals::new(reader.episodes(), &positions);
        let reader = config.cache.over(reader, &filler.columns())?;
        let loaded = config.batch_size.div_ceil(config.slice.ranks);
        let prefetch = window(filler.schema(), loaded, config.prefetch, config.prefetch_bytes);
        limits::THREADS.check(config.threads)?;
        let workers = Workers::new(config.threads)?;
        let source = Source {
            reader,
            clips,
            goals,
            filler,
            key: Key::new(config.seed),
            batch_size: config.batch_size,
            slice: config.slice,
            scratch: Mutex::default(),
            pool: BatchPool::new(prefetch + 2),
        };
        Ok(Self { source: Arc::new(source), workers, shuffle: config.shuffle, batches, prefetch })
    }

    /// The columns of a batch.
    ///
    /// # Shapes
    /// Per clip `[num_steps, shape…]`, for actions `[num_steps, frameskip * action_dim]`, for goals `[1, shape…]`.
    pub fn schema(&self) -> &Schema {
        self.source.filler.schema()
    }

    /// Number of clips.
    pub fn clips(&self) -> usize {
        self.source.clips.len()
    }

    /// Batches per epoch.
    pub fn batches_per_epoch(&self) -> usize {
        self.batches
    }

    /// Maximum number of prefetched batches.
    pub fn prefetch(&self) -> usize {
        self.prefetch
    }

    /// The batches of an epoch, starting at `first_batch`.
    pub fn epoch(&self, epoch: u64, first_batch: usize) -> Epoch {
        let order = self.shuffle.then(|| {
            let mut order: Vec<u32> = (0..self.source.clips.len() as u32).collect();
            shuffle(&mut order, self.source.key.with("loader").at(epoch));
            order
        });
        let producer = EpochSource { source: Arc::clone(&self.source), order, epoch };
        Workers::start(&self.workers, Arc::new(producer), first_batch..self.batches, self.prefetch)
    }
}

/// Returns positions of episodes, each of which may be there once: otherwise an epoch has its clips twice.
///
/// # Errors
/// If a position is there twice.
fn check_once(positions: Vec<usize>) -> Result<Vec<usize>> {
    let mut seen = HashSet::new();
    match positions.iter().find(|position| !seen.insert(**position)) {
        Some(twice) => Err(Error::config(
            "episodes",
            format!("{twice} is there twice"),
            "name every episode once; a concatenation of datasets repeats them",
        )),
        None => Ok(positions),
    }
}

/// Checks the number of clips in a batch.
///
/// # Errors
/// If it is 0, or a batch has more than [`limits::BATCH_BYTES`].
pub(crate) fn check_batch(schema: &Schema, batch_size: usize) -> Result<()> {
    if batch_size == 0 {
        return Err(Error::config("batch_size", "0", "choose at least 1"));
    }
    limits::BATCH_BYTES.check(schema.row_bytes().saturating_mul(batch_size))
}

/// The number of batches that fit into `bytes`; at least 1, at most `batches`.
pub(crate) fn window(schema: &Schema, batch_size: usize, batches: usize, bytes: usize) -> usize {
    batches.min(bytes / schema.row_bytes().saturating_mul(batch_size).max(1)).max(1)
}

/// Shuffles items with a keyed generator (Fisher–Yates).
pub(crate) fn shuffle<T>(items: &mut [T], key: Key) {
    let mut rng = key.rng();
    for i in (1..items.len()).rev() {
        items.swap(i, rng.random_range(0..=i as u64) as usize);
    }
}

/// State shared by all epochs.
struct Source {
    reader: Arc<dyn Reader>,
    clips: Clips,
    goals: Goals,
    filler: BatchFiller,
    key: Key,
    batch_size: usize,
    slice: BatchSlice,
    /// Reusable lists of rows.
    scratch: Mutex<Vec<BatchRows>>,
    pool: Arc<BatchPool>,
}

/// The batches of one epoch.
struct EpochSource {
    source: Arc<Source>,
    order: Option<Vec<u32>>,
    epoch: u64,
}

impl BatchSource for EpochSource {
    fn produce(&self, batch: usize) -> Result<LoadedBatch> {
        let source = &*self.source;
        let first = batch * source.batch_size;
        let slice = source.slice.range(source.batch_size.min(source.clips.len() - first));
        let samples = first + slice.start..first + slice.end;
        let mut rows = lock(&source.scratch).pop().unwrap_or_default();
        rows.clear();
        rows.extend(
            samples.clone().map(|i| source.clips.get(self.order.as_ref().map_or(i, |order| order[i] as usize))),
        );
        let mut out = source.pool.take(source.filler.schema());
        if samples.is_empty() {
            out.resize(0);
            return Ok(out);
        }
        // The goal of a sample depends on its position in the epoch, not on the batch size.
        let key = source.key.with("goals").at(self.epoch);
        source.filler.fill(
            &*source.reader,
            &mut rows,
            &source.goals,
            |i| key.at((samples.start + i) as u64),
            &mut out,
        )?;
        lock(&source.scratch).push(rows);
        Ok(out)
    }
}
