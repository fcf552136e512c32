//! Who finds the way through a maze: from cell to cell, along the shortest way. There is nobody who walks an ant.

use super::STRIDE;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef};

/// The experts.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "leads a point from cell to cell, along the shortest way; cannot walk an ant",
    make: || Box::new(Walker),
}];

/// Heads for the next place on the way.
struct Walker;

impl Expert for Walker {
    fn begin(&mut self, _: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        if action.len() != 2 {
            let problem = format!("it leads a point, not an agent of {} joints", action.len());
            return Err(Error::config(
                "expert of swm/OGBMaze-v0",
                problem,
                "leave loco_env_type=ant, or bring a policy",
            ));
        }
        let (here, next) = (row.to_f64("xy")?, row.to_f64("goal/next_xy")?);
        for (i, by) in action.iter_mut().enumerate() {
            *by = ((next[i] - here[i]) / f64::from(STRIDE)).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}
