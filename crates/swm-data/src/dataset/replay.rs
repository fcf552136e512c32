//! [`ReplayBuffer`]: the latest episodes of a running collection, in memory, to train on while it goes on.
//!
//! It is a [`Writer`] to whoever plays, so that a world collects into it as into a dataset, and a [`Reader`] to whoever
//! learns: [`ReplayBuffer::snapshot`] is what it holds at one moment, and stays so while the buffer goes on. When an
//! episode does not fit, the oldest ones leave as a whole.
//!
//! What is drawn is a function of the key and of what the buffer holds, and of nothing else.

use crate::dataset::clips::{ClipSpec, Clips};
use crate::dataset::episodes::{EPISODE, Rows, STEP, check};
use crate::dataset::goals::{GoalSpec, Goals};
use crate::dataset::loader::{Anchors, Epoch, Filler, Loaded, Produce, Spare, Workers, window};
use crate::dataset::reader::{Constants, Episode, Reader, StepRange};
use crate::dataset::sync::lock;
use crate::dataset::writer::{WriteOptions, Writer};
use rand::Rng as _;
use serde_json::json;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock};
use swm_core::{Batch, ColumnSpec, DType, Error, Key, Manifest, Result, Schema};

/// Evicted episodes whose memory is kept for the next ones.
const SPARE: usize = 2;

/// The latest episodes. Cheap to clone; all clones are the same buffer.
#[derive(Clone)]
pub struct ReplayBuffer(Arc<Inner>);

struct Inner {
    /// The columns of the episodes that come.
    schema: Schema,
    /// Those of the dataset that it is to readers.
    numbered: Schema,
    capacity: usize,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    stored: VecDeque<Arc<Stored>>,
    rows: usize,
    /// Episodes that ever came, those that left included.
    added: u64,
    spare: Vec<Batch>,
    /// What is held now, once somebody asked.
    snapshot: OnceLock<Arc<Snapshot>>,
}

struct Stored {
    /// How many episodes came before it.
    number: u64,
    rows: Batch,
    constants: Constants,
}

impl ReplayBuffer {
    /// A buffer for episodes with these columns, of at most `capacity` rows. (An episode of `n` steps has `n + 1`.)
    ///
    /// # Errors
    /// When the capacity is 0.
    pub fn new(schema: &Schema, capacity: usize) -> Result<Self> {
        if capacity == 0 {
            return Err(Error::config("replay buffer", "its capacity is 0 rows", "make room for one episode at least"));
        }
        let numbered = numbered(schema)?;
        Ok(Self(Arc::new(Inner { schema: schema.clone(), numbered, capacity, state: Mutex::default() })))
    }

    /// Rows it holds.
    pub fn rows(&self) -> usize {
        lock(&self.0.state).rows
    }

    /// Episodes it holds.
    pub fn episodes(&self) -> usize {
        lock(&self.0.state).stored.len()
    }

    /// Episodes that ever came, those that left included.
    pub fn added(&self) -> u64 {
        lock(&self.0.state).added
    }

