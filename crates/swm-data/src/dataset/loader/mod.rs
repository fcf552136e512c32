//! [`Loader`]: batches of clips, shuffled and prefetched.
//!
//! The order of clips is a function of `(seed, epoch)` and nothing else, so any batch of any epoch can be asked
//! for again: training resumes exactly where it stopped, with any number of threads.
//!
//! - `batch`: which rows a batch needs; one call of [`Reader::read_column`] plans all of a column.
//! - `workers`: the threads that load ahead, within a budget of bytes.
//! - [`Loaded`]: a batch whose memory goes back to the loader.

mod batch;
mod workers;

pub(crate) use batch::{Anchors, Filler};
pub use workers::{Epoch, Loaded};
pub(crate) use workers::{Produce, Spare, Workers};

use crate::dataset::cache::CacheConfig;
use crate::dataset::clips::{ClipSpec, Clips};
use crate::dataset::goals::{GoalSpec, Goals};
use crate::dataset::reader::Reader;
use crate::dataset::sync::lock;
use rand::Rng as _;
use std::sync::{Arc, Mutex};
use swm_core::{Error, Key, Result, Schema};

/// What to load and how.
#[derive(Clone, Debug)]
pub struct LoaderConfig {
    /// What a clip holds.
    pub clip: ClipSpec,
    /// Goals to draw for every clip.
    pub goals: Vec<GoalSpec>,
    /// Clips in a batch.
    pub batch_size: usize,
    /// Whether clips come in random order (over the whole dataset) or in stored order.
    pub shuffle: bool,
    /// Decides the random order and the goals, together with the epoch.
    pub seed: u64,
    /// Threads that load ahead; 0 loads in the caller's thread. Pictures are decoded by them and rayon's pool.
    pub threads: usize,
    /// Batches loaded ahead, at most.
    pub prefetch: usize,
    /// Bytes of batches loaded ahead, at most; one batch is loaded ahead in any case.
    pub prefetch_bytes: usize,
    /// Positions of the episodes to use; all for `None`.
    pub episodes: Option<Vec<usize>>,
    /// Whether a last batch with fewer clips is left out.
    pub drop_last: bool,
    /// Where decoded rows are kept, so that later epochs need not decode them again.
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
            cache: CacheConfig::Memory { bytes: 512 << 20 },
        }
    }
}

/// Yields batches of clips, epoch after epoch.
pub struct Loader {
    source: Arc<Source>,
    workers: Arc<Workers>,
    shuffle: bool,
    batches: usize,
    prefetch: usize,
}

impl Loader {
    /// A loader. Its threads live as long as it does.
    ///
    /// # Errors
    /// When a column or an episode does not exist, no episode is long enough for a clip, a count is zero, a goal's
    /// chances make no sense, or the cache's folder cannot be used.
    pub fn new(reader: Arc<dyn Reader>, config: LoaderConfig) -> Result<Self> {
        let filler = Filler::new(reader.schema(), config.clip, config.goals)?;
        if config.batch_size == 0 {
            return Err(Error::config("batch_size", "it is 0", "a batch needs at least one clip"));
        }
        let positions = match config.episodes {
            Some(positions) => positions,
            None => (0..reader.episodes().len()).collect(),
        };
        let clips = Clips::reaching(filler.clip(), filler.reach(), reader.episodes(), &positions)?;
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
                "make it smaller, or keep the last batch (drop_last = false)",
            ));
        }
        let goals = Goals::new(reader.episodes(), &positions);
        let reader = config.cache.over(reader, &filler.columns())?;
        let prefetch = window(filler.schema(), config.batch_size, config.prefetch, config.prefetch_bytes);
        let workers = Workers::new(config.threads)?;
        let source = Source {
            reader,
            clips,
            goals,
            filler,
            key: Key::new(config.seed),
            batch_size: config.batch_size,
            scratch: Mutex::default(),
            spare: Spare::new(prefetch + 2),
        };
        Ok(Self { source: Arc::new(source), workers, shuffle: config.shuffle, batches, prefetch })
    }

    /// The columns of a batch: `[num_steps, shape…]` a clip, actions `[num_steps, frameskip * numbers]`, goals
    /// `[1, shape…]`.
    pub fn schema(&self) -> &Schema {
        self.source.filler.schema()
    }

    /// How many clips there are.
    pub fn clips(&self) -> usize {
        self.source.clips.len()
    }

    /// Batches in an epoch.
    pub fn batches_per_epoch(&self) -> usize {
        self.batches
    }

    /// Batches loaded ahead, at most.
    pub fn prefetch(&self) -> usize {
        self.prefetch
    }

    /// The batches of an epoch, from `first_batch` on.
    pub fn epoch(&self, epoch: u64, first_batch: usize) -> Epoch {
        let order = self.shuffle.then(|| {
            #[allow(clippy::cast_possible_truncation)] // checked in `new`
            let mut order: Vec<u32> = (0..self.source.clips.len() as u32).collect();
            shuffle(&mut order, self.source.key.with("loader").at(epoch));
            order
        });
        let producer = EpochSource { source: Arc::clone(&self.source), order, epoch };
        Workers::start(&self.workers, Arc::new(producer), first_batch..self.batches, self.prefetch)
    }
}

/// How many batches fit into the budget.
pub(crate) fn window(schema: &Schema, batch_size: usize, batches: usize, bytes: usize) -> usize {
    let batch: usize = schema.columns().iter().map(|column| column.row_bytes() * batch_size).sum();
    batches.min(bytes / batch.max(1)).max(1)
}

/// Puts items in an order that the key decides (Fisher–Yates).
pub(crate) fn shuffle<T>(items: &mut [T], key: Key) {
    let mut rng = key.rng();
    for i in (1..items.len()).rev() {
        items.swap(i, rng.random_range(0..=i as u64) as usize);
    }
}

/// What all epochs share.
struct Source {
    reader: Arc<dyn Reader>,
    clips: Clips,
    goals: Goals,
    filler: Filler,
    key: Key,
    batch_size: usize,
    /// Lists of rows to be made again.
    scratch: Mutex<Vec<Anchors>>,
    spare: Arc<Spare>,
}

/// The batches of one epoch.
struct EpochSource {
    source: Arc<Source>,
    order: Option<Vec<u32>>,
    epoch: u64,
}

impl Produce for EpochSource {
    fn produce(&self, batch: usize) -> Result<Loaded> {
        let source = &*self.source;
        let first = batch * source.batch_size;
        let samples = first..(first + source.batch_size).min(source.clips.len());
        let mut anchors = lock(&source.scratch).pop().unwrap_or_default();
        anchors.clear();
        anchors.extend(
            samples.clone().map(|i| source.clips.get(self.order.as_ref().map_or(i, |order| order[i] as usize))),
        );
        let mut out = source.spare.take(source.filler.schema());
        // The goal of a sample depends on its place in the epoch, whatever the batch size.
        let key = source.key.with("goals").at(self.epoch);
        source.filler.fill(&*source.reader, &mut anchors, &source.goals, |i| key.at((first + i) as u64), &mut out)?;
        lock(&source.scratch).push(anchors);
        Ok(out)
    }
}
