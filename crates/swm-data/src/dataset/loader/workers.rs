//! Worker threads that prefetch batches in the order of their indices, a limited number of batches ahead.

use crate::dataset::sync::{Condvar, Mutex, MutexGuard, lock, thread};
use std::collections::VecDeque;
use std::ops::{Deref, DerefMut, Range};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, PoisonError};
use std::time::Duration;
use swm_core::{Batch, Error, Result, Schema};

/// Produces batches by index. Several threads call [`BatchSource::produce`] concurrently.
pub(crate) trait BatchSource: Send + Sync {
    /// Produces a batch. The same index always gives the same batch.
    fn produce(&self, batch: usize) -> Result<LoadedBatch>;
}

/// A batch from a loader. When the batch is dropped, the loader reuses its memory, because allocating memory for large
/// images costs as much as decoding them.
pub struct LoadedBatch {
    /// `None` only after [`LoadedBatch::into_batch`].
    batch: Option<Batch>,
    pool: Arc<BatchPool>,
}

impl LoadedBatch {
    /// Converts to a plain batch, whose memory the loader does not reuse.
    pub fn into_batch(mut self) -> Batch {
        self.batch.take().expect("into_batch consumes self")
    }
}

impl Deref for LoadedBatch {
    type Target = Batch;

    fn deref(&self) -> &Batch {
        self.batch.as_ref().expect("only into_batch takes the batch")
    }
}

impl DerefMut for LoadedBatch {
    fn deref_mut(&mut self) -> &mut Batch {
        self.batch.as_mut().expect("only into_batch takes the batch")
    }
}

impl Drop for LoadedBatch {
    fn drop(&mut self) {
        if let Some(batch) = self.batch.take() {
            let mut spare = lock(&self.pool.batches);
            if spare.len() < self.pool.limit {
                spare.push(batch);
            }
        }
    }
}

/// Batches whose memory is reused.
pub(crate) struct BatchPool {
    batches: Mutex<Vec<Batch>>,
    limit: usize,
}

impl BatchPool {
    pub fn new(limit: usize) -> Arc<Self> {
        Arc::new(Self { batches: Mutex::default(), limit })
    }

    /// Returns a batch to fill: a reused batch, with its old rows and values, or a batch without rows.
    pub fn take(self: &Arc<Self>, schema: &Schema) -> LoadedBatch {
        let batch = lock(&self.batches).pop().unwrap_or_else(|| Batch::zeros(schema, 0));
        LoadedBatch { batch: Some(batch), pool: Arc::clone(self) }
    }
}

/// The threads of a loader.
pub(crate) struct Workers {
    shared: Arc<Shared>,
    threads: Vec<thread::JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Epochs that are being loaded, oldest first; usually there is one.
    jobs: Vec<Job>,
    /// Id of the next job.
    next_id: u64,
    stop: bool,
}

struct Job {
    id: u64,
    source: Arc<dyn BatchSource>,
    /// The next batch that the consumer takes.
    next_out: usize,
    /// The first batch that no thread has started.
    next: usize,
    end: usize,
    /// Maximum number of batches that are started and not consumed.
    window: usize,
    /// Results of the batches from `next_out` on; `None` for an unfinished batch.
    finished: VecDeque<Option<Result<LoadedBatch>>>,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        let mut state = self.lock();
        while !state.stop {
            let due = |job: &&mut Job| job.next < job.end && job.next < job.next_out + job.window;
            let Some(job) = state.jobs.iter_mut().find(due) else {
                state = self.wait(state);
                continue;
            };
            let (id, batch, source) = (job.id, job.next, Arc::clone(&job.source));
            job.next += 1;
            drop(state);
            // A panic becomes an error for the consumer, which would otherwise wait forever.
            let result = catch_unwind(AssertUnwindSafe(|| source.produce(batch)))
                .unwrap_or_else(|_| Err(Error::external("loading a batch", "a loader thread panicked; this is a bug")));
            drop(source);
            state = self.lock();
            // If the consumer dropped the epoch, its job is gone and the batch is dropped.
            if let Some(job) = state.jobs.iter_mut().find(|job| job.id == id) {
                let slot = batch - job.next_out;
                if job.finished.len() <= slot {
                    job.finished.resize_with(slot + 1, || None);
                }
                job.finished[slot] = Some(result);
                self.changed.notify_all();
            }
        }
    }
}

