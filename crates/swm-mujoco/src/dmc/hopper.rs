//! A planar one-legged hopper stands, hops and flips. The tricks are those of TD-MPC2 (Hansen et al. 2024) and Newt.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::{Tolerance, mean};
use super::{Domain, entry, factors, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Hopper>(&[]);

/// A torso this far above the foot stands, in metres.
const STANDING: Tolerance = Tolerance::within(0.6, 2.0);
/// An angular momentum that flips.
const SPIN: Tolerance = Tolerance::at_least(5.0).linear(2.5, 0.0);

/// What there is to do.
#[derive(Clone, Copy)]
pub enum Task {
    Hop,
    Stand,
    HopBackward,
    Flip,
    FlipBackward,
}

pub struct Hopper {
    task: Task,
    torso: usize,
    foot: usize,
    velocity: usize,
    touch: [usize; 2],
}

impl Hopper {
    /// How fast it moves forward, in m/s.
    fn speed(&self, physics: &Physics) -> f64 {
        physics.data().sensordata()[self.velocity]
    }

    /// How far the torso is above the foot, in metres.
    fn height(&self, physics: &Physics) -> f64 {
        let centres = physics.data().xipos();
        centres[self.torso][2] - centres[self.foot][2]
    }

    /// How fast it turns forward, as angular momentum.
    fn spin(&self, physics: &Physics) -> f64 {
        physics.data().subtree_angmom()[self.torso][1]
    }
}

impl Domain for Hopper {
    type Task = Task;
    const ID: &'static str = "swm/HopperDMControl-v0";
    const SUMMARY: &'static str = "Stand, hop and flip on one leg";
    const MODEL: &'static str = "hopper.xml";
    const TASKS: &'static [(&'static str, Task)] = &[
        ("hop", Task::Hop),
        ("stand", Task::Stand),
        ("hop-backward", Task::HopBackward),
        ("flip", Task::Flip),
        ("flip-backward", Task::FlipBackward),
    ];
    const NAMES: &'static [&'static str] = &task_names::<_, 5>(Self::TASKS);
    const SUBSTEPS: usize = 4;
    const INFO: &'static [(&'static str, usize)] = &[("speed", 1), ("height", 1), ("angmomentum", 1)];
    const IDLE: &'static [&'static str] = &["rootx"];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.foot_density"),
            factors::choice("agent.foot_locked", 1),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: Task) -> Result<()> {
        edit.scene("top")?;
        edit.gravity();
        edit.friction("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("foot", "agent.foot_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        Ok(Self {
            task,
            torso: names.body("torso")?,
            foot: names.body("foot")?,
            velocity: names.sensor("torso_subtreelinvel")?,
            touch: [names.sensor("touch_toe")?, names.sensor("touch_heel")?],
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::random_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        seen.extend(&physics.data().qpos()[1..]);
        seen.extend(physics.data().qvel());
        seen.extend(self.touch.map(|sensor| physics.data().sensordata()[sensor].ln_1p()));
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let standing = STANDING.of(self.height(physics));
        match self.task {
            Task::Hop => standing * Tolerance::at_least(2.0).linear(1.0, 0.5).of(self.speed(physics)),
            Task::HopBackward => standing * Tolerance::at_most(-1.0).linear(0.5, 0.5).of(self.speed(physics)),
            Task::Stand => {
                let calm = mean(Tolerance::within(0.0, 0.0).quadratic(1.0), physics.data().ctrl());
                standing * (calm + 4.0) / 5.0
            }
            Task::Flip => SPIN.of(self.spin(physics)),
            Task::FlipBackward => SPIN.of(-self.spin(physics)),
        }
    }

    fn info(&self, physics: &Physics, column: usize, into: &mut [f64]) {
        into[0] = match column {
            0 => self.speed(physics),
            1 => self.height(physics),
            _ => self.spin(physics),
        };
    }
}
