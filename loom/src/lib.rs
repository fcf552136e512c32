//! Models of the loader's prefetch queue and of the pool's worker threads.
//!
//! These are the only code of the engine that waits on a condition variable across the threads of a computation: rayon
//! divides other work, and workers of Gymnasium answer over a socket. The models compile the files themselves, with loom's
//! primitives in the place of the standard library's. A `cfg(loom)` in `swm-data` would also reach its dependencies: tokio,
//! for example, has another interface under it.

/// The primitives that the pool's worker threads import.
#[cfg(test)]
mod sync {
    pub use loom::sync::atomic::{AtomicUsize, Ordering};
    pub use loom::sync::{Arc, Condvar, Mutex, MutexGuard};
    pub use loom::{hint, thread};
    use std::sync::PoisonError;

    /// No spinning: loom runs every interleaving of the sleep that follows it.
    pub const SPINS: usize = 0;
    /// One look, so that a thread also finds work before it sleeps.
    pub const WATCH: usize = 1;

    pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
        mutex.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
#[path = "../../crates/swm-core/src/worker_threads.rs"]
mod worker_threads;

#[cfg(test)]
mod pool_models {
    use crate::worker_threads::WorkerThreads;
    use loom::cell::UnsafeCell;
    use loom::sync::atomic::{AtomicUsize, Ordering};

    /// Items that threads take one by one, as the pool's slots. loom reports a thread that writes an item while another
    /// one reads or writes it.
    struct Items {
        taken: AtomicUsize,
        items: [UnsafeCell<usize>; 2],
    }

    // SAFETY: the counter gives every item to one thread.
    unsafe impl Sync for Items {}

    impl Items {
        fn new() -> Self {
            Self { taken: AtomicUsize::new(0), items: std::array::from_fn(|_| UnsafeCell::new(0)) }
        }

        fn work(&self) {
            loop {
                let index = self.taken.fetch_add(1, Ordering::Relaxed);
                let Some(item) = self.items.get(index) else { break };
                // SAFETY: only this thread has the index.
                item.with_mut(|item| unsafe { *item += 1 });
            }
        }

        fn done(&self) -> Vec<usize> {
            // SAFETY: the threads have left the work.
            self.items.iter().map(|item| item.with(|item| unsafe { *item })).collect()
        }
    }

    fn check(model: impl Fn() + Send + Sync + 'static) {
        let mut builder = loom::model::Builder::new();
        builder.preemption_bound = Some(3);
        builder.check(model);
    }

    #[test]
    fn every_item_is_worked_on_once_and_no_thread_stays_inside() {
        check(|| {
            let mut workers = WorkerThreads::new(1).expect("a thread");
            // The items of the first call are dropped before the second: a thread that stayed inside would use them.
            for _ in 0..2 {
                let items = Items::new();
                workers.run(1, &|| items.work()).expect("no panic");
                assert_eq!(items.done(), [1, 1]);
            }
        });
    }

    #[test]
    fn two_threads_join_in_or_come_too_late() {
        check(|| {
            let mut workers = WorkerThreads::new(2).expect("threads");
            let items = Items::new();
            workers.run(2, &|| items.work()).expect("no panic");
            assert_eq!(items.done(), [1, 1]);
        });
    }

    #[test]
    fn threads_end_without_work() {
        check(|| drop(WorkerThreads::new(2).expect("threads")));
    }
}

/// The modules that the queue imports.
#[cfg(test)]
mod dataset {
    pub mod sync {
        pub use loom::sync::{Mutex, MutexGuard};
        pub use loom::thread;
        use std::sync::{LockResult, PoisonError};
        use std::time::Duration;

        pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
            mutex.lock().unwrap_or_else(PoisonError::into_inner)
        }

        /// loom's condition variable with the one method of the standard library's that it lacks.
        #[derive(Default)]
        pub struct Condvar(loom::sync::Condvar);

        /// The result of a wait that never times out: loom has no time.
        pub struct NoTimeout;

        impl NoTimeout {
            pub fn timed_out(&self) -> bool {
                false
            }
        }

        impl Condvar {
            pub fn wait<'a, T>(&self, guard: MutexGuard<'a, T>) -> LockResult<MutexGuard<'a, T>> {
                self.0.wait(guard)
            }

