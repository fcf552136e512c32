//! [`RunState`]: the progress of a run, stored in its checkpoint as `state.json`.

use super::metrics::MetricWindow;
use serde::{Deserialize, Serialize};

/// The progress of a run. With the tensors of the checkpoint, it determines how the run continues.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct RunState {
    /// The number of finished optimizer steps.
    pub step: usize,
    /// The step and the loss of the best validation.
    #[serde(default)]
    pub best: Option<(usize, f64)>,
    /// The number of validations since the best validation.
    #[serde(default, rename = "looks")]
    pub validations_since_best: usize,
    /// The metrics since the last line of the log.
    #[serde(default, skip_serializing_if = "MetricWindow::is_empty")]
    pub window: MetricWindow,
}

/// Returns whether an action that repeats every `every` steps, and happens after the last step, is due after `done` of
/// `steps` steps. With `every` = 0, the action is never due.
pub(crate) fn is_due(every: usize, done: usize, steps: usize) -> bool {
    every > 0 && (done.is_multiple_of(every) || done == steps)
}