    /// Adds an episode; the oldest ones leave to make room.
    ///
    /// # Errors
    /// When its columns differ from the buffer's, it breaks the time convention, or it is longer than the buffer.
    pub fn add(&self, episode: &Batch, constants: &Constants) -> Result<()> {
        let Inner { schema, capacity, state, .. } = &*self.0;
        check(episode, schema)?;
        let rows = episode.rows();
        if rows > *capacity {
            let expected = format!("at most {capacity}, the buffer's capacity");
            return Err(Error::mismatch("adding an episode to a replay buffer", format!("{rows} rows"), expected));
        }
        // Copying happens without the lock: learners go on meanwhile.
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
            // Snapshots may still look at it; then its memory goes with the last of them.
            if let Some(oldest) = Arc::into_inner(oldest)
                && state.spare.len() < SPARE
            {
                state.spare.push(oldest.rows);
            }
        }
        let number = state.added;
        state.stored.push_back(Arc::new(Stored { number, rows: copy, constants: constants.clone() }));
        state.rows += rows;
        state.added += 1;
        state.snapshot = OnceLock::new();
        Ok(())
    }

    /// A writer into the buffer. Its number of episodes is that of all that ever came, so that a collection that is
    /// continued goes on with new episodes.
    pub fn writer(&self) -> Box<dyn Writer> {
        Box::new(ReplayWriter(self.clone()))
    }

    /// What it holds now, as a dataset that stays what it is. Costs a list of its episodes, not their data.
    pub fn snapshot(&self) -> Arc<dyn Reader> {
        self.now()
    }

    fn now(&self) -> Arc<Snapshot> {
        let state = lock(&self.0.state);
        Arc::clone(state.snapshot.get_or_init(|| Arc::new(Snapshot::new(&self.0, &state))))
    }

    /// Writes the stored episodes to a dataset that `create` makes, with the settings that [`ReplayBuffer::restore`]
    /// needs in its manifest.
    pub(crate) fn save_with(
        &self,
        mut options: WriteOptions,
        create: impl FnOnce(&Schema, WriteOptions) -> Result<Box<dyn Writer>>,
    ) -> Result<()> {
        let now = self.now();
        let mut manifest = options.manifest.take().unwrap_or_else(|| Manifest::new("replay", 0, json!({})));
        manifest.config["replay"] = json!({"capacity": self.0.capacity, "added": now.added});
        options.manifest = Some(manifest);
        let mut writer = create(&self.0.schema, options)?;
        for stored in &now.stored {
            writer.write_episode_with(&stored.rows, &stored.constants)?;
        }
        writer.finish()
    }

    /// Fills a new buffer from a dataset, the last episodes of it where not all fit. Of one that [`ReplayBuffer::save`]
    /// wrote, episodes have the numbers they had, and those to come the numbers they would have had.
    ///
    /// # Errors
    /// When the dataset is damaged, or its last episode is longer than the buffer.
    pub fn restore(reader: &dyn Reader, capacity: usize) -> Result<Self> {
        let columns = reader.schema().columns().iter().filter(|c| c.name != EPISODE && c.name != STEP);
        let columns: Vec<ColumnSpec> = columns.cloned().collect();
        let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
        let buffer = Self::new(&Schema::new(columns.clone())?, capacity)?;
        let episodes = reader.episodes();
        // The first episode from which on all fit.
        let mut rows = 0;
        let fits = |episode: &&Episode| {
            rows += episode.length;
            rows <= capacity
        };
        let kept = episodes.iter().rev().take_while(fits).count().max(1).min(episodes.len());
        let added = reader.manifest().and_then(|manifest| manifest.config["replay"]["added"].as_u64());
        lock(&buffer.0.state).added = added.unwrap_or(episodes.len() as u64).saturating_sub(kept as u64);
        for (position, episode) in episodes.iter().enumerate().skip(episodes.len() - kept) {
            let rows = reader.read(&names, &[StepRange::new(position, 0, episode.length)])?;
            buffer.add(&rows, &reader.constants(position)?)?;
        }
        Ok(buffer)
    }

    /// Draws batches of it, from whatever it holds when each one is loaded.
    ///
    /// # Errors
    /// When a column does not exist, a count is zero, or a goal's chances make no sense.
    pub fn loader(&self, config: ReplayConfig) -> Result<ReplayLoader> {
        if config.batch_size == 0 {
            return Err(Error::config("batch_size", "it is 0", "a batch needs at least one clip"));
        }
        let filler = Filler::new(&self.0.numbered, config.clip, config.goals)?;
        let prefetch = window(filler.schema(), config.batch_size, config.prefetch, config.prefetch_bytes);
        Ok(ReplayLoader {
            workers: Workers::new(config.threads)?,
            source: Arc::new(Source {
                buffer: self.clone(),
                filler,
                key: Key::new(config.seed).with("replay"),
                batch_size: config.batch_size,
                recent: config.recent,
                drawn_from: Mutex::default(),
                scratch: Mutex::default(),
                spare: Spare::new(prefetch + 2),
            }),
            prefetch,
        })
    }
}

