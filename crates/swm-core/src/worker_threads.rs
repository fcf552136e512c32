//! [`WorkerThreads`]: threads that join in the work of the thread that calls them.
//!
//! The calling thread offers work, does it like every other thread, and waits at the end only for the threads that
//! have begun. A worker thread that the system starts too late finds no work, and delays nobody. `loom/` checks this
//! file under all interleavings of its threads.
//!
//! Waking a thread takes longer than many steps of environments. A worker thread therefore watches for the next offer for
//! some microseconds before it sleeps. If offers come later than that, it soon stops watching, and tries again from time to
//! time.

use crate::sync::{Arc, AtomicUsize, Condvar, Mutex, Ordering, SPINS, WATCH, hint, lock, thread};
use erased::Erased;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// A panic, as `catch_unwind` returns it.
type Panic = Box<dyn Any + Send>;

/// How often a worker thread watches in vain until it sleeps at once.
const PATIENCE: usize = 3;
/// Then it watches once in so many times.
const RETRY: usize = 16;

/// Threads that join in the work of the thread that calls them.
pub struct WorkerThreads {
    shared: Arc<Shared>,
    threads: Vec<thread::JoinHandle<()>>,
}

struct Shared {
    offer: Mutex<Offer>,
    /// Signals a new offer, and the end.
    offered: Condvar,
    /// Signals that the last worker thread finished.
    finished: Condvar,
    /// The number of worker threads that are working. It grows only while [`Shared::offer`] is locked and holds work.
    working: AtomicUsize,
    /// The number of offers so far, which worker threads watch without the lock. It changes only while [`Shared::offer`] is
    /// locked.
    offers: AtomicUsize,
}

/// What the worker threads are asked to do.
#[derive(Default)]
struct Offer {
    work: Option<Erased>,
    /// The number of worker threads that may still begin.
    places: usize,
    /// The number of worker threads that sleep until the next offer.
    asleep: usize,
    /// Whether the calling thread sleeps until the last worker thread finishes.
    awaited: bool,
    panic: Option<Panic>,
    over: bool,
}

impl WorkerThreads {
    /// Starts `count` threads.
    ///
    /// # Errors
    /// When the operating system cannot start a thread.
    pub fn new(count: usize) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            offer: Mutex::new(Offer::default()),
            offered: Condvar::new(),
            finished: Condvar::new(),
            working: AtomicUsize::new(0),
            offers: AtomicUsize::new(0),
        });
        let mut workers = Self { shared, threads: Vec::with_capacity(count) };
        for i in 0..count {
            let shared = Arc::clone(&workers.shared);
            let thread = thread::Builder::new().name(format!("swm-step-{i}")).spawn(move || shared.serve())?;
            workers.threads.push(thread);
        }
        Ok(workers)
    }

    /// Calls `work` on this thread and, at the same time, on up to `count` worker threads, and returns when all of them
    /// have returned. `work` divides itself among its callers; a worker thread that comes late does not call it.
    ///
    /// # Errors
    /// The panic of a thread, if one panicked; the others finish first.
    pub fn run(&mut self, count: usize, work: &(dyn Fn() + Sync)) -> Result<(), Panic> {
        let places = count.min(self.threads.len());
        let asleep = {
            let mut offer = lock(&self.shared.offer);
            offer.work = Some(Erased::new(work));
            offer.places = places;
            self.shared.offers.fetch_add(1, Ordering::Relaxed);
            offer.asleep.min(places)
        };
        for _ in 0..asleep {
            self.shared.offered.notify_one();
        }
        let own = catch_unwind(AssertUnwindSafe(work));
        // From here on no thread begins, and after the wait none is inside `work`, whose borrow ends with this call.
        let panic = self.shared.withdraw();
        own.and(panic.map_or(Ok(()), Err))
    }
}

#[cfg(test)]
impl WorkerThreads {
    /// The number of worker threads that sleep until the next offer.
    #[allow(dead_code, reason = "`loom/` compiles this file without the tests of the pool")]
    pub(crate) fn asleep(&self) -> usize {
        lock(&self.shared.offer).asleep
    }
}

