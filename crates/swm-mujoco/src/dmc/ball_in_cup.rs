//! A ball hangs on a string from a cup that moves in a plane: throw it up and catch it.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::{Domain, entry, factors, norm, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<BallInCup>(&[]);

/// Places in `qpos`: the cup's and the ball's slides along x and z.
const CUP: [usize; 2] = [0, 1];
const BALL: [usize; 2] = [2, 3];
/// Half the width, depth and height of the inside of the cup, in metres.
const INSIDE: [f64; 3] = [0.05, 0.006, 0.05];
/// The ball's slides when it is in the middle of a cup at rest.
const CAUGHT: [f64; 2] = [0.0, 0.35];

pub struct BallInCup {
    ball: usize,
    ball_geom: usize,
    inside: usize,
}

impl BallInCup {
    /// Whether the whole ball is inside the cup, in the plane it moves in.
    fn caught(&self, physics: &Physics) -> bool {
        let (inside, ball) = (physics.data().site_xpos()[self.inside], physics.data().xpos()[self.ball]);
        let (room, size) = (physics.model().site_size()[self.inside], physics.model().geom_size()[self.ball_geom][0]);
        [0, 2].into_iter().all(|axis| (inside[axis] - ball[axis]).abs() < room[axis] - size)
    }
}

impl Domain for BallInCup {
    type Task = ();
    const ID: &'static str = "swm/BallInCupDMControl-v0";
    const SUMMARY: &'static str = "Catch a ball that hangs on a string in the cup it hangs from";
    const MODEL: &'static str = "ball_in_cup.xml";
    const TASKS: &'static [(&'static str, ())] = &[("catch", ())];
    const NAMES: &'static [&'static str] = &task_names::<_, 1>(Self::TASKS);
    const SUBSTEPS: usize = 10;
    const NEAR: f64 = 0.02;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.density"),
            factors::color("ball.color", [0.7, 0.5, 0.3]),
            factors::density("ball.density"),
            factors::number("ball.size", 0.01, 0.05, 0.025),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.extend([factors::light(), factors::render_target()]);
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: ()) -> Result<()> {
        edit.scene("light")?;
        edit.gravity();
        for part in ["cup_part_0", "cup_part_1", "cup_part_2", "cup_part_3", "cup_part_4"] {
            edit.density(part, "agent.density")?;
        }
        edit.density("ball", "ball.density")?;
        edit.radius("ball", "ball.size")?;
        edit.target_room("target", INSIDE)
    }

    fn new(model: &MjModel, _task: ()) -> Result<Self> {
        let names = Names(model);
        Ok(Self { ball: names.body("ball")?, ball_geom: names.geom("ball")?, inside: names.site("target")? })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::without_contacts(physics, rng, |physics, rng| {
            let qpos = physics.data_mut().qpos_mut();
            qpos[BALL[0]] = rng.random_range(-0.2..0.2);
            qpos[BALL[1]] = rng.random_range(0.2..0.5);
        })
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        seen.extend(physics.data().qpos());
        seen.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        f64::from(u8::from(self.caught(physics)))
    }

    fn destination(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos[..2].fill(0.0);
        qpos[2..].copy_from_slice(&CAUGHT);
        true
    }

    /// With the ball in the cup, wherever that is, every goal that asks for it is reached.
    fn reached(&self, physics: &Physics, goal: &[f64]) -> Option<bool> {
        let [x, z] = off_centre(goal);
        let (room, size) = (physics.model().site_size()[self.inside], physics.model().geom_size()[self.ball_geom][0]);
        (x.abs() < room[0] - size && z.abs() < room[2] - size).then(|| self.caught(physics))
    }

    fn left(&self, physics: &Physics, goal: &[f64]) -> Option<f64> {
        let wanted = self.reached(physics, goal)?;
        Some(if wanted { 0.0 } else { norm(&off_centre(physics.data().qpos())) })
    }
}

/// How far the ball is from the middle of the cup, along x and z.
fn off_centre(qpos: &[f64]) -> [f64; 2] {
    [0, 1].map(|axis| qpos[BALL[axis]] - qpos[CUP[axis]] - CAUGHT[axis])
}
