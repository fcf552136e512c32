//! A cache of decoded rows in memory.

use super::{Budget, RowCache};
use std::sync::{Arc, OnceLock};

/// Cached rows of a column in memory.
pub struct MemoryRowCache {
    rows: Vec<OnceLock<Box<[u8]>>>,
    budget: Arc<Budget>,
}

impl MemoryRowCache {
    /// An empty cache for `rows` rows. Memory is allocated when rows are added.
    pub fn new(rows: usize, budget: Arc<Budget>) -> Self {
        Self { rows: (0..rows).map(|_| OnceLock::new()).collect(), budget }
    }
}

impl RowCache for MemoryRowCache {
    fn get(&self, row: usize, out: &mut [u8]) -> bool {
        let Some(cached) = self.rows[row].get() else { return false };
        out.copy_from_slice(cached);
        true
    }

    fn put(&self, row: usize, bytes: &[u8]) {
        if self.rows[row].get().is_none() && self.budget.take(bytes.len()) {
            // If two threads add the same row, the second copy is dropped but stays counted in the budget.
            let _ = self.rows[row].set(bytes.into());
        }
    }
}
