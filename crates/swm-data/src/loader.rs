//! [`Loader`]: batches of clips, shuffled and prefetched.
//!
//! The order of clips is a function of `(seed, epoch)` and nothing else, so any batch of any epoch can be asked
//! for again: training resumes exactly where it stopped, with any number of threads.

use crate::clip::{ACTION, ClipSpec, Clips};
use crate::format::{Reader, StepRange};
use rand::Rng as _;
use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use swm_core::{Batch, ColumnSpec, Error, Key, Result, Schema};

/// What to load and how.
#[derive(Clone, Debug)]
pub struct LoaderConfig {
    /// What a clip holds.
    pub clip: ClipSpec,
    /// Clips in a batch.
    pub batch_size: usize,
    /// Whether clips come in random order (over the whole dataset) or in stored order.
    pub shuffle: bool,
    /// Decides the random order, together with the epoch.
    pub seed: u64,
    /// Threads that load ahead; 0 loads in the caller's thread.
    pub threads: usize,
    /// Batches loaded ahead, which bounds the memory.
    pub prefetch: usize,
    /// Positions of the episodes to use; all for `None`.
    pub episodes: Option<Vec<usize>>,
    /// Whether a last batch with fewer clips is left out.
    pub drop_last: bool,
    /// Keep the columns decoded in memory when they take at most this many bytes.
    pub cache_bytes: usize,
}

impl Default for LoaderConfig {
    fn default() -> Self {
        Self {
            clip: ClipSpec { num_steps: 1, frameskip: 1, columns: vec![] },
            batch_size: 64,
            shuffle: true,
            seed: 0,
            threads: 2,
            prefetch: 4,
            episodes: None,
            drop_last: false,
            cache_bytes: 512 << 20,
        }
    }
}

/// Yields batches of clips, epoch after epoch.
pub struct Loader {
    clips: Arc<ClipSource>,
    shuffle: bool,
    seed: u64,
    threads: usize,
    prefetch: usize,
    batches: usize,
}

impl Loader {
    /// A loader. Small datasets are read and decoded here, once.
    ///
    /// # Errors
    /// When a column or an episode does not exist, no episode is long enough for a clip, a count is zero, or
    /// the data are damaged.
    pub fn new(reader: Arc<dyn Reader>, config: LoaderConfig) -> Result<Self> {
        let schema = config.clip.schema(reader.schema())?;
        if config.batch_size == 0 {
            return Err(Error::config("batch_size", "it is 0", "a batch needs at least one clip"));
        }
        let positions = match config.episodes {
            Some(positions) => positions,
            None => (0..reader.episodes().len()).collect(),
        };
        let clips = Clips::new(&config.clip, reader.episodes(), &positions)?;
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
        let cache = Cache::new(&*reader, &config.clip.columns, &positions, config.cache_bytes)?;
        let source = ClipSource {
            reader,
            cache,
            clips,
            spec: config.clip,
            schema,
            batch_size: config.batch_size,
            spare: Mutex::default(),
        };
        Ok(Self {
            clips: Arc::new(source),
            shuffle: config.shuffle,
            seed: config.seed,
            threads: config.threads,
            prefetch: config.prefetch.max(1),
            batches,
        })
    }

    /// The columns of a batch: `[num_steps, shape…]` a clip, actions `[num_steps, frameskip * numbers]`.
    pub fn schema(&self) -> &Schema {
        &self.clips.schema
    }

    /// How many clips there are.
    pub fn clips(&self) -> usize {
        self.clips.clips.len()
    }

    /// Batches in an epoch.
    pub fn batches_per_epoch(&self) -> usize {
        self.batches
    }

    /// Whether the decoded columns are kept in memory.
    pub fn is_cached(&self) -> bool {
        self.clips.cache.is_some()
    }

    /// Takes back a batch that is no longer needed. Its memory is filled again, which for large pictures
    /// takes less time than asking the system for fresh memory. Never necessary.
    pub fn recycle(&self, batch: Batch) {
        let mut spare = lock(&self.clips.spare);
        if *batch.schema() == self.clips.schema && spare.len() <= self.prefetch {
            spare.push(batch);
        }
    }

    /// The batches of an epoch, from `first_batch` on.
    pub fn epoch(&self, epoch: u64, first_batch: usize) -> Epoch {
        let order = self.shuffle.then(|| {
            #[allow(clippy::cast_possible_truncation)] // checked in `new`
            let mut order: Vec<u32> = (0..self.clips.clips.len() as u32).collect();
            shuffle(&mut order, Key::new(self.seed).with("loader").at(epoch));
            order
        });
        let work = Arc::new(Work {
            source: Arc::clone(&self.clips),
            order,
            end: self.batches,
            prefetch: self.prefetch,
            state: Mutex::new(State {
                next: first_batch,
                wanted: first_batch,
                done: BTreeMap::new(),
                idle: 0,
                stop: false,
            }),
            changed: Condvar::new(),
        });
        let threads = (0..self.threads.min(self.batches.saturating_sub(first_batch)))
            .map(|_| {
                let work = Arc::clone(&work);
                std::thread::spawn(move || work.run())
            })
            .collect();
        Epoch { work, threads, next: first_batch }
    }
}

/// Puts items in an order that the key decides (Fisher–Yates).
pub(crate) fn shuffle<T>(items: &mut [T], key: Key) {
    let mut rng = key.rng();
    for i in (1..items.len()).rev() {
        items.swap(i, rng.random_range(0..=i as u64) as usize);
    }
}

