//! [`FiniteCheck`]: warns of NaN and infinite values that an environment returns.

use crate::describe::{EnvLayout, header};
use std::sync::atomic::{AtomicBool, Ordering};
use swm_core::columns::REWARD;
use swm_core::finite::not_finite;

/// Warns once per column of the environments of one id. Values are stored as they are; `swm collect --strict-finite`
/// refuses them.
#[derive(Default)]
pub struct FiniteCheck {
    reward: AtomicBool,
    /// Whether a column was reported, in the order of the columns.
    columns: Vec<AtomicBool>,
}

impl FiniteCheck {
    /// Creates the checks of an environment with this number of columns.
    pub fn new(columns: usize) -> Self {
        Self { columns: (0..columns).map(|_| AtomicBool::new(false)).collect(), ..Self::default() }
    }

    /// Checks the outputs of a reset or a step in the buffer of the bridge.
    pub fn check(&self, layout: &EnvLayout, memory: &[u8]) {
        let reward = memory.get(header::REWARD..header::REWARD + size_of::<f64>());
        // Rewards are stored in single precision.
        let reward: f64 = reward.map_or(0.0, bytemuck::pod_read_unaligned);
        if !(reward as f32).is_finite() {
            warn(&self.reward, &layout.spec.id, REWARD);
        }
        for ((column, range), reported) in layout.spec.columns.iter().zip(&layout.columns).zip(&self.columns) {
            if not_finite(column.dtype, memory.get(range.clone()).unwrap_or_default()) > 0 {
                warn(reported, &layout.spec.id, &column.name);
            }
        }
    }
}

/// Warns unless `reported` is set, and sets it.
fn warn(reported: &AtomicBool, id: &str, column: &str) {
    if !reported.swap(true, Ordering::Relaxed) {
        tracing::warn!("{id}: '{column}' has NaN or infinite values; further ones are not reported");
    }
}
