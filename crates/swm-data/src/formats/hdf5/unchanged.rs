//! [`Unchanged`]: tells whether an open file still holds the dataset that was opened.

use super::source::Source;
use crate::dataset::StepRange;
use crate::formats::opened::State;
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use swm_core::{Error, Result};

/// The first row that was read of each column.
pub(super) type Seen = BTreeMap<String, (StepRange, Vec<u8>)>;

/// What is known of an open file. A replaced file stays open as it was, but a program can also write another dataset over it in
/// place, whose rows would then be read in the layout of the first.
pub(super) struct Unchanged {
    state: Mutex<Option<State>>,
    /// Compared with what the file holds if it changes.
    seen: Mutex<Seen>,
}

impl Unchanged {
    /// A file before its structure is read.
    pub fn new(source: &Source) -> Self {
        Self { state: Mutex::new(source.state()), seen: Mutex::default() }
    }

    /// Checks, after `rows` of a column were read from `ranges`, that they are of the dataset that was opened. `grew` compares
    /// what the file holds now with what was read before; it is called only if the file was written to, as a writer that appends
    /// does.
    ///
    /// # Errors
    /// If another dataset was written over the file.
    pub fn check(
        &self,
        source: &Source,
        (column, ranges, rows): (&str, &[StepRange], &[u8]),
        grew: impl Fn(&Seen) -> bool,
    ) -> Result<()> {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let now = source.state();
        let mut known = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if now != *known && !grew(&seen) {
            let problem = "another program has written over it since the dataset was opened";
            return Err(Error::corrupt(source.label(), problem, "open the dataset again"));
        }
        *known = now;
        let total: usize = ranges.iter().map(|range| range.length).sum();
        if let Some(first) = ranges.iter().find(|range| range.length > 0)
            && !seen.contains_key(column)
        {
            let row = StepRange::new(first.episode, first.start, 1);
            seen.insert(column.to_owned(), (row, rows[..rows.len() / total].to_vec()));
        }
        Ok(())
    }
}
