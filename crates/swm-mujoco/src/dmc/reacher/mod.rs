//! Reacher: an arm of two links in a plane reaches for a target (`dm_control/suite/reacher.py`).

mod expert;

use super::domain::{Domain, InfoColumn, TaskTable, tasks};
use super::measures::norm;
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::observation::ObservationWriter;
use super::reward::Tolerance;
use super::suite_env::entry;
use super::{factors, start};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Reacher>(expert::EXPERTS);

/// Lengths of the links from shoulder to wrist and from wrist to finger, in metres.
const LINKS: [f64; 2] = [0.12, 0.12];

/// A task of the reacher domain.
#[derive(Clone, Copy)]
pub enum Task {
    /// Keep the finger within a target of this radius, in metres.
    Reach(f64),
    /// Match the joint angles of the goal, which terminates the episode.
    Match,
}

impl Task {
    /// The radius of the target, in metres.
    fn radius(self) -> f64 {
        match self {
            Self::Reach(radius) => radius,
            Self::Match => 0.015,
        }
    }
}

/// The task and the indices of the domain's elements in the model.
pub struct Reacher {
    task: Task,
    target: usize,
    finger: usize,
}

impl Reacher {
    /// The vector from the finger to the target, in metres.
    fn to_target(&self, physics: &Physics) -> [f64; 2] {
        let geoms = physics.data().geom_xpos();
        [0, 1].map(|axis| geoms[self.target][axis] - geoms[self.finger][axis])
    }
}

impl Domain for Reacher {
    type Task = Task;
    const ID: &'static str = "swm/ReacherDMControl-v0";
    const SUMMARY: &'static str = "Reach for a target with an arm of two links";
    const MODEL: &'static str = "reacher.xml";
    const TASKS: TaskTable<Task> =
        tasks! { "hard" => Task::Reach(0.015), "easy" => Task::Reach(0.05), "qpos_match" => Task::Match };
    const SUBSTEPS: usize = 1;
    const INFO: &'static [InfoColumn<Self>] = &[
        InfoColumn {
            name: "target_pos",
            len: 2,
            write: |reacher, physics, into| into.copy_from_slice(&physics.data().geom_xpos()[reacher.target][..2]),
        },
        InfoColumn {
            name: "finger_pos",
            len: 2,
            write: |reacher, physics, into| into.copy_from_slice(&physics.data().geom_xpos()[reacher.finger][..2]),
        },
    ];
    const TARGET_LEN: usize = 2;
    const GOAL_TOLERANCE: f64 = 0.05;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::density("agent.arm_density"),
            factors::agent_color(),
            factors::density("agent.finger_density"),
            factors::binary("agent.finger_locked", 1),
            factors::floor_color(),
            factors::light(),
            factors::render_target(),
        ];
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, task: Task) -> Result<()> {
        edit.common("light")?;
        edit.density("arm", "agent.arm_density")?;
        edit.density("finger", "agent.finger_density")?;
        edit.target_color()?;
        edit.target_geom("target", task.radius())
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self { task, target: index.geom("target")?, finger: index.geom("finger")? })
    }

    fn configure_model(&self, physics: &mut Physics) {
        physics.model_mut().geom_size_mut()[self.target][0] = self.task.radius();
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::randomize_joints(physics, rng);
        let (sin, cos) = rng.random_range(0.0..2.0 * PI).sin_cos();
        let radius = rng.random_range(0.05..0.2);
        self.set_target(physics, &[radius * sin, radius * cos]);
        physics.forward_passive();
        Ok(())
    }

    fn target(&self, physics: &Physics, into: &mut [f64]) {
        into.copy_from_slice(&physics.model().geom_pos()[self.target][..2]);
    }

    fn set_target(&self, physics: &mut Physics, target: &[f64]) {
        physics.model_mut().geom_pos_mut()[self.target][..2].copy_from_slice(target);
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        observation.extend(physics.data().qpos());
        observation.extend(self.to_target(physics));
        observation.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let sizes = physics.model().geom_size();
        Tolerance::within(0.0, sizes[self.target][0] + sizes[self.finger][0]).of(norm(&self.to_target(physics)))
    }

    /// The joint angles with the finger at the target, by inverse kinematics; the sign of the wrist angle does not
    /// change.
    fn goal_qpos(&self, physics: &Physics, qpos: &mut [f64]) -> bool {
        let target = physics.model().geom_pos()[self.target];
        let bend = wrist_angle(norm(&target[..2])).copysign(physics.data().qpos()[1]);
        let lead = (LINKS[1] * bend.sin()).atan2(LINKS[0] + LINKS[1] * bend.cos());
        qpos.copy_from_slice(&[target[1].atan2(target[0]) - lead, bend]);
        true
    }

    fn terminates_at_goal(&self) -> bool {
        matches!(self.task, Task::Match)
    }
}

/// The wrist angle (rad) at which the finger is `distance` metres from the shoulder, by the law of cosines.
fn wrist_angle(distance: f64) -> f64 {
    let [first, second] = LINKS;
    ((distance * distance - first * first - second * second) / (2.0 * first * second)).clamp(-1.0, 1.0).acos()
}
