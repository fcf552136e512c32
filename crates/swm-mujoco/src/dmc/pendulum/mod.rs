//! Pendulum: swing up a pendulum with a motor that is too weak to lift it directly (`dm_control/suite/pendulum.py`).

mod expert;

use super::domain::{Domain, TaskTable, tasks};
use super::measures::uprightness;
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
pub const ENTRY: EnvEntry = entry::<Pendulum>(expert::EXPERTS);

/// Deviation from the vertical that counts as upright, in radians (8 degrees).
const UPRIGHT_ANGLE: f64 = 8.0 * std::f64::consts::PI / 180.0;

/// The pendulum domain: the index of the pole's body in the model.
pub struct Pendulum {
    pole: usize,
}

impl Domain for Pendulum {
    type Task = ();
    const ID: &'static str = "swm/PendulumDMControl-v0";
    const SUMMARY: &'static str = "Swing up a pendulum with a motor too weak to lift it directly";
    const MODEL: &'static str = "pendulum.xml";
    const TASKS: TaskTable<()> = tasks! { "swingup" => () };
    const SUBSTEPS: usize = 1;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.mass_density"),
            factors::binary("agent.mass_shape", 1),
            factors::density("agent.pole_density"),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _task: ()) -> Result<()> {
        edit.common("light")?;
        edit.gravity();
        edit.density("pole", "agent.pole_density")?;
        edit.density("mass", "agent.mass_density")
    }

    fn new(model: &MjModel, _task: ()) -> Result<Self> {
        Ok(Self { pole: ModelIndex(model).body("pole")? })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::randomize_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let frame = physics.data().xmat()[self.pole];
        observation.extend([frame[8], frame[2]]);
        observation.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        Tolerance::within(UPRIGHT_ANGLE.cos(), 1.0).of(uprightness(physics, self.pole))
    }

    fn goal_qpos(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos.fill(0.0);
        true
    }
}
