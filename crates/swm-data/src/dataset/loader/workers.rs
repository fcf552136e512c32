//! Threads that make numbered batches ahead of whoever consumes them, in order, and never more than fit.

use crate::dataset::sync::lock;
use std::collections::VecDeque;
use std::ops::{Deref, DerefMut, Range};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;
use swm_core::{Batch, Error, Result, Schema};

/// Makes numbered batches. Called by several threads at once.
pub(crate) trait Produce: Send + Sync {
    /// The batch of that number; the same whenever it is asked for.
    fn produce(&self, batch: usize) -> Result<Loaded>;
}

/// A batch that a loader made. Dropped, its memory is filled again: fresh memory for large pictures costs as much as
/// a fast decoder takes.
pub struct Loaded {
    /// Taken only when it leaves.
    batch: Option<Batch>,
    spare: Arc<Spare>,
}

impl Loaded {
    /// The batch for good; the loader will ask for other memory.
    pub fn into_batch(mut self) -> Batch {
        self.batch.take().expect("a batch leaves once")
    }
}

impl Deref for Loaded {
    type Target = Batch;

    fn deref(&self) -> &Batch {
        self.batch.as_ref().expect("a batch leaves with its owner")
    }
}

impl DerefMut for Loaded {
    fn deref_mut(&mut self) -> &mut Batch {
        self.batch.as_mut().expect("a batch leaves with its owner")
    }
}

impl Drop for Loaded {
    fn drop(&mut self) {
        if let Some(batch) = self.batch.take() {
            let mut kept = lock(&self.spare.batches);
            if kept.len() < self.spare.limit {
                kept.push(batch);
            }
        }
    }
}

/// Batches that came back.
pub(crate) struct Spare {
    batches: Mutex<Vec<Batch>>,
    limit: usize,
}

impl Spare {
    pub fn new(limit: usize) -> Arc<Self> {
        Arc::new(Self { batches: Mutex::default(), limit })
    }

    /// A batch to fill, of any number of rows and any content.
    pub fn take(self: &Arc<Self>, schema: &Schema) -> Loaded {
        let batch = lock(&self.batches).pop().unwrap_or_else(|| Batch::zeros(schema, 0));
        Loaded { batch: Some(batch), spare: Arc::clone(self) }
    }
}

/// The threads of a loader.
pub(crate) struct Workers {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Epochs that are being consumed, oldest first; commonly one.
    jobs: Vec<Job>,
    /// What the next job is called.
    name: u64,
    stop: bool,
}

struct Job {
    name: u64,
    producer: Arc<dyn Produce>,
    /// The batch the consumer gets next.
    wanted: usize,
    /// The first batch nobody has begun.
    next: usize,
    end: usize,
    /// Batches begun and not consumed, at most.
    window: usize,
    /// Batches `wanted ..`, those that are made.
    made: VecDeque<Option<Result<Loaded>>>,
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
            let due = |job: &&mut Job| job.next < job.end && job.next < job.wanted + job.window;
            let Some(job) = state.jobs.iter_mut().find(due) else {
                state = self.wait(state);
                continue;
            };
            let (name, batch, producer) = (job.name, job.next, Arc::clone(&job.producer));
            job.next += 1;
            drop(state);
            // A panic is the consumer's to hear of; it must not wait for a thread that is gone.
            let made = catch_unwind(AssertUnwindSafe(|| producer.produce(batch)))
                .unwrap_or_else(|_| Err(Error::external("loading a batch", "a loader thread panicked; this is a bug")));
            drop(producer);
            state = self.lock();
            // The consumer may have gone; nobody wants the batch then.
            if let Some(job) = state.jobs.iter_mut().find(|job| job.name == name) {
                let place = batch - job.wanted;
                if job.made.len() <= place {
                    job.made.resize_with(place + 1, || None);
                }
                job.made[place] = Some(made);
                self.changed.notify_all();
            }
        }
    }
}

impl Workers {
    pub fn new(threads: usize) -> Result<Arc<Self>> {
        let shared = Arc::<Shared>::default();
        let threads: std::io::Result<Vec<JoinHandle<()>>> = (0..threads)
            .map(|_| {
                let shared = Arc::clone(&shared);
                std::thread::Builder::new().name("swm-load".to_owned()).spawn(move || shared.work())
            })
            .collect();
        let threads = threads.map_err(|error| Error::external("starting the loader's threads", error))?;
        Ok(Arc::new(Self { shared, threads }))
    }

    /// Begins to make batches, at most `window` ahead.
    pub fn start(workers: &Arc<Self>, producer: Arc<dyn Produce>, batches: Range<usize>, window: usize) -> Epoch {
        let mut name = 0;
        if !workers.threads.is_empty() {
            let mut state = workers.shared.lock();
            name = state.name;
            state.name += 1;
            let (first, end) = (batches.start, batches.end);
            let made = VecDeque::with_capacity(window);
            let producer = Arc::clone(&producer);
            state.jobs.push(Job { name, producer, wanted: first, next: first, end, window, made });
            drop(state);
            workers.shared.changed.notify_all();
        }
        Epoch { workers: Arc::clone(workers), producer, name, left: batches }
    }
}

impl Drop for Workers {
    fn drop(&mut self) {
        self.shared.lock().stop = true;
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // They catch what panics.
            let _ = thread.join();
        }
    }
}

/// The batches of one epoch, in order. Dropping it ends the loading ahead.
pub struct Epoch {
    workers: Arc<Workers>,
    producer: Arc<dyn Produce>,
    name: u64,
    left: Range<usize>,
}

impl Iterator for Epoch {
    type Item = Result<Loaded>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.left.next()?;
        let result = if self.workers.threads.is_empty() { self.producer.produce(batch) } else { self.wait_for(batch) };
        if result.is_err() {
            self.left = 0..0;
        }
        Some(result)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (0, Some(self.left.len()))
    }
}

impl Epoch {
    /// Waits until [`Iterator::next`] has an answer, at most for so long, and says whether it has. Who must look after
    /// something else meanwhile, such as signals, asks again and again.
    pub fn wait(&self, at_most: Duration) -> bool {
        if self.left.is_empty() || self.workers.threads.is_empty() {
            return true;
        }
        let shared = &self.workers.shared;
        let waiting = |state: &mut State| {
            let job = state.jobs.iter().find(|job| job.name == self.name);
            job.is_some_and(|job| !matches!(job.made.front(), Some(Some(_))))
        };
        let waited = shared.changed.wait_timeout_while(shared.lock(), at_most, waiting);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    fn wait_for(&self, batch: usize) -> Result<Loaded> {
        let shared = &self.workers.shared;
        let mut state = shared.lock();
        loop {
            let Some(job) = state.jobs.iter_mut().find(|job| job.name == self.name) else {
                return Err(Error::external("loading a batch", "its epoch has ended; this is a bug"));
            };
            if let Some(made) = job.made.front_mut().and_then(Option::take) {
                job.made.pop_front();
                job.wanted = batch + 1;
                drop(state);
                shared.changed.notify_all();
                return made;
            }
            state = shared.wait(state);
        }
    }
}

impl Drop for Epoch {
    fn drop(&mut self) {
        let mut state = self.workers.shared.lock();
        let ended = state.jobs.iter().position(|job| job.name == self.name).map(|place| state.jobs.remove(place));
        drop(state);
        // Batches are freed without the lock.
        drop(ended);
    }
}
