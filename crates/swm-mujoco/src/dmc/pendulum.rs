//! A pendulum whose motor is too weak to lift it at once must be swung up.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, entry, factors, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Pendulum>(&[]);

/// How far from upright counts as upright, in radians.
const UPRIGHT: f64 = 8.0 * std::f64::consts::PI / 180.0;

pub struct Pendulum {
    pole: usize,
}

impl Domain for Pendulum {
    type Task = ();
    const ID: &'static str = "swm/PendulumDMControl-v0";
    const SUMMARY: &'static str = "Swing up a pendulum with a motor too weak to lift it at once";
    const MODEL: &'static str = "pendulum.xml";
    const TASKS: &'static [(&'static str, ())] = &[("swingup", ())];
    const NAMES: &'static [&'static str] = &task_names::<_, 1>(Self::TASKS);
    const SUBSTEPS: usize = 1;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.mass_density"),
            factors::choice("agent.mass_shape", 1),
            factors::density("agent.pole_density"),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: ()) -> Result<()> {
        edit.scene("light")?;
        edit.gravity();
        edit.density("pole", "agent.pole_density")?;
        edit.density("mass", "agent.mass_density")
    }

    fn new(model: &MjModel, _task: ()) -> Result<Self> {
        Ok(Self { pole: Names(model).body("pole")? })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::random_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        let frame = physics.data().xmat()[self.pole];
        seen.extend([frame[8], frame[2]]);
        seen.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        Tolerance::within(UPRIGHT.cos(), 1.0).of(physics.data().xmat()[self.pole][8])
    }

    fn destination(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos.fill(0.0);
        true
    }
}
