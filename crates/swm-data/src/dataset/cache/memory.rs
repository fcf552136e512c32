//! Rows in memory.

use super::{Budget, KeptRows};
use std::sync::{Arc, OnceLock};

/// Every row of a column, once it was read.
pub struct MemoryRows {
    rows: Vec<OnceLock<Box<[u8]>>>,
    budget: Arc<Budget>,
}

impl MemoryRows {
    /// Room for so many rows; memory is taken when they come.
    pub fn new(rows: usize, budget: Arc<Budget>) -> Self {
        Self { rows: (0..rows).map(|_| OnceLock::new()).collect(), budget }
    }
}

impl KeptRows for MemoryRows {
    fn get(&self, row: usize, out: &mut [u8]) -> bool {
        let Some(kept) = self.rows[row].get() else { return false };
        out.copy_from_slice(kept);
        true
    }

    fn put(&self, row: usize, bytes: &[u8]) {
        if self.rows[row].get().is_none() && self.budget.take(bytes.len()) {
            // Two threads may come with the same row; the second copy is let go, which costs its share of the budget.
            let _ = self.rows[row].set(bytes.into());
        }
    }
}
