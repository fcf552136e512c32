//! Requirements of model families on datasets, as plain data.
//!
//! Model families state them, and the doctor of datasets compares them with a dataset. So neither needs the other's
//! crate.

use serde::Serialize;

/// What a model family requires of a dataset to be trained on it. Every family requires continuous actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct DatasetRequirements {
    /// Name of the family, as reports show it.
    pub model: &'static str,
    /// Whether images ([`PIXELS`](crate::columns::PIXELS)) are required; otherwise a state vector suffices.
    pub images: bool,
    /// Whether rewards ([`REWARD`](crate::columns::REWARD)) are required.
    pub reward: bool,
    /// Rows of a training clip, which is the minimum length of an episode.
    pub clip_rows: usize,
}
