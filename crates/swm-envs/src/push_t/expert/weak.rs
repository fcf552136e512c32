//! [`WeakExpert`]: random actions near the block.

use crate::push_t::ACTION_SCALE;
use rand::Rng as _;
use swm_core::columns::POS_AGENT;
use swm_core::policy::Expert;
use swm_core::{Key, Result, Rng, RowRef};

/// Uniformly random actions whose targets stay near the block, so that the agent sometimes pushes the block.
pub struct WeakExpert {
    rng: Rng,
}

/// The maximal distance of a target from the block's origin along each axis, in pixels (`expert_policy.py` of the
/// reference).
const NEAR: f64 = 100.0;

impl Default for WeakExpert {
    fn default() -> Self {
        Self { rng: Key::new(0).rng() }
    }
}

impl Expert for WeakExpert {
    fn begin(&mut self, key: Key) {
        self.rng = key.rng();
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let (agent, block) = (row.get::<f64>(POS_AGENT)?, row.get::<f64>("block_pose")?);
        let scale = f64::from(ACTION_SCALE);
        for i in 0..2 {
            let target = agent[i] + scale * self.rng.random_range(-1.0..=1.0);
            let near = target.clamp(block[i] - NEAR, block[i] + NEAR);
            action[i] = ((near - agent[i]) / scale).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}
