//! An arm of two links in a plane reaches for a target.

mod expert;

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, entry, factors, norm, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Reacher>(expert::EXPERTS);

/// Lengths of the links, from the shoulder to the wrist and on to the finger, in metres.
const LINKS: [f64; 2] = [0.12, 0.12];

/// What there is to do.
#[derive(Clone, Copy)]
pub enum Task {
    /// Hold the finger to a target of this radius, in metres.
    Reach(f64),
    /// Match the joint angles of the goal, which ends the episode.
    Match,
}

impl Task {
    fn radius(self) -> f64 {
        match self {
            Self::Reach(radius) => radius,
            Self::Match => 0.015,
        }
    }
}

pub struct Reacher {
    task: Task,
    target: usize,
    finger: usize,
}

impl Reacher {
    fn to_target(&self, physics: &Physics) -> [f64; 2] {
        let places = physics.data().geom_xpos();
        [0, 1].map(|axis| places[self.target][axis] - places[self.finger][axis])
    }
}

impl Domain for Reacher {
    type Task = Task;
    const ID: &'static str = "swm/ReacherDMControl-v0";
    const SUMMARY: &'static str = "Reach for a target with an arm of two links";
    const MODEL: &'static str = "reacher.xml";
    const TASKS: &'static [(&'static str, Task)] =
        &[("hard", Task::Reach(0.015)), ("easy", Task::Reach(0.05)), ("qpos_match", Task::Match)];
    const NAMES: &'static [&'static str] = &task_names::<_, 3>(Self::TASKS);
    const SUBSTEPS: usize = 1;
    const INFO: &'static [(&'static str, usize)] = &[("target_pos", 2), ("finger_pos", 2)];
    const TARGET: usize = 2;
    const NEAR: f64 = 0.05;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::density("agent.arm_density"),
            factors::agent_color(),
            factors::density("agent.finger_density"),
            factors::choice("agent.finger_locked", 1),
            factors::floor_color(),
            factors::light(),
            factors::render_target(),
        ];
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut Edit<'_>, task: Task) -> Result<()> {
        edit.scene("light")?;
        edit.density("arm", "agent.arm_density")?;
        edit.density("finger", "agent.finger_density")?;
        edit.target_color()?;
        edit.target_geom("target", task.radius())
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        Ok(Self { task, target: names.geom("target")?, finger: names.geom("finger")? })
    }

    fn adapt(&self, physics: &mut Physics) {
        physics.model_mut().geom_size_mut()[self.target][0] = self.task.radius();
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::random_joints(physics, rng);
        let (sin, cos) = rng.random_range(0.0..2.0 * PI).sin_cos();
        let radius = rng.random_range(0.05..0.2);
        self.place(physics, &[radius * sin, radius * cos]);
        physics.forward_passive();
        Ok(())
    }

    fn target(&self, physics: &Physics, into: &mut [f64]) {
        into.copy_from_slice(&physics.model().geom_pos()[self.target][..2]);
    }

    fn place(&self, physics: &mut Physics, target: &[f64]) {
        physics.model_mut().geom_pos_mut()[self.target][..2].copy_from_slice(target);
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        seen.extend(physics.data().qpos());
        seen.extend(self.to_target(physics));
        seen.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let sizes = physics.model().geom_size();
        Tolerance::within(0.0, sizes[self.target][0] + sizes[self.finger][0]).of(norm(&self.to_target(physics)))
    }

    /// The joint angles that hold the finger to the target, the elbow bent to the side it is bent to now.
    fn destination(&self, physics: &Physics, qpos: &mut [f64]) -> bool {
        let place = physics.model().geom_pos()[self.target];
        let bend = elbow(norm(&place[..2])).copysign(physics.data().qpos()[1]);
        let lead = (LINKS[1] * bend.sin()).atan2(LINKS[0] + LINKS[1] * bend.cos());
        qpos.copy_from_slice(&[place[1].atan2(place[0]) - lead, bend]);
        true
    }

    fn ends_at_goal(&self) -> bool {
        matches!(self.task, Task::Match)
    }

    fn info(&self, physics: &Physics, column: usize, into: &mut [f64]) {
        let geom = if column == 0 { self.target } else { self.finger };
        into.copy_from_slice(&physics.data().geom_xpos()[geom][..2]);
    }
}

/// How far the elbow is bent when the finger is this far from the shoulder.
fn elbow(away: f64) -> f64 {
    let [first, second] = LINKS;
    ((away * away - first * first - second * second) / (2.0 * first * second)).clamp(-1.0, 1.0).acos()
}
