//! The scripted expert of the reacher: a PD controller towards the goal's joint angles.

use std::f64::consts::PI;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef, columns};

/// The experts of the reacher.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "a PD controller that turns shoulder and wrist to the goal's angles",
    tasks: &[],
    make: || Box::new(Controller),
}];

/// Stiffness (control per radian) and damping (control per rad/s) for shoulder and wrist. The damping of the
/// wrist's joint suffices for the wrist.
const GAINS: [[f64; 2]; 2] = [[2.0, 0.15], [2.0, 0.0]];

/// A stateless controller that reads `qpos`, `qvel` and `goal_state`.
struct Controller;

impl Expert for Controller {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let [angles, speeds, goal] = [row.to_f64("qpos")?, row.to_f64("qvel")?, row.to_f64(columns::GOAL_STATE)?];
        let (&[shoulder, wrist], &[goal_shoulder, goal_wrist, ..]) = (&angles[..], &goal[..]) else {
            let given = format!("{} angles and {} goal values", angles.len(), goal.len());
            return Err(Error::mismatch("controlling a reacher", given, "2 angles and at least 2 goal values"));
        };
        // The shoulder is periodic, the wrist is limited.
        let error = [(goal_shoulder - shoulder + PI).rem_euclid(2.0 * PI) - PI, goal_wrist - wrist];
        for (i, [stiffness, damping]) in GAINS.into_iter().enumerate() {
            action[i] = (stiffness * error[i] - damping * speeds[i]).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}
