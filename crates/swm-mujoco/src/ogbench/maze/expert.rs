//! The scripted expert of mazes: moves a point from cell to cell along the shortest path. There is no expert for the
//! ant.

use super::task::POINT_STEP;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef};

/// The experts of mazes.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "moves a point from cell to cell along the shortest path; cannot control the ant",
    tasks: &[],
    make: || Box::new(PathFollower),
}];

/// An expert that moves the point towards the position in the column `goal/next_xy`.
struct PathFollower;

impl Expert for PathFollower {
    fn begin(&mut self, _: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        if action.len() != 2 {
            let problem = format!("it controls the point, not an agent with {} actuators", action.len());
            return Err(Error::config(
                "expert of swm/OGBMaze-v0",
                problem,
                "choose loco_env_type=point, or use a policy for the ant",
            ));
        }
        let (xy, next_xy) = (row.to_f64("xy")?, row.to_f64("goal/next_xy")?);
        for (i, displacement) in action.iter_mut().enumerate() {
            *displacement = ((next_xy[i] - xy[i]) / f64::from(POINT_STEP)).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}
