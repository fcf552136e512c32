//! Saves a replay buffer as a dataset.

use crate::dataset::{Location, ReplayBuffer, WriteOptions};
use crate::formats::create;
use swm_core::Result;

impl ReplayBuffer {
    /// Writes the stored episodes to a dataset of any format, from which [`ReplayBuffer::restore`] recreates the
    /// buffer.
    ///
    /// # Errors
    /// If the dataset cannot be written.
    pub fn save(&self, location: impl Into<Location>, options: WriteOptions) -> Result<()> {
        self.save_with(options, |schema, options| create(location, schema, options))
    }
}
