//! [`ReplayBuffer`]: the most recent episodes of a running collection, in memory, for training during collection.
//!
//! Collection writes into the buffer through its [`Writer`]; training reads a [`ReplayBuffer::snapshot`], which does
//! not change when the buffer changes. When a new episode does not fit, the oldest episodes are evicted.
//!
//! Samples depend only on the key and on the buffer's content.

use crate::dataset::clips::{ClipSpec, Clips};
use crate::dataset::episodes::{EpisodeRows, check_played_episode};
use crate::dataset::goals::{GoalSpec, Goals};
use crate::dataset::loader::{
    BatchFiller, BatchPool, BatchRows, BatchSource, Epoch, LoadedBatch, Workers, check_batch, window,
};
use crate::dataset::reader::{Constants, Episode, Reader, StepRange};
use crate::dataset::sync::lock;
use crate::dataset::writer::{WriteOptions, Writer};
use rand::Rng as _;
use serde_json::json;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock};
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, DType, Error, Key, Manifest, Result, Schema, limits};

/// Number of evicted episodes whose memory is reused.
const SPARE: usize = 2;

/// The most recent episodes. Clones share the same buffer.
#[derive(Clone)]
pub struct ReplayBuffer(Arc<Inner>);

struct Inner {
    /// Columns of the episodes to add.
    schema: Schema,
    /// Columns of the buffer as a dataset: index columns, then the columns of the episodes.
    dataset_schema: Schema,
    capacity: usize,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    stored: VecDeque<Arc<StoredEpisode>>,
    rows: usize,
    /// Number of episodes ever added.
    added: u64,
    spare: Vec<Batch>,
    /// A snapshot of the current content, if one was requested.
    snapshot: OnceLock<Arc<Snapshot>>,
}

struct StoredEpisode {
    /// Number of episodes added before this episode: its value in the column `episode_idx`.
    index: u64,
    rows: Batch,
    constants: Constants,
}

impl ReplayBuffer {
    /// A buffer of at most `capacity` rows for episodes with the columns of `schema`.
    /// An episode of `n` steps has `n + 1` rows.
    ///
    /// # Errors
    /// If the capacity is 0, or its rows have more than [`limits::REPLAY_BYTES`].
    pub fn new(schema: &Schema, capacity: usize) -> Result<Self> {
        if capacity == 0 {
            return Err(Error::config(
                "replay buffer",
                "its capacity is 0 rows",
                "use a capacity of at least one episode",
            ));
        }
        limits::REPLAY_BYTES.check(schema.row_bytes().saturating_mul(capacity))?;
        let dataset_schema = dataset_schema(schema)?;
        Ok(Self(Arc::new(Inner { schema: schema.clone(), dataset_schema, capacity, state: Mutex::default() })))
    }

    /// Number of rows in the buffer.
    pub fn rows(&self) -> usize {
        lock(&self.0.state).rows
    }

    /// Number of episodes in the buffer.
    pub fn episodes(&self) -> usize {
        lock(&self.0.state).stored.len()
    }

    /// Number of episodes ever added, including evicted ones.
    pub fn added(&self) -> u64 {
        lock(&self.0.state).added
    }

    /// Adds an episode, and evicts the oldest episodes until the new one fits. The last row may have an action, as in
    /// episodes that a training loop records itself.
    ///
    /// # Errors
    /// If the columns differ from the buffer's, the episode breaks the time convention, or the episode has more
    /// rows than the buffer's capacity.
    pub fn add(&self, episode: &Batch, constants: &Constants) -> Result<()> {
        let Inner { schema, capacity, state, .. } = &*self.0;
        check_played_episode(episode, schema)?;
        let rows = episode.rows();
        if rows > *capacity {
            let expected = format!("at most {capacity}, the buffer's capacity");
            return Err(Error::mismatch("adding an episode to a replay buffer", format!("{rows} rows"), expected));
        }
        // Copies the episode without holding the lock, so that readers need not wait.
        let spare = lock(state).spare.pop();
        let mut copy = spare.unwrap_or_else(|| Batch::zeros(schema, 0));
        copy.resize(rows);
        for column in 0..schema.columns().len() {
            copy.bytes_mut(column).copy_from_slice(episode.bytes(column));
        }
        let mut state = lock(state);
        while state.rows + rows > *capacity {
            let Some(oldest) = state.stored.pop_front() else { break };
            state.rows -= oldest.rows.rows();
            // If a snapshot still uses the episode, its memory is freed with the last such snapshot.
            if let Some(oldest) = Arc::into_inner(oldest)
                && state.spare.len() < SPARE
            {
                state.spare.push(oldest.rows);
            }
        }
        let index = state.added;
        state.stored.push_back(Arc::new(StoredEpisode { index, rows: copy, constants: constants.clone() }));
        state.rows += rows;
        state.added += 1;
        state.snapshot = OnceLock::new();
        Ok(())
    }

