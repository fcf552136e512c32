//! Memory that is reused between calls.

use std::sync::{Mutex, PoisonError};

/// A pool of scratch values. The size of the pool is the largest number of threads that have used it at the same time.
#[derive(Debug, Default)]
pub struct ScratchPool<T>(Mutex<Vec<T>>);

impl<T: Default> ScratchPool<T> {
    /// Calls `work` with a scratch value that no other thread uses meanwhile. The value still contains the data of its
    /// last use.
    pub fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        let unused = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut scratch = unused().pop().unwrap_or_default();
        let result = work(&mut scratch);
        unused().push(scratch);
        result
    }
}

/// Returns the first `length` elements of a buffer, which grows to `length` elements if necessary.
pub fn grown(buffer: &mut Vec<f32>, length: usize) -> &mut [f32] {
    if buffer.len() < length {
        buffer.resize(length, 0.0);
    }
    &mut buffer[..length]
}
