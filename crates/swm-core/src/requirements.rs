//! Requirements of model families on datasets, as plain data.
//!
//! Model families state their requirements, and `swm doctor` compares them with a dataset. These types are in this
//! crate so that the crates of models and datasets do not depend on each other.

use serde::Serialize;

/// The requirements of a model family on its training dataset. Every family requires continuous actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct DatasetRequirements {
    /// The name of the family in reports.
    pub model: &'static str,
    /// The required observations.
    pub observations: RequiredObservations,
    /// Whether rewards ([`REWARD`](crate::columns::REWARD)) are required.
    pub reward: bool,
    /// The number of rows of a training clip, which is also the minimum length of an episode.
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
