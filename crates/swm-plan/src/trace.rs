//! [`TraceLog`]: every plan of a run and how its search went, for whoever asks for it.

use serde::Serialize;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::PlanTrace;

/// One plan.
#[derive(Clone, Debug, Serialize)]
pub struct PlanRecord {
    /// The episode it was made in, by the number that results call its seed.
    pub episode: u64,
    /// The slot that played the episode.
    pub slot: usize,
    /// How many plans the episode had before.
    pub replan: u64,
    /// How many environments were planned in the same call; they share its time equally.
    pub together: usize,
    /// Seconds it took, encoding the present included.
    pub seconds: f64,
    /// How many of these seconds were spent in the model.
    pub model_seconds: f64,
    /// The cost of its best candidate.
    pub cost: f32,
    /// The search, one number an iteration.
    #[serde(flatten)]
    pub search: PlanTrace,
}

/// Where a policy notes its plans. Clones are one and the same log, so that one is given to the policy and another is
/// read in the end.
#[derive(Clone, Debug, Default)]
pub struct TraceLog(Arc<Mutex<Vec<PlanRecord>>>);

impl TraceLog {
    /// The plans noted since the last call, in the order in which they were made.
    pub fn take(&self) -> Vec<PlanRecord> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub(crate) fn note(&self, record: PlanRecord) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(record);
    }
}