    /// Returns a writer that adds episodes to the buffer. [`Writer::episodes`] returns the number of episodes ever
    /// added, so that a resumed collection continues with new episodes.
    pub fn writer(&self) -> Box<dyn Writer> {
        Box::new(ReplayWriter(self.clone()))
    }

    /// The current content as a dataset that does not change. Copies the list of episodes, not their data.
    pub fn snapshot(&self) -> Arc<dyn Reader> {
        self.current_snapshot()
    }

    fn current_snapshot(&self) -> Arc<Snapshot> {
        let state = lock(&self.0.state);
        Arc::clone(state.snapshot.get_or_init(|| Arc::new(Snapshot::new(&self.0, &state))))
    }

    /// Writes the stored episodes to a dataset that `create` creates. The dataset's manifest records the capacity and
    /// the number of episodes ever added, which [`ReplayBuffer::restore`] reads.
    pub(crate) fn save_with(
        &self,
        mut options: WriteOptions,
        create: impl FnOnce(&Schema, WriteOptions) -> Result<Box<dyn Writer>>,
    ) -> Result<()> {
        let snapshot = self.current_snapshot();
        let mut manifest = options.manifest.take().unwrap_or_else(|| Manifest::new("replay", 0, json!({})));
        manifest.config["replay"] = json!({"capacity": self.0.capacity, "added": snapshot.added});
        options.manifest = Some(manifest);
        let mut writer = create(&self.0.schema, options)?;
        for stored in &snapshot.stored {
            writer.write_episode_with(&stored.rows, &stored.constants)?;
        }
        writer.finish()
    }

    /// Fills a new buffer from a dataset. If not all episodes fit, the buffer holds the last episodes. If
    /// [`ReplayBuffer::save`] wrote the dataset, stored and future episodes get the same `episode_idx` as in the
    /// original buffer.
    ///
    /// # Errors
    /// If the dataset is damaged, or its last episode is longer than the buffer.
    pub fn restore(reader: &dyn Reader, capacity: usize) -> Result<Self> {
        let columns = reader.schema().columns().iter().filter(|c| c.name != EPISODE_IDX && c.name != STEP_IDX);
        let columns: Vec<ColumnSpec> = columns.cloned().collect();
        let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
        let buffer = Self::new(&Schema::new(columns.clone())?, capacity)?;
        let episodes = reader.episodes();
        // Counts the trailing episodes that fit.
        let mut rows = 0;
        let fits = |episode: &&Episode| {
            rows += episode.length;
            rows <= capacity
        };
        let retained = episodes.iter().rev().take_while(fits).count().max(1).min(episodes.len());
        let added = reader.manifest().and_then(|manifest| manifest.config["replay"]["added"].as_u64());
        lock(&buffer.0.state).added = added.unwrap_or(episodes.len() as u64).saturating_sub(retained as u64);
        for (position, episode) in episodes.iter().enumerate().skip(episodes.len() - retained) {
            let rows = reader.read(&names, &[StepRange::new(position, 0, episode.length)])?;
            buffer.add(&rows, &reader.constants(position)?)?;
        }
        Ok(buffer)
    }

    /// Creates a loader. It samples each batch from the buffer's content at the time of loading.
    ///
    /// # Errors
    /// If a column does not exist, a size in `config` is 0, a batch is too large, or a goal's probabilities are invalid.
    pub fn loader(&self, config: ReplayConfig) -> Result<ReplayLoader> {
        let filler = BatchFiller::new(&self.0.dataset_schema, config.clip, config.goals)?;
        check_batch(filler.schema(), config.batch_size)?;
        let prefetch = window(filler.schema(), config.batch_size, config.prefetch, config.prefetch_bytes);
        Ok(ReplayLoader {
            workers: Workers::new(config.threads)?,
            source: Arc::new(Source {
                buffer: self.clone(),
                filler,
                key: Key::new(config.seed).with("replay"),
                batch_size: config.batch_size,
                recent: config.recent,
                windows: Mutex::default(),
                scratch: Mutex::default(),
                pool: BatchPool::new(prefetch + 2),
            }),
            prefetch,
        })
    }
}