/// The columns of an episode behind those that number episodes and steps.
fn numbered(schema: &Schema) -> Result<Schema> {
    let numbers = [EPISODE, STEP].map(|name| ColumnSpec::new(name, DType::Int64, []));
    let data = schema.columns().iter().filter(|column| column.name != EPISODE && column.name != STEP);
    Schema::new(numbers.into_iter().chain(data.cloned()).collect::<Vec<_>>())
}

struct ReplayWriter(ReplayBuffer);

impl Writer for ReplayWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        self.0.add(episode, constants)
    }

    #[allow(clippy::cast_possible_truncation)]
    fn episodes(&self) -> usize {
        self.0.added() as usize
    }

    fn finish(self: Box<Self>) -> Result<()> {
        Ok(())
    }
}

/// What a buffer held at one moment.
struct Snapshot {
    schema: Schema,
    episodes: Vec<Episode>,
    stored: Vec<Arc<Stored>>,
    added: u64,
    capacity: usize,
}

impl Snapshot {
    #[allow(clippy::cast_possible_wrap)]
    fn new(buffer: &Inner, state: &State) -> Self {
        let episode = |stored: &Arc<Stored>| Episode { index: stored.number as i64, length: stored.rows.rows() };
        Self {
            schema: buffer.numbered.clone(),
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

    #[allow(clippy::cast_possible_wrap)]
    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let spec = self.schema.column(column)?;
        Rows::check_room(spec, ranges, out)?;
        let n = spec.row_bytes();
        let mut rest = out;
        for range in ranges {
            let known =
                |episode: &Episode| range.start.checked_add(range.length).is_some_and(|end| end <= episode.length);
            if !self.episodes.get(range.episode).is_some_and(known) {
                let given = format!("{} rows from row {} of episode {}", range.length, range.start, range.episode);
                return Err(Error::mismatch("reading rows", given, "rows that the replay buffer held"));
            }
            let (place, others) = rest.split_at_mut(range.length * n);
            rest = others;
            let stored = &self.stored[range.episode];
            if column == EPISODE || column == STEP {
                for (row, place) in place.chunks_exact_mut(n).enumerate() {
                    let step = (range.start + row) as i64;
                    let number = if column == EPISODE { stored.number as i64 } else { step };
                    place.copy_from_slice(&number.to_ne_bytes());
                }
            } else {
                let bytes = stored.rows.bytes(stored.rows.schema().index(column)?);
                place.copy_from_slice(&bytes[range.start * n..(range.start + range.length) * n]);
            }
        }
        Ok(())
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        Ok(self.stored.get(episode).map(|stored| stored.constants.clone()).unwrap_or_default())
    }

    fn manifest(&self) -> Option<Manifest> {
        let what = json!({"replay": {"capacity": self.capacity, "added": self.added}});
        Some(Manifest::new("replay", 0, what))
    }

    /// In memory, that is.
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
            hasher.update(&stored.number.to_le_bytes());
            hasher.update(&(stored.rows.rows() as u64).to_le_bytes());
            (0..stored.rows.schema().columns().len()).for_each(|column| {
                hasher.update(stored.rows.bytes(column));
            });
        }
        Ok(hasher.finalize().to_hex().to_string())
    }
}

