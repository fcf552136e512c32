//! [`ObservationWriter`]: writes the observation of a domain element by element.

use std::borrow::Borrow;

/// Writes an observation, converting to single precision.
pub struct ObservationWriter<'a> {
    row: &'a mut [f32],
    written: usize,
}

impl<'a> ObservationWriter<'a> {
    /// Writes to `row` from its first element on.
    pub fn new(row: &'a mut [f32]) -> Self {
        Self { row, written: 0 }
    }

    /// The number of elements written.
    pub fn written(&self) -> usize {
        self.written
    }

    /// Appends a value.
    pub fn push(&mut self, value: f64) {
        self.row[self.written] = value as f32;
        self.written += 1;
    }

    /// Appends values.
    pub fn extend(&mut self, values: impl IntoIterator<Item = impl Borrow<f64>>) {
        values.into_iter().for_each(|value| self.push(*value.borrow()));
    }
}
