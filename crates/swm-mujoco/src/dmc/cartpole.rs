//! Cartpole: a cart on a rail swings up its pole or balances it (`dm_control/suite/cartpole.py`).

use super::domain::{Domain, TaskTable, tasks};
use super::factors;
use super::model_edit::ModelEdit;
use super::observation::ObservationWriter;
use super::reward::{Tolerance, mean};
use super::suite_env::entry;
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use rand_distr::StandardNormal;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Cartpole>(&[]);

/// The start and the reward of a task.
#[derive(Clone, Copy)]
pub struct Task {
    /// Whether the pole hangs down at the start; otherwise it is upright.
    swing_up: bool,
    /// Whether the reward is either 0 or 1; otherwise it is continuous.
    sparse: bool,
}

/// The index of the pole's body. The bodies of the world and of the cart precede it.
const POLE: usize = 2;

/// A task of the cartpole domain.
pub struct Cartpole {
    task: Task,
}

impl Domain for Cartpole {
    type Task = Task;
    const ID: &'static str = "swm/CartpoleDMControl-v0";
    const SUMMARY: &'static str = "Swing up the pole on a cart, or balance it";
    const MODEL: &'static str = "cartpole.xml";
    const TASKS: TaskTable<Task> = tasks! {
        "swingup_sparse" => Task { swing_up: true, sparse: true },
        "swingup" => Task { swing_up: true, sparse: false },
        "balance" => Task { swing_up: false, sparse: false },
        "balance_sparse" => Task { swing_up: false, sparse: true },
    };
    const SUBSTEPS: usize = 1;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::scalar("agent.cart_mass", 0.5, 1.5, 1.0),
            factors::binary("agent.cart_shape", 1),
            factors::agent_color(),
            factors::density("agent.pole_density"),
            factors::floor_color(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _task: Task) -> Result<()> {
        edit.common("light")?;
        edit.gravity();
        edit.mass("cart", "agent.cart_mass")?;
        edit.density("pole_1", "agent.pole_density")
    }

    fn new(_model: &MjModel, task: Task) -> Result<Self> {
        Ok(Self { task })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        let mut normal = |scale: f64| scale * rng.sample::<f64, _>(StandardNormal);
        let (cart, pole) = if self.task.swing_up {
            (normal(0.01), PI + normal(0.01))
        } else {
            (rng.random_range(-0.1..0.1), rng.random_range(-0.034..0.034))
        };
        let speeds = [(); 2].map(|()| 0.01 * rng.sample::<f64, _>(StandardNormal));
        physics.data_mut().qpos_mut().copy_from_slice(&[cart, pole]);
        physics.data_mut().qvel_mut().copy_from_slice(&speeds);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let pole = physics.data().xmat()[POLE];
        observation.extend([physics.data().qpos()[0], pole[8], pole[2]]);
        observation.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let (cart, upright) = (physics.data().qpos()[0], physics.data().xmat()[POLE][8]);
        if self.task.sparse {
            return Tolerance::within(-0.25, 0.25).of(cart) * Tolerance::within(0.995, 1.0).of(upright);
        }
        let zero = Tolerance::within(0.0, 0.0);
        let centred = f64::midpoint(1.0, zero.gaussian(2.0).of(cart));
        let small_control = (4.0 + mean(zero.quadratic(1.0), physics.data().ctrl())) / 5.0;
        let slow = f64::midpoint(1.0, zero.gaussian(5.0).of(physics.data().qvel()[1]));
        f64::midpoint(upright, 1.0) * small_control * slow * centred
    }

    fn goal_qpos(&self, _physics: &Physics, qpos: &mut [f64]) -> bool {
        qpos.fill(0.0);
        true
    }
}