/// The index columns, followed by the columns of an episode.
fn dataset_schema(schema: &Schema) -> Result<Schema> {
    let index_columns = [EPISODE_IDX, STEP_IDX].map(|name| ColumnSpec::new(name, DType::Int64, []));
    let data = schema.columns().iter().filter(|column| column.name != EPISODE_IDX && column.name != STEP_IDX);
    Schema::new(index_columns.into_iter().chain(data.cloned()).collect::<Vec<_>>())
}

struct ReplayWriter(ReplayBuffer);

impl Writer for ReplayWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        self.0.add(episode, constants)
    }

    fn episodes(&self) -> usize {
        self.0.added() as usize
    }

    fn finish(self: Box<Self>) -> Result<()> {
        Ok(())
    }
}

/// The buffer's content at one point in time.
struct Snapshot {
    schema: Schema,
    episodes: Vec<Episode>,
    stored: Vec<Arc<StoredEpisode>>,
    added: u64,
    capacity: usize,
}

impl Snapshot {
    fn new(buffer: &Inner, state: &State) -> Self {
        let episode = |stored: &Arc<StoredEpisode>| Episode { index: stored.index as i64, length: stored.rows.rows() };
        Self {
            schema: buffer.dataset_schema.clone(),
            episodes: state.stored.iter().map(episode).collect(),
            stored: state.stored.iter().cloned().collect(),
            added: state.added,
            capacity: buffer.capacity,
        }
    }
}

impl Reader for Snapshot {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let spec = self.schema.column(column)?;
        EpisodeRows::check_output(spec, ranges, out)?;
        let n = spec.row_bytes();
        let mut rest = out;
        for range in ranges {
            let fits =
                |episode: &Episode| range.start.checked_add(range.length).is_some_and(|end| end <= episode.length);
            if !self.episodes.get(range.episode).is_some_and(fits) {
                let given = format!("{} rows from row {} of episode {}", range.length, range.start, range.episode);
                return Err(Error::mismatch("reading rows", given, "rows inside an episode of the snapshot"));
            }
            let (target, after) = rest.split_at_mut(range.length * n);
            rest = after;
            let stored = &self.stored[range.episode];
            if column == EPISODE_IDX || column == STEP_IDX {
                for (row, target) in target.chunks_exact_mut(n).enumerate() {
                    let step = (range.start + row) as i64;
                    let value = if column == EPISODE_IDX { stored.index as i64 } else { step };
                    target.copy_from_slice(&value.to_ne_bytes());
                }
            } else {
                let bytes = stored.rows.bytes(stored.rows.schema().index(column)?);
                target.copy_from_slice(&bytes[range.start * n..(range.start + range.length) * n]);
            }
        }
        Ok(())
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        Ok(self.stored.get(episode).map(|stored| stored.constants.clone()).unwrap_or_default())
    }

    fn manifest(&self) -> Option<Manifest> {
        let config = json!({"replay": {"capacity": self.capacity, "added": self.added}});
        Some(Manifest::new("replay", 0, config))
    }

    /// Bytes in memory per column, largest first.
    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let rows: u64 = self.episodes.iter().map(|episode| episode.length as u64).sum();
        let mut sizes: Vec<(String, u64)> =
            self.schema.columns().iter().skip(2).map(|c| (c.name.clone(), c.row_bytes() as u64 * rows)).collect();
        sizes.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(sizes)
    }

    fn content_hash(&self) -> Result<String> {
        let mut hasher = blake3::Hasher::new();
        for column in self.schema.columns() {
            hasher.update(format!("{} {} {:?};", column.name, column.dtype.name(), column.shape).as_bytes());
        }
        for stored in &self.stored {
            hasher.update(&stored.index.to_le_bytes());
            hasher.update(&(stored.rows.rows() as u64).to_le_bytes());
            (0..stored.rows.schema().columns().len()).for_each(|column| {
                hasher.update(stored.rows.bytes(column));
            });
        }
        Ok(hasher.finalize().to_hex().to_string())
    }
}

