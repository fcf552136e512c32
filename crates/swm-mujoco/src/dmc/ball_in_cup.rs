//! Ball in cup: a ball hangs on a string from a cup that moves in a plane; the task is to swing the ball up and catch
//! it (`dm_control/suite/ball_in_cup.py`).

use super::domain::{Domain, TaskTable, tasks};
use super::measures::norm;
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::observation::ObservationWriter;
use super::suite_env::entry;
use super::{factors, start};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<BallInCup>(&[]);

/// Indices in `qpos` of the cup's slides along x and z.
const CUP: [usize; 2] = [0, 1];
/// Indices in `qpos` of the ball's slides along x and z.
const BALL: [usize; 2] = [2, 3];
/// Half the width, depth and height of the inside of the cup, in metres.
const CUP_INSIDE: [f64; 3] = [0.05, 0.006, 0.05];
/// Positions (m) of the ball's slides with the ball in the middle of the cup, if the cup's slides are at 0.
const CAUGHT: [f64; 2] = [0.0, 0.35];

/// The indices of the domain's elements in the model.
pub struct BallInCup {
    ball: usize,
    ball_geom: usize,
    inside: usize,
}

impl BallInCup {
    /// Whether the whole ball is inside the cup along x and z.
    fn caught(&self, physics: &Physics) -> bool {
        let (inside, ball) = (physics.data().site_xpos()[self.inside], physics.data().xpos()[self.ball]);
        let (room, size) = (physics.model().site_size()[self.inside], physics.model().geom_size()[self.ball_geom][0]);
        [0, 2].into_iter().all(|axis| (inside[axis] - ball[axis]).abs() < room[axis] - size)
    }
}

impl Domain for BallInCup {
    type Task = ();
    const ID: &'static str = "swm/BallInCupDMControl-v0";
    const SUMMARY: &'static str = "Catch a ball in the cup from which it hangs on a string";
    const MODEL: &'static str = "ball_in_cup.xml";
    const TASKS: TaskTable<()> = tasks! { "catch" => () };
    const SUBSTEPS: usize = 10;
    const GOAL_TOLERANCE: f64 = 0.02;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.density"),
            factors::color("ball.color", [0.7, 0.5, 0.3]),
            factors::density("ball.density"),
            factors::scalar("ball.size", 0.01, 0.05, 0.025),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.extend([factors::light(), factors::render_target()]);
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _task: ()) -> Result<()> {
        edit.common("light")?;
        edit.gravity();
        for geom in ["cup_part_0", "cup_part_1", "cup_part_2", "cup_part_3", "cup_part_4"] {
            edit.density(geom, "agent.density")?;
        }
        edit.density("ball", "ball.density")?;
        edit.radius("ball", "ball.size")?;
        edit.target_region("target", CUP_INSIDE)
    }

    fn new(model: &MjModel, _task: ()) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self { ball: index.body("ball")?, ball_geom: index.geom("ball")?, inside: index.site("target")? })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::sample_without_contacts(physics, rng, |physics, rng| {
            let qpos = physics.data_mut().qpos_mut();
            qpos[BALL[0]] = rng.random_range(-0.2..0.2);
            qpos[BALL[1]] = rng.random_range(0.2..0.5);
        })
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        observation.extend(physics.data().qpos());
        observation.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        f64::from(u8::from(self.caught(physics)))
    }

    fn goal_qpos(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos[..2].fill(0.0);
        qpos[2..].copy_from_slice(&CAUGHT);
        true
    }

    /// A goal with the ball in the cup is reached when the ball is in the cup, at any position of the cup.
    fn goal_reached(&self, physics: &Physics, goal: &[f64]) -> Option<bool> {
        let [x, z] = off_centre(goal);
        let (room, size) = (physics.model().site_size()[self.inside], physics.model().geom_size()[self.ball_geom][0]);
        (x.abs() < room[0] - size && z.abs() < room[2] - size).then(|| self.caught(physics))
    }

    fn goal_distance(&self, physics: &Physics, goal: &[f64]) -> Option<f64> {
        let reached = self.goal_reached(physics, goal)?;
        Some(if reached { 0.0 } else { norm(&off_centre(physics.data().qpos())) })
    }
}

/// The ball's offset from the middle of the cup along x and z, in metres.
fn off_centre(qpos: &[f64]) -> [f64; 2] {
    [0, 1].map(|axis| qpos[BALL[axis]] - qpos[CUP[axis]] - CAUGHT[axis])
}