impl Workers {
    pub fn new(threads: usize) -> Result<Arc<Self>> {
        let mut workers = Self { shared: Arc::default(), threads: vec![] };
        for _ in 0..threads {
            let shared = Arc::clone(&workers.shared);
            // If a thread cannot be started, dropping `workers` stops the others.
            let thread = thread::Builder::new().name("swm-load".to_owned()).spawn(move || shared.work());
            workers.threads.push(thread.map_err(|error| Error::external("starting the loader's threads", error))?);
        }
        Ok(Arc::new(workers))
    }

    /// Starts loading batches, at most `window` batches ahead of the consumer.
    pub fn start(workers: &Arc<Self>, source: Arc<dyn BatchSource>, batches: Range<usize>, window: usize) -> Epoch {
        let mut id = 0;
        if !workers.threads.is_empty() {
            let mut state = workers.shared.lock();
            id = state.next_id;
            state.next_id += 1;
            let (first, end) = (batches.start, batches.end);
            let finished = VecDeque::with_capacity(window);
            let source = Arc::clone(&source);
            state.jobs.push(Job { id, source, next_out: first, next: first, end, window, finished });
            drop(state);
            workers.shared.changed.notify_all();
        }
        Epoch { workers: Arc::clone(workers), source, id, remaining: batches }
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.shared.lock().stop = true;
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // Workers catch panics, so joining cannot fail.
            let _ = thread.join();
        }
    }
}

/// The batches of one epoch, in order. Dropping this iterator stops prefetching.
pub struct Epoch {
    workers: Arc<Workers>,
    source: Arc<dyn BatchSource>,
    id: u64,
    remaining: Range<usize>,
}

impl Iterator for Epoch {
    type Item = Result<LoadedBatch>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.remaining.next()?;
        let result = if self.workers.threads.is_empty() { self.source.produce(batch) } else { self.wait_for(batch) };
        if result.is_err() {
            self.remaining = 0..0;
        }
        Some(result)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (0, Some(self.remaining.len()))
    }
}

impl Epoch {
    /// Waits at most `at_most` until [`Iterator::next`] can return without blocking. Returns `false` on a timeout.
    /// Callers that also check for signals call this method repeatedly.
    pub fn wait(&self, at_most: Duration) -> bool {
        if self.remaining.is_empty() || self.workers.threads.is_empty() {
            return true;
        }
        let shared = &self.workers.shared;
        let waiting = |state: &mut State| {
            let job = state.jobs.iter().find(|job| job.id == self.id);
            job.is_some_and(|job| !matches!(job.finished.front(), Some(Some(_))))
        };
        let waited = shared.changed.wait_timeout_while(shared.lock(), at_most, waiting);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    fn wait_for(&self, batch: usize) -> Result<LoadedBatch> {
        let shared = &self.workers.shared;
        let mut state = shared.lock();
        loop {
            let Some(job) = state.jobs.iter_mut().find(|job| job.id == self.id) else {
                return Err(Error::external("loading a batch", "its epoch has ended; this is a bug"));
            };
            if let Some(result) = job.finished.front_mut().and_then(Option::take) {
                job.finished.pop_front();
                job.next_out = batch + 1;
                drop(state);
                shared.changed.notify_all();
                return result;
            }
            state = shared.wait(state);
        }
    }
}

impl Drop for Epoch {
    fn drop(&mut self) {
        let mut state = self.workers.shared.lock();
        let ended = state.jobs.iter().position(|job| job.id == self.id).map(|slot| state.jobs.remove(slot));
        drop(state);
        // Frees the batches after the lock is released.
        drop(ended);
    }
}