/// What to draw from a buffer and how.
#[derive(Clone, Debug)]
pub struct ReplayConfig {
    /// What is drawn: windows of `num_steps` steps, single rows for one.
    pub clip: ClipSpec,
    /// Goals to draw for every window.
    pub goals: Vec<GoalSpec>,
    /// Windows in a batch.
    pub batch_size: usize,
    /// Draw from the latest episodes only, as many as make up so many rows; from all for `None`.
    pub recent: Option<usize>,
    /// Decides what is drawn, together with the number of the batch and what the buffer holds.
    pub seed: u64,
    /// Threads that load ahead; 0 loads in the caller's thread.
    pub threads: usize,
    /// Batches loaded ahead, at most: what is drawn is that old.
    pub prefetch: usize,
    /// Bytes of batches loaded ahead, at most; one batch is loaded ahead in any case.
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

/// Draws batches from a buffer that grows.
pub struct ReplayLoader {
    source: Arc<Source>,
    workers: Arc<Workers>,
    prefetch: usize,
}

impl ReplayLoader {
    /// The columns of a batch, as [`crate::Loader::schema`] has them.
    pub fn schema(&self) -> &Schema {
        self.source.filler.schema()
    }

    /// The batch that a key draws from what the buffer holds now: every window is equally likely, and may come more than
    /// once.
    ///
    /// # Errors
    /// When no episode is long enough for a window.
    pub fn sample(&self, key: Key) -> Result<Loaded> {
        self.source.sample(key)
    }

    /// Batches without end, from the one of this number on. The stream ends with the first error, as when the buffer
    /// holds no window yet.
    pub fn batches(&self, first: usize) -> Epoch {
        Workers::start(&self.workers, Arc::clone(&self.source) as Arc<dyn Produce>, first..usize::MAX, self.prefetch)
    }
}

struct Source {
    buffer: ReplayBuffer,
    filler: Filler,
    key: Key,
    batch_size: usize,
    recent: Option<usize>,
    /// The windows of the latest snapshot.
    drawn_from: Mutex<Option<Arc<Windows>>>,
    scratch: Mutex<Vec<Anchors>>,
    spare: Arc<Spare>,
}

/// All windows of a snapshot.
struct Windows {
    snapshot: Arc<Snapshot>,
    clips: Clips,
    goals: Goals,
}

impl Source {
    /// The windows of what the buffer holds now.
    fn windows(&self) -> Result<Arc<Windows>> {
        let snapshot = self.buffer.now();
        let mut known = lock(&self.drawn_from);
        if let Some(windows) = known.as_ref().filter(|windows| Arc::ptr_eq(&windows.snapshot, &snapshot)) {
            return Ok(Arc::clone(windows));
        }
        let episodes = snapshot.episodes();
        let mut rows = 0;
        let wanted = |episode: &&Episode| {
            let wanted = self.recent.is_none_or(|recent| rows < recent);
            rows += episode.length;
            wanted
        };
        let latest = episodes.iter().rev().take_while(wanted).count();
        let positions: Vec<usize> = (episodes.len() - latest..episodes.len()).collect();
        let clips = Clips::reaching(self.filler.clip(), self.filler.reach(), episodes, &positions)?;
        let goals = Goals::new(episodes, &positions);
        let windows = Arc::new(Windows { snapshot, clips, goals });
        *known = Some(Arc::clone(&windows));
        Ok(windows)
    }

    fn sample(&self, key: Key) -> Result<Loaded> {
        let windows = self.windows()?;
        let mut rng = key.rng();
        let mut anchors = lock(&self.scratch).pop().unwrap_or_default();
        anchors.clear();
        #[allow(clippy::cast_possible_truncation)]
        let mut draw = || windows.clips.get(rng.random_range(0..windows.clips.len() as u64) as usize);
        anchors.extend((0..self.batch_size).map(|_| draw()));
        let mut out = self.spare.take(self.filler.schema());
        let goals = key.with("goals");
        self.filler.fill(&*windows.snapshot, &mut anchors, &windows.goals, |i| goals.at(i as u64), &mut out)?;
        lock(&self.scratch).push(anchors);
        Ok(out)
    }
}

impl Produce for Source {
    fn produce(&self, batch: usize) -> Result<Loaded> {
        self.sample(self.key.at(batch as u64))
    }
}