/// A poisoned lock means that a thread panicked while holding it; what we guard is valid at every step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Turns batch numbers into batches.
struct ClipSource {
    reader: Arc<dyn Reader>,
    cache: Option<Cache>,
    clips: Clips,
    spec: ClipSpec,
    schema: Schema,
    batch_size: usize,
    /// Batches that came back, to be filled again.
    spare: Mutex<Vec<Batch>>,
}

impl ClipSource {
    fn batch(&self, order: Option<&[u32]>, batch: usize) -> Result<Batch> {
        let first = batch * self.batch_size;
        let last = (first + self.batch_size).min(self.clips.len());
        let whole: Vec<StepRange> =
            (first..last).map(|i| self.clips.get(order.map_or(i, |order| order[i] as usize))).collect();
        let frameskip = self.spec.frameskip;
        let frames: Vec<StepRange> = whole
            .iter()
            .flat_map(|clip| {
                (0..self.spec.num_steps).map(|k| StepRange::new(clip.episode, clip.start + k * frameskip, 1))
            })
            .collect();
        let mut out = lock(&self.spare).pop().unwrap_or_else(|| Batch::zeros(&self.schema, 0));
        out.resize(whole.len());
        for (i, name) in self.spec.columns.iter().enumerate() {
            let ranges = if name == ACTION || frameskip == 1 { &whole } else { &frames };
            match &self.cache {
                Some(cache) => cache.copy(i, ranges, out.bytes_mut(i)),
                None => self.reader.read_column(name, ranges, out.bytes_mut(i))?,
            }
        }
        Ok(out)
    }
}

/// Decoded columns in memory.
struct Cache {
    data: Batch,
    /// The first row of each episode of the dataset, where it is held.
    first_row: Vec<usize>,
}

impl Cache {
    fn new(reader: &dyn Reader, columns: &[String], positions: &[usize], limit: usize) -> Result<Option<Self>> {
        let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
        let specs: Result<Vec<ColumnSpec>> = columns.iter().map(|name| reader.schema().column(name).cloned()).collect();
        let row_bytes: usize = specs?.iter().map(ColumnSpec::row_bytes).sum();
        let mut first_row = vec![usize::MAX; reader.episodes().len()];
        let mut ranges = vec![];
        let mut rows = 0;
        for &position in positions {
            if first_row[position] == usize::MAX {
                first_row[position] = rows;
                rows += reader.episodes()[position].length;
                ranges.push(StepRange::new(position, 0, reader.episodes()[position].length));
            }
        }
        if rows.saturating_mul(row_bytes) > limit {
            return Ok(None);
        }
        Ok(Some(Self { data: reader.read(&columns, &ranges)?, first_row }))
    }

    fn copy(&self, column: usize, ranges: &[StepRange], out: &mut [u8]) {
        let n = self.data.schema().columns()[column].row_bytes();
        let bytes = self.data.bytes(column);
        let mut at = 0;
        for range in ranges {
            let (from, len) = ((self.first_row[range.episode] + range.start) * n, range.length * n);
            out[at..at + len].copy_from_slice(&bytes[from..from + len]);
            at += len;
        }
    }
}

/// What the threads of one epoch share.
struct Work {
    source: Arc<ClipSource>,
    order: Option<Vec<u32>>,
    end: usize,
    prefetch: usize,
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    /// The first batch nobody has begun.
    next: usize,
    /// The batch the consumer gets next.
    wanted: usize,
    done: BTreeMap<usize, Result<Batch>>,
    /// Threads that ended.
    idle: usize,
    stop: bool,
}

impl Work {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn load(&self, batch: usize) -> Result<Batch> {
        self.source.batch(self.order.as_deref(), batch)
    }

    fn run(&self) {
        // Counts this thread as ended even when loading panics, so that the consumer never waits for it.
        struct Ended<'a>(&'a Work);
        impl Drop for Ended<'_> {
            fn drop(&mut self) {
                self.0.lock().idle += 1;
                self.0.changed.notify_all();
            }
        }
        let _ended = Ended(self);
        loop {
            let batch = {
                let mut state = self.lock();
                while !state.stop && state.next < self.end && state.next >= state.wanted + self.prefetch {
                    state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
                }
                if state.stop || state.next >= self.end {
                    return;
                }
                state.next += 1;
                state.next - 1
            };
            let result = self.load(batch);
            self.lock().done.insert(batch, result);
            self.changed.notify_all();
        }
    }
}

/// The batches of one epoch. Dropping it stops its threads.
pub struct Epoch {
    work: Arc<Work>,
    threads: Vec<JoinHandle<()>>,
    next: usize,
}

impl Iterator for Epoch {
    type Item = Result<Batch>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.next >= self.work.end {
            return None;
        }
        let batch = self.next;
        self.next += 1;
        if self.threads.is_empty() {
            return Some(self.work.load(batch));
        }
        let mut state = self.work.lock();
        let result = loop {
            if let Some(result) = state.done.remove(&batch) {
                break result;
            }
            if state.idle == self.threads.len() {
                break Err(Error::external("loading a batch", "a loader thread panicked; this is a bug"));
            }
            state = self.work.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        };
        state.wanted = self.next;
        drop(state);
        self.work.changed.notify_all();
        if result.is_err() {
            self.next = self.work.end;
        }
        Some(result)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.work.end.saturating_sub(self.next);
        (0, Some(left))
    }
}

impl Drop for Epoch {
    fn drop(&mut self) {
        self.work.lock().stop = true;
        self.work.changed.notify_all();
        for thread in self.threads.drain(..) {
            // A panic was already reported by its message; the consumer got an error.
            let _ = thread.join();
        }
    }
}
