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
    /// The required observations.
    pub observations: RequiredObservations,
    /// Whether rewards ([`REWARD`](crate::columns::REWARD)) are required.
    pub reward: bool,
    /// Rows of a training clip, which is the minimum length of an episode.
    pub clip_rows: usize,
}

/// The observations that a model family requires.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RequiredObservations {
    /// Images in the column [`PIXELS`](crate::columns::PIXELS).
    Images,
    /// Images or a state vector.
    ImagesOrState,
    /// A state vector in the column [`STATE`](crate::columns::STATE) or `observation`.
    State,
}