/// Settings of a [`ReplayLoader`].
#[derive(Clone, Debug)]
pub struct ReplayConfig {
    /// Shape and columns of the sampled windows; `num_steps = 1` samples single rows.
    pub clip: ClipSpec,
    /// Goals to draw for every window.
    pub goals: Vec<GoalSpec>,
    /// Windows per batch.
    pub batch_size: usize,
    /// Samples only from the latest episodes that have at least this many rows in total; from all episodes for `None`.
    pub recent: Option<usize>,
    /// Seed of the samples; combined with the index of the batch and the buffer's content.
    pub seed: u64,
    /// Prefetching threads; 0 loads in the caller's thread.
    pub threads: usize,
    /// Maximum number of prefetched batches. Prefetched samples do not contain episodes that were added later.
    pub prefetch: usize,
    /// Maximum number of bytes of prefetched batches; at least one batch is prefetched.
    pub prefetch_bytes: usize,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self {
            clip: ClipSpec { num_steps: 1, frameskip: 1, columns: vec![] },
            goals: vec![],
            batch_size: 256,
            recent: None,
            seed: 0,
            threads: 1,
            prefetch: 2,
            prefetch_bytes: 512 << 20,
        }
    }
}

/// Samples batches from a growing buffer.
pub struct ReplayLoader {
    source: Arc<Source>,
    workers: Arc<Workers>,
    prefetch: usize,
}

impl ReplayLoader {
    /// The columns of a batch; shapes as in [`crate::Loader::schema`].
    pub fn schema(&self) -> &Schema {
        self.source.filler.schema()
    }

    /// Samples a batch from the current content with a key. All windows are equally likely; a window may appear more
    /// than once.
    ///
    /// # Errors
    /// If no episode is long enough for a window.
    pub fn sample(&self, key: Key) -> Result<LoadedBatch> {
        self.source.sample(key)
    }

    /// An unbounded iterator over sampled batches, starting at index `first`. Iteration stops after the first error,
    /// for example if no stored episode is long enough for a window.
    pub fn batches(&self, first: usize) -> Epoch {
        Workers::start(
            &self.workers,
            Arc::clone(&self.source) as Arc<dyn BatchSource>,
            first..usize::MAX,
            self.prefetch,
        )
    }
}

struct Source {
    buffer: ReplayBuffer,
    filler: BatchFiller,
    key: Key,
    batch_size: usize,
    recent: Option<usize>,
    /// The windows of the latest snapshot.
    windows: Mutex<Option<Arc<Windows>>>,
    scratch: Mutex<Vec<BatchRows>>,
    pool: Arc<BatchPool>,
}

/// All windows of a snapshot.
struct Windows {
    snapshot: Arc<Snapshot>,
    clips: Clips,
    goals: Goals,
}

impl Source {
    /// The windows of the current content.
    fn windows(&self) -> Result<Arc<Windows>> {
        let snapshot = self.buffer.current_snapshot();
        let mut cached = lock(&self.windows);
        if let Some(windows) = cached.as_ref().filter(|windows| Arc::ptr_eq(&windows.snapshot, &snapshot)) {
            return Ok(Arc::clone(windows));
        }
        let episodes = snapshot.episodes();
        let mut rows = 0;
        let is_recent = |episode: &&Episode| {
            let is_recent = self.recent.is_none_or(|recent| rows < recent);
            rows += episode.length;
            is_recent
        };
        let latest = episodes.iter().rev().take_while(is_recent).count();
        let positions: Vec<usize> = (episodes.len() - latest..episodes.len()).collect();
        let clips = Clips::reaching(self.filler.clip(), self.filler.reach(), episodes, &positions)?;
        let goals = Goals::new(episodes, &positions);
        let windows = Arc::new(Windows { snapshot, clips, goals });
        *cached = Some(Arc::clone(&windows));
        Ok(windows)
    }

    fn sample(&self, key: Key) -> Result<LoadedBatch> {
        let windows = self.windows()?;
        let mut rng = key.rng();
        let mut rows = lock(&self.scratch).pop().unwrap_or_default();
        rows.clear();
        let mut draw = || windows.clips.get(rng.random_range(0..windows.clips.len() as u64) as usize);
        rows.extend((0..self.batch_size).map(|_| draw()));
        let mut out = self.pool.take(self.filler.schema());
        let goals = key.with("goals");
        self.filler.fill(&*windows.snapshot, &mut rows, &windows.goals, |i| goals.at(i as u64), &mut out)?;
        lock(&self.scratch).push(rows);
        Ok(out)
    }
}

impl BatchSource for Source {
    fn produce(&self, batch: usize) -> Result<LoadedBatch> {
        self.sample(self.key.at(batch as u64))
    }
}
