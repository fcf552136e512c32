//! [`TraceLog`]: a log of every plan of a run and of its search.

use serde::Serialize;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::PlanTrace;

/// The record of one plan.
#[derive(Clone, Debug, Serialize)]
pub struct PlanRecord {
    /// The seed of the episode, as in evaluation results.
    pub episode: u64,
    /// The slot in which the episode was played.
    pub slot: usize,
    /// The number of earlier plans in the episode.
    pub replan: u64,
    /// The number of environments planned in the same call; the time of the call is divided equally among them.
    pub together: usize,
    /// Seconds the plan took, including the encoding of the present observation.
    pub seconds: f64,
    /// The part of `seconds` that was spent in the model.
    pub model_seconds: f64,
    /// The cost of the best candidate.
    pub cost: f32,
    /// The search, one entry for each iteration.
    #[serde(flatten)]
    pub search: PlanTrace,
}

/// A log of plans. Clones refer to the same log: the policy writes to one clone, and the caller reads another.
#[derive(Clone, Debug, Default)]
pub struct TraceLog(Arc<Mutex<Vec<PlanRecord>>>);

impl TraceLog {
    /// Returns the plans recorded since the last call, in the order in which they were made.
    pub fn take(&self) -> Vec<PlanRecord> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub(super) fn push(&self, record: PlanRecord) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(record);
    }
}
