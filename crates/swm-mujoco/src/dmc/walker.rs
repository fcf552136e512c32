//! A planar walker stands, walks, runs, and strikes poses. The poses are those of TD-MPC2 (Hansen et al. 2024) and Newt.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, entry, factors, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Walker>(&[]);

/// A torso this high stands, in metres.
const STANDING: Tolerance = Tolerance::at_least(1.2).gaussian(0.6);
/// What is this high is up, in a pose.
const UP: Tolerance = Tolerance::at_least(1.0).gaussian(0.5);
/// What is this low lies.
const LYING: Tolerance = Tolerance::at_most(0.08).gaussian(0.04);
/// A foot this low is on the ground, in a pose.
const FOOT_DOWN: Tolerance = Tolerance::at_most(0.08).gaussian(0.5);
/// Feet this high are up.
const FEET_UP: Tolerance = Tolerance::at_least(1.1).gaussian(0.55);

/// What there is to do.
#[derive(Clone, Copy)]
pub enum Task {
    Stand,
    /// Go forward at this speed, in m/s.
    Go(f64),
    WalkBackward,
    Arabesque,
    LieDown,
    LegsUp,
    Flip,
}

pub struct Walker {
    task: Task,
    torso: usize,
    /// Left and right.
    feet: [usize; 2],
    thighs: [usize; 2],
    velocity: usize,
}

impl Walker {
    /// How fast it moves forward, in m/s.
    fn speed(&self, physics: &Physics) -> f64 {
        physics.data().sensordata()[self.velocity]
    }

    fn torso_height(&self, physics: &Physics) -> f64 {
        physics.data().xpos()[self.torso][2]
    }

    fn upright(&self, physics: &Physics) -> f64 {
        physics.data().xmat()[self.torso][8]
    }

    fn stand(&self, physics: &Physics) -> f64 {
        let upright = f64::midpoint(1.0, self.upright(physics));
        (3.0 * STANDING.of(self.torso_height(physics)) + upright) / 4.0
    }

    fn go(&self, physics: &Physics, speed: Tolerance) -> f64 {
        self.stand(physics) * (5.0 * speed.of(self.speed(physics)) + 1.0) / 6.0
    }
}

impl Domain for Walker {
    type Task = Task;
    const ID: &'static str = "swm/WalkerDMControl-v0";
    const SUMMARY: &'static str = "Stand, walk, run and strike poses with a planar walker";
    const MODEL: &'static str = "walker.xml";
    const TASKS: &'static [(&'static str, Task)] = &[
        ("walk", Task::Go(1.0)),
        ("stand", Task::Stand),
        ("run", Task::Go(8.0)),
        ("walk-backward", Task::WalkBackward),
        ("arabesque", Task::Arabesque),
        ("lie_down", Task::LieDown),
        ("legs_up", Task::LegsUp),
        ("flip", Task::Flip),
    ];
    const NAMES: &'static [&'static str] = &task_names::<_, 8>(Self::TASKS);
    const SUBSTEPS: usize = 10;
    const INFO: &'static [(&'static str, usize)] = &[
        ("speed", 1),
        ("torso_height", 1),
        ("torso_upright", 1),
        ("left_foot_height", 1),
        ("right_foot_height", 1),
        ("left_thigh_height", 1),
        ("right_thigh_height", 1),
    ];
    const IDLE: &'static [&'static str] = &["rootx"];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.left_foot_density"),
            factors::choice("agent.right_knee_locked", 1),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
            factors::floor_rotation(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: Task) -> Result<()> {
        edit.scene("light")?;
        edit.gravity();
        edit.friction("floor")?;
        edit.tilt("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("left_foot", "agent.left_foot_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        Ok(Self {
            task,
            torso: names.body("torso")?,
            feet: [names.body("left_foot")?, names.body("right_foot")?],
            thighs: [names.body("left_thigh")?, names.body("right_thigh")?],
            velocity: names.sensor("torso_subtreelinvel")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::random_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        seen.extend(physics.data().xmat()[1..].iter().flat_map(|frame| [frame[0], frame[2]]));
        seen.push(self.torso_height(physics));
        seen.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let height = |body: usize| physics.data().xpos()[body][2];
        let middle = |[left, right]: [usize; 2]| f64::midpoint(height(left), height(right));
        let torso = self.torso_height(physics);
        let upside_down = f64::midpoint(1.0, -self.upright(physics));
        match self.task {
            Task::Stand => self.stand(physics),
            Task::Go(speed) => self.go(physics, Tolerance::at_least(speed).linear(speed / 2.0, 0.5)),
            Task::WalkBackward => self.go(physics, Tolerance::at_most(-1.0).linear(0.5, 0.5)),
            Task::Arabesque => {
                let [left, right] = self.feet.map(height);
                (3.0 * UP.of(torso) + FOOT_DOWN.of(left) + UP.of(right) + upside_down) / 6.0
            }
            Task::LieDown => (3.0 * LYING.of(torso) + LYING.of(middle(self.thighs)) + upside_down) / 5.0,
            Task::LegsUp => {
                let (thighs, feet) = (LYING.of(middle(self.thighs)), FEET_UP.of(middle(self.feet)));
                (3.0 * LYING.of(torso) + 2.0 * feet + thighs + upside_down) / 7.0
            }
            Task::Flip => (3.0 * FEET_UP.of(middle(self.feet)) + 2.0 * UP.of(middle(self.thighs))) / 5.0,
        }
    }

    fn info(&self, physics: &Physics, column: usize, into: &mut [f64]) {
        let height = |body: usize| physics.data().xpos()[body][2];
        into[0] = match column {
            0 => self.speed(physics),
            1 => self.torso_height(physics),
            2 => self.upright(physics),
            3 => height(self.feet[0]),
            4 => height(self.feet[1]),
            5 => height(self.thighs[0]),
            _ => height(self.thighs[1]),
        };
    }
}