impl Drop for WorkerThreads {
    fn drop(&mut self) {
        lock(&self.shared.offer).over = true;
        self.shared.offered.notify_all();
        for thread in self.threads.drain(..) {
            // A worker thread catches the panics of its work, so it ends without one.
            drop(thread.join());
        }
    }
}

impl Shared {
    /// Withdraws the offer and waits for the threads that have begun; returns the first panic of one of them.
    fn withdraw(&self) -> Option<Panic> {
        let mut offer = lock(&self.offer);
        offer.work = None;
        if self.working.load(Ordering::Acquire) > 0 {
            drop(offer);
            for _ in 0..SPINS {
                if self.working.load(Ordering::Acquire) == 0 {
                    break;
                }
                hint::spin_loop();
            }
            offer = lock(&self.offer);
            while self.working.load(Ordering::Acquire) > 0 {
                offer.awaited = true;
                offer = self.finished.wait(offer).unwrap_or_else(std::sync::PoisonError::into_inner);
            }
            offer.awaited = false;
        }
        offer.panic.take()
    }

    /// Watches for some microseconds whether an offer comes after the last one.
    fn watch(&self, last: usize) -> bool {
        for _ in 0..WATCH {
            if self.offers.load(Ordering::Relaxed) != last {
                return true;
            }
            hint::spin_loop();
        }
        false
    }

    /// Joins in every work that is offered, until the end.
    fn serve(&self) {
        // The offer after which this thread watched last, and how often it slept since one came while it watched.
        let (mut watched, mut slept) = (None, 0usize);
        let mut offer = lock(&self.offer);
        while !offer.over {
            let begun = offer.work.filter(|_| offer.places > 0);
            let Some(work) = begun else {
                let last = self.offers.load(Ordering::Relaxed);
                if watched != Some(last) && (slept < PATIENCE || slept.is_multiple_of(RETRY)) {
                    watched = Some(last);
                    drop(offer);
                    if self.watch(last) {
                        slept = 0;
                    }
                    offer = lock(&self.offer);
                    continue;
                }
                slept = slept.wrapping_add(1);
                offer.asleep += 1;
                offer = self.offered.wait(offer).unwrap_or_else(std::sync::PoisonError::into_inner);
                offer.asleep -= 1;
                continue;
            };
            offer.places -= 1;
            self.working.fetch_add(1, Ordering::Relaxed);
            drop(offer);
            // This thread is counted in `working` from a moment at which the work was offered until after the call, and
            // `WorkerThreads::run`, which borrows the work, does not return before.
            let done = catch_unwind(AssertUnwindSafe(|| work.call()));
            offer = lock(&self.offer);
            if let Err(panic) = done {
                offer.panic.get_or_insert(panic);
            }
            if self.working.fetch_sub(1, Ordering::Release) == 1 && offer.awaited {
                self.finished.notify_one();
            }
        }
    }
}

/// Work without the lifetime of what it borrows.
#[allow(unsafe_code, reason = "threads that outlive a call borrow its work, which lifetimes cannot express")]
mod erased {
    /// A borrowed function, callable while [`super::WorkerThreads::run`] borrows it.
    #[derive(Clone, Copy)]
    pub(super) struct Erased(*const (dyn Fn() + Sync));

    // SAFETY: the function is `Sync`, so every thread may call it.
    unsafe impl Send for Erased {}

    impl Erased {
        /// Forgets the lifetime of `work`.
        pub(super) fn new<'a>(work: &'a (dyn Fn() + Sync + 'a)) -> Self {
            let work: *const (dyn Fn() + Sync + 'a) = work;
            // SAFETY: the types differ in the lifetime only.
            Self(unsafe { std::mem::transmute::<*const (dyn Fn() + Sync + 'a), *const (dyn Fn() + Sync)>(work) })
        }

        /// Calls the function. The caller, always `Shared::serve`, is counted in `Shared::working`.
        pub(super) fn call(self) {
            // SAFETY: a worker thread takes the work from the offer and counts itself under one lock, and calls it before
            // it stops counting. `WorkerThreads::run` withdraws the offer under the same lock, waits until no thread is
            // counted, and only then gives the borrow back.
            unsafe { (*self.0)() }
        }
    }
}
