//! A controller that turns both joints to the goal's angles.

use std::f64::consts::PI;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef};

/// Who can demonstrate reaching.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "turns shoulder and wrist to the goal's angles, harder the further away, and brakes in time",
    make: || Box::new(Controller),
}];

/// For shoulder and wrist: the control for a radian that is missing, and against a radian a second. The wrist is light, so that
/// its own damping brakes it.
const GAINS: [[f64; 2]; 2] = [[2.0, 0.15], [2.0, 0.0]];

/// Acts on `qpos`, `qvel` and `goal_state` alone.
struct Controller;

impl Expert for Controller {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let [angles, speeds, goal] = [row.to_f64("qpos")?, row.to_f64("qvel")?, row.to_f64("goal_state")?];
        let (&[shoulder, wrist], &[goal_shoulder, goal_wrist, ..]) = (&angles[..], &goal[..]) else {
            let given = format!("{} angles and {} numbers of a goal", angles.len(), goal.len());
            return Err(Error::mismatch("controlling a reacher", given, "2 and at least 2"));
        };
        // The shoulder turns all the way round, the wrist does not.
        let missing = [(goal_shoulder - shoulder + PI).rem_euclid(2.0 * PI) - PI, goal_wrist - wrist];
        for (i, [stiffness, damping]) in GAINS.into_iter().enumerate() {
            action[i] = (stiffness * missing[i] - damping * speeds[i]).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}
