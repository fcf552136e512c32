//! Acrobot: two links hang from a bar; a motor between them must swing the tip up to a target
//! (`dm_control/suite/acrobot.py`, model after Coulom 2002).

mod expert;

use super::domain::{Domain, TaskTable, tasks};
use super::measures::distance;
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::observation::ObservationWriter;
use super::reward::Tolerance;
use super::suite_env::entry;
use super::{factors, start};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Acrobot>(expert::EXPERTS);

/// Radius of the target, in metres.
const TARGET_RADIUS: f64 = 0.2;

/// The reward of the swing-up.
#[derive(Clone, Copy)]
pub enum Task {
    /// 1 within the target, 0 outside.
    Sparse,
    /// 1 within the target, falling with the distance outside.
    Dense,
}

/// The task and the indices of the domain's elements in the model.
pub struct Acrobot {
    task: Task,
    arms: [usize; 2],
    tip: usize,
    target: usize,
}

impl Domain for Acrobot {
    type Task = Task;
    const ID: &'static str = "swm/AcrobotDMControl-v0";
    const SUMMARY: &'static str = "Swing the tip of two hanging links up to a target with one motor between them";
    const MODEL: &'static str = "acrobot.xml";
    const TASKS: TaskTable<Task> = tasks! { "swingup_sparse" => Task::Sparse, "swingup" => Task::Dense };
    const SUBSTEPS: usize = 1;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.lower_arm_density"),
            factors::density("agent.upper_arm_density"),
            factors::binary("agent.upper_arm_locked", 1),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _task: Task) -> Result<()> {
        edit.common("light")?;
        edit.gravity();
        edit.density("upper_arm", "agent.upper_arm_density")?;
        edit.density("lower_arm", "agent.lower_arm_density")?;
        edit.material_color("target", "target.color", 1.0)?;
        edit.target_site(TARGET_RADIUS)
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self {
            task,
            arms: [index.body("upper_arm")?, index.body("lower_arm")?],
            tip: index.site("tip")?,
            target: index.site("target")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::randomize_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let frames = physics.data().xmat();
        observation.extend(self.arms.map(|arm| frames[arm][2]));
        observation.extend(self.arms.map(|arm| frames[arm][8]));
        observation.extend(physics.data().qvel());
    }

    fn goal_qpos(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos.fill(0.0);
        true
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let sites = physics.data().site_xpos();
        let to_target = distance(sites[self.target], sites[self.tip]);
        let near = Tolerance::within(0.0, physics.model().site_size()[self.target][0]);
        match self.task {
            Task::Sparse => near.of(to_target),
            Task::Dense => near.gaussian(1.0).of(to_target),
        }
    }
}
