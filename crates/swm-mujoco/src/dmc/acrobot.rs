//! Two links hang from a bar; a motor between them must swing the tip up to a target. Model after Coulom 2002.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, distance, entry, factors, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Acrobot>(&[]);

/// Radius of the target, in metres.
const SIZE: f64 = 0.2;

/// Whether rewards are given near the target, too.
#[derive(Clone, Copy)]
pub enum Task {
    SwingUpSparse,
    SwingUp,
}

pub struct Acrobot {
    task: Task,
    arms: [usize; 2],
    tip: usize,
    target: usize,
}

impl Domain for Acrobot {
    type Task = Task;
    const ID: &'static str = "swm/AcrobotDMControl-v0";
    const SUMMARY: &'static str = "Swing the tip of two hanging links up to a target, with one motor between them";
    const MODEL: &'static str = "acrobot.xml";
    const TASKS: &'static [(&'static str, Task)] =
        &[("swingup_sparse", Task::SwingUpSparse), ("swingup", Task::SwingUp)];
    const NAMES: &'static [&'static str] = &task_names::<_, 2>(Self::TASKS);
    const SUBSTEPS: usize = 1;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.lower_arm_density"),
            factors::density("agent.upper_arm_density"),
            factors::choice("agent.upper_arm_locked", 1),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: Task) -> Result<()> {
        edit.scene("light")?;
        edit.gravity();
        edit.density("upper_arm", "agent.upper_arm_density")?;
        edit.density("lower_arm", "agent.lower_arm_density")?;
        edit.paint("target", "target.color", 1.0)?;
        edit.target_site(SIZE)
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        Ok(Self {
            task,
            arms: [names.body("upper_arm")?, names.body("lower_arm")?],
            tip: names.site("tip")?,
            target: names.site("target")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::random_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        let frames = physics.data().xmat();
        seen.extend(self.arms.map(|arm| frames[arm][2]));
        seen.extend(self.arms.map(|arm| frames[arm][8]));
        seen.extend(physics.data().qvel());
    }

    fn destination(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos.fill(0.0);
        true
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let places = physics.data().site_xpos();
        let away = distance(places[self.target], places[self.tip]);
        let near = Tolerance::within(0.0, physics.model().site_size()[self.target][0]);
        match self.task {
            Task::SwingUpSparse => near.of(away),
            Task::SwingUp => near.gaussian(1.0).of(away),
        }
    }
}