            pub fn notify_all(&self) {
                self.0.notify_all();
            }

            pub fn wait_timeout_while<'a, T>(
                &self,
                mut guard: MutexGuard<'a, T>,
                _: Duration,
                mut waiting: impl FnMut(&mut T) -> bool,
            ) -> LockResult<(MutexGuard<'a, T>, NoTimeout)> {
                while waiting(&mut guard) {
                    guard = self.0.wait(guard).unwrap_or_else(PoisonError::into_inner);
                }
                Ok((guard, NoTimeout))
            }
        }
    }
}

#[cfg(test)]
#[allow(dead_code, reason = "the models use a part of it")]
#[path = "../../crates/swm-data/src/dataset/loader/workers.rs"]
mod workers;

#[cfg(test)]
mod models {
    use crate::workers::{BatchPool, BatchSource, LoadedBatch, Workers};
    use std::sync::Arc;
    use std::time::Duration;
    use swm_core::{ColumnSpec, DType, Error, Result, Schema};

    /// Produces batches that hold their index, and an error for the batch `fails`.
    struct Counter {
        schema: Schema,
        pool: Arc<BatchPool>,
        fails: Option<usize>,
    }

    impl Counter {
        fn new(fails: Option<usize>) -> Arc<Self> {
            let schema = Schema::new([ColumnSpec::new("index", DType::Int64, [])]).expect("a schema");
            Arc::new(Self { schema, pool: BatchPool::new(2), fails })
        }
    }

    impl BatchSource for Counter {
        fn produce(&self, batch: usize) -> Result<LoadedBatch> {
            if self.fails == Some(batch) {
                return Err(Error::external("producing a batch", "it fails"));
            }
            let mut out = self.pool.take(&self.schema);
            out.resize(1);
            out.row_mut(0).set(0, &[batch as i64]);
            Ok(out)
        }
    }

    fn index(batch: &LoadedBatch) -> i64 {
        batch.get::<i64>("index").expect("the column")[0]
    }

    /// Runs a model under all interleavings with up to three preemptions, which find nearly all faults of queues.
    fn check(model: impl Fn() + Send + Sync + 'static) {
        let mut builder = loom::model::Builder::new();
        builder.preemption_bound = Some(3);
        builder.check(model);
    }

    #[test]
    fn batches_arrive_in_order() {
        check(|| {
            let workers = Workers::new(2).expect("workers");
            let epoch = Workers::start(&workers, Counter::new(None), 0..3, 2);
            let found: Vec<i64> = epoch.map(|batch| index(&batch.expect("a batch"))).collect();
            assert_eq!(found, [0, 1, 2]);
        });
    }

    #[test]
    fn a_window_of_one_batch_does_not_deadlock() {
        check(|| {
            let workers = Workers::new(2).expect("workers");
            let mut epoch = Workers::start(&workers, Counter::new(None), 4..6, 1);
            assert!(epoch.wait(Duration::MAX));
            assert_eq!(index(&epoch.next().expect("two batches").expect("a batch")), 4);
            assert_eq!(index(&epoch.next().expect("two batches").expect("a batch")), 5);
            assert!(epoch.next().is_none());
        });
    }

    #[test]
    fn an_epoch_can_be_dropped_at_any_time() {
        check(|| {
            let workers = Workers::new(1).expect("a worker");
            let mut first = Workers::start(&workers, Counter::new(None), 0..3, 2);
            assert_eq!(index(&first.next().expect("three batches").expect("a batch")), 0);
            drop(first);
            let second = Workers::start(&workers, Counter::new(None), 7..8, 2);
            let found: Vec<i64> = second.map(|batch| index(&batch.expect("a batch"))).collect();
            assert_eq!(found, [7]);
        });
    }

    #[test]
    fn a_failed_batch_ends_the_epoch() {
        check(|| {
            let workers = Workers::new(2).expect("workers");
            let mut epoch = Workers::start(&workers, Counter::new(Some(1)), 0..3, 3);
            assert_eq!(index(&epoch.next().expect("a batch").expect("a batch")), 0);
            assert!(epoch.next().expect("the failed batch").is_err());
            assert!(epoch.next().is_none());
        });
    }

    #[test]
    fn workers_stop_without_work() {
        check(|| drop(Workers::new(2).expect("workers")));
    }
}
