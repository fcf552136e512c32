//! A planar cheetah runs, or does tricks. The tricks are those of TD-MPC2 (Hansen et al. 2024) and Newt.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, entry, factors, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Cheetah>(&[]);

/// Time steps in which a start falls to the ground.
const SETTLE: usize = 200;
/// A torso or foot this high jumps, in metres.
const JUMP: Tolerance = Tolerance::at_least(1.2).gaussian(0.6);
/// How low lies, in metres.
const LIE: f64 = 0.25;
/// An angular momentum that flips.
const SPIN: Tolerance = Tolerance::at_least(8.0).linear(8.0, 0.0);

/// What there is to do, and how fast, in m/s.
#[derive(Clone, Copy)]
pub enum Task {
    Run,
    RunBackward,
    StandFront,
    StandBack,
    Jump,
    RunFront,
    RunBack,
    LieDown,
    LegsUp,
    Flip,
    FlipBackward,
}

pub struct Cheetah {
    task: Task,
    torso: usize,
    front: usize,
    back: usize,
    velocity: usize,
}

impl Cheetah {
    /// How fast it moves forward, in m/s.
    fn speed(&self, physics: &Physics) -> f64 {
        physics.data().sensordata()[self.velocity]
    }

    /// How fast it turns forward, as angular momentum.
    fn spin(&self, physics: &Physics) -> f64 {
        physics.data().subtree_angmom()[self.torso][1]
    }

    /// Standing on one foot with the other one, and the torso, up. Its speed must be zero to the last digit.
    fn stand(&self, physics: &Physics, raised: usize) -> f64 {
        let height = |body: usize| physics.data().xpos()[body][2];
        let up = JUMP.of(f64::midpoint(height(self.torso), height(raised)));
        (5.0 * up + Tolerance::within(0.0, 0.0).of(self.speed(physics))) / 6.0
    }

    /// One foot and the torso up.
    fn one_foot(&self, physics: &Physics, raised: usize) -> f64 {
        let height = |body: usize| physics.data().xpos()[body][2];
        (3.0 * JUMP.of(height(raised)) + 2.0 * JUMP.of(height(self.torso))) / 5.0
    }

    /// The same while running at half speed.
    fn run_on_one_foot(&self, physics: &Physics, raised: usize) -> f64 {
        let fast = Tolerance::at_least(5.0).linear(5.0, 0.0).of(self.speed(physics));
        self.one_foot(physics, raised) * (5.0 * fast + 1.0) / 6.0
    }

    fn flip(&self, physics: &Physics, forward: f64) -> f64 {
        let along = Tolerance::at_least(0.0).of(forward * self.speed(physics));
        (2.0 * SPIN.of(forward * self.spin(physics)) + along) / 3.0
    }
}

impl Domain for Cheetah {
    type Task = Task;
    const ID: &'static str = "swm/CheetahDMControl-v0";
    const SUMMARY: &'static str = "Run with a planar cheetah, or do tricks";
    const MODEL: &'static str = "cheetah.xml";
    const TASKS: &'static [(&'static str, Task)] = &[
        ("run", Task::Run),
        ("run-backward", Task::RunBackward),
        ("stand-front", Task::StandFront),
        ("stand-back", Task::StandBack),
        ("jump", Task::Jump),
        ("run-front", Task::RunFront),
        ("run-back", Task::RunBack),
        ("lie-down", Task::LieDown),
        ("legs-up", Task::LegsUp),
        ("flip", Task::Flip),
        ("flip-backward", Task::FlipBackward),
    ];
    const NAMES: &'static [&'static str] = &task_names::<_, 11>(Self::TASKS);
    const SUBSTEPS: usize = 1;
    const LIMIT: usize = 1250;
    const INFO: &'static [(&'static str, usize)] =
        &[("speed", 1), ("torso_height", 1), ("bfoot_height", 1), ("ffoot_height", 1), ("angmomentum", 1)];
    const IDLE: &'static [&'static str] = &["rootx"];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::density("agent.back_foot_density"),
            factors::choice("agent.back_foot_locked", 1),
            factors::agent_color(),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: Task) -> Result<()> {
        edit.scene("light")?;
        edit.gravity();
        edit.friction("ground")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("bfoot", "agent.back_foot_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        Ok(Self {
            task,
            torso: names.body("torso")?,
            front: names.body("ffoot")?,
            back: names.body("bfoot")?,
            velocity: names.sensor("torso_subtreelinvel")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::limited_joints(physics, rng);
        physics.step_control(SETTLE);
        physics.data_mut().set_time(0.0);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        seen.extend(&physics.data().qpos()[1..]);
        seen.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let low = |height| Tolerance::at_most(LIE).linear(LIE, 0.0).of(height);
        let height = |body: usize| physics.data().xpos()[body][2];
        match self.task {
            Task::Run => Tolerance::at_least(10.0).linear(10.0, 0.0).of(self.speed(physics)),
            Task::RunBackward => Tolerance::at_most(-10.0).linear(10.0, 0.0).of(self.speed(physics)),
            Task::StandFront => self.stand(physics, self.back),
            Task::StandBack => self.stand(physics, self.front),
            Task::Jump => f64::midpoint(self.stand(physics, self.back), self.stand(physics, self.front)),
            Task::RunFront => self.run_on_one_foot(physics, self.back),
            Task::RunBack => self.run_on_one_foot(physics, self.front),
            Task::LieDown => {
                (3.0 * low(height(self.torso)) + low(f64::midpoint(height(self.front), height(self.back)))) / 4.0
            }
            Task::LegsUp => {
                let down = Tolerance::at_most(LIE).gaussian(LIE / 2.0).of(height(self.torso));
                (5.0 * down + self.one_foot(physics, self.back)) / 6.0
            }
            Task::Flip => self.flip(physics, 1.0),
            Task::FlipBackward => self.flip(physics, -1.0),
        }
    }

    fn info(&self, physics: &Physics, column: usize, into: &mut [f64]) {
        let height = |body: usize| physics.data().xpos()[body][2];
        into[0] = match column {
            0 => self.speed(physics),
            1 => height(self.torso),
            2 => height(self.back),
            3 => height(self.front),
            _ => self.spin(physics),
        };
    }
}
