//! Scripted controllers.

use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, RowRef};

pub const REACHERS: &[ExpertEntry] =
    &[ExpertEntry { id: "expert", summary: "leads the gripper straight to the goal", make: || Box::new(Reacher) }];
pub const PUSHERS: &[ExpertEntry] = &[];
pub const SLIDERS: &[ExpertEntry] = &[];
pub const PICKERS: &[ExpertEntry] = &[];

struct Reacher;

impl Expert for Reacher {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let (known, goal) = (row.get::<f64>("proprio")?, row.get::<f64>("goal_state")?);
        for i in 0..3 {
            action[i] = ((goal[i] - known[i]) / 0.05).clamp(-1.0, 1.0);
        }
        action[3] = 0.0;
        Ok(())
    }
}
