//! The primitives of [`crate::worker_threads`], and [`lock`], which ignores poisoning.
//!
//! `loom/` compiles the worker threads with other primitives of the same names, which run them under all interleavings
//! of their threads.

use std::sync::PoisonError;
pub use std::sync::atomic::{AtomicUsize, Ordering};
pub use std::sync::{Arc, Condvar, Mutex, MutexGuard};
pub use std::{hint, thread};

/// How often a thread looks whether others are done, before it sleeps until they are: about as long as a thread takes to
/// wake up.
pub const SPINS: usize = 200;

/// How often a worker thread looks whether there is more work before it sleeps: 20 to 90 microseconds by the processor, about as
/// long as a sleeping thread takes to run again.
pub const WATCH: usize = 2000;

/// Locks a mutex, even if another thread panicked while that thread held the lock.
///
/// The guarded data is valid after every single statement, so a panic cannot leave it half updated.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
