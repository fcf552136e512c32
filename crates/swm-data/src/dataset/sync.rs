//! The primitives of the loader's queue, and [`lock`], which ignores poisoning.
//!
//! `loom/` compiles the queue with other primitives of the same names, which run it under all interleavings of its
//! threads.

use std::sync::PoisonError;
pub use std::sync::{Condvar, Mutex, MutexGuard};
pub use std::thread;

/// Locks a mutex, even if another thread panicked while that thread held the lock.
///
/// The data guarded in this crate is valid after every single statement, so a panic cannot leave it half updated.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
