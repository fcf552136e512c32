//! Cheetah: a planar cheetah runs (`dm_control/suite/cheetah.py`), stands, jumps and flips (added by TD-MPC2,
//! Hansen et al. 2024, and Newt, Hansen et al. 2025).

use super::domain::{Domain, InfoColumn, RewardFn, TaskTable, tasks};
use super::measures::{forward_spin, height};
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
pub const ENTRY: EnvEntry = entry::<Cheetah>(&[]);

/// The number of time steps in which the cheetah falls to the ground at the start.
const SETTLE_STEPS: usize = 200;
/// Indicator of a jump, by the height of torso or foot in metres.
const JUMP: Tolerance = Tolerance::at_least(1.2).gaussian(0.6);
/// The maximal height of a lying torso or foot, in metres.
const LIE_HEIGHT: f64 = 0.25;
/// Indicator of a flip, by the forward angular momentum in kg m²/s.
const FLIP: Tolerance = Tolerance::at_least(8.0).linear(8.0, 0.0);

/// The reward and the indices of the domain's elements in the model.
pub struct Cheetah {
    reward: RewardFn<Self>,
    torso: usize,
    front_foot: usize,
    back_foot: usize,
    velocity: usize,
}

impl Cheetah {
    /// The forward velocity, in m/s.
    fn speed(&self, physics: &Physics) -> f64 {
        physics.data().sensordata()[self.velocity]
    }

    /// The reward for standing on one foot, with the torso and the other foot raised. The speed term is 1 only at a
    /// speed of exactly 0, as in the reference.
    fn stand(&self, physics: &Physics, raised: usize) -> f64 {
        let up = JUMP.of(f64::midpoint(height(physics, self.torso), height(physics, raised)));
        (5.0 * up + Tolerance::within(0.0, 0.0).of(self.speed(physics))) / 6.0
    }

    /// The reward for a jump: the mean of the rewards for standing on each foot.
    fn jump(&self, physics: &Physics) -> f64 {
        f64::midpoint(self.stand(physics, self.back_foot), self.stand(physics, self.front_foot))
    }

    /// The reward for raising a foot and the torso.
    fn one_foot(&self, physics: &Physics, raised: usize) -> f64 {
        (3.0 * JUMP.of(height(physics, raised)) + 2.0 * JUMP.of(height(physics, self.torso))) / 5.0
    }

    /// The reward for running at half speed with a foot and the torso raised.
    fn run_on_one_foot(&self, physics: &Physics, raised: usize) -> f64 {
        let fast = Tolerance::at_least(5.0).linear(5.0, 0.0).of(self.speed(physics));
        self.one_foot(physics, raised) * (5.0 * fast + 1.0) / 6.0
    }

    /// The reward for a low torso and low feet.
    fn lie_down(&self, physics: &Physics) -> f64 {
        let low = |height| Tolerance::at_most(LIE_HEIGHT).linear(LIE_HEIGHT, 0.0).of(height);
        let feet = f64::midpoint(height(physics, self.front_foot), height(physics, self.back_foot));
        (3.0 * low(height(physics, self.torso)) + low(feet)) / 4.0
    }

    /// The reward for a low torso and a raised back foot.
    fn legs_up(&self, physics: &Physics) -> f64 {
        let down = Tolerance::at_most(LIE_HEIGHT).gaussian(LIE_HEIGHT / 2.0).of(height(physics, self.torso));
        (5.0 * down + self.one_foot(physics, self.back_foot)) / 6.0
    }

    /// The reward for rotating and moving forward (`direction` 1) or backward (-1).
    fn flip(&self, physics: &Physics, direction: f64) -> f64 {
        let along = Tolerance::at_least(0.0).of(direction * self.speed(physics));
        (2.0 * FLIP.of(direction * forward_spin(physics, self.torso)) + along) / 3.0
    }
}

impl Domain for Cheetah {
    type Task = RewardFn<Self>;
    const ID: &'static str = "swm/CheetahDMControl-v0";
    const SUMMARY: &'static str = "Run with a planar cheetah, stand on one foot, jump or flip";
    const MODEL: &'static str = "cheetah.xml";
    const TASKS: TaskTable<RewardFn<Self>> = tasks! {
        "run" => |cheetah, physics| Tolerance::at_least(10.0).linear(10.0, 0.0).of(cheetah.speed(physics)),
        "run-backward" => |cheetah, physics| Tolerance::at_most(-10.0).linear(10.0, 0.0).of(cheetah.speed(physics)),
        "stand-front" => |cheetah, physics| cheetah.stand(physics, cheetah.back_foot),
        "stand-back" => |cheetah, physics| cheetah.stand(physics, cheetah.front_foot),
        "jump" => Cheetah::jump,
        "run-front" => |cheetah, physics| cheetah.run_on_one_foot(physics, cheetah.back_foot),
        "run-back" => |cheetah, physics| cheetah.run_on_one_foot(physics, cheetah.front_foot),
        "lie-down" => Cheetah::lie_down,
        "legs-up" => Cheetah::legs_up,
        "flip" => |cheetah, physics| cheetah.flip(physics, 1.0),
        "flip-backward" => |cheetah, physics| cheetah.flip(physics, -1.0),
    };
    const SUBSTEPS: usize = 1;
    const MAX_STEPS: usize = 1250;
    const INFO: &'static [InfoColumn<Self>] = &[
        InfoColumn { name: "speed", len: 1, write: |cheetah, physics, into| into[0] = cheetah.speed(physics) },
        InfoColumn {
            name: "torso_height",
            len: 1,
            write: |cheetah, physics, into| into[0] = height(physics, cheetah.torso),
        },
        InfoColumn {
            name: "bfoot_height",
            len: 1,
            write: |cheetah, physics, into| into[0] = height(physics, cheetah.back_foot),
        },
        InfoColumn {
            name: "ffoot_height",
            len: 1,
            write: |cheetah, physics, into| into[0] = height(physics, cheetah.front_foot),
        },
        InfoColumn {
            name: "angmomentum",
            len: 1,
            write: |cheetah, physics, into| into[0] = forward_spin(physics, cheetah.torso),
        },
    ];
    const IGNORED_JOINTS: &'static [&'static str] = &["rootx"];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::density("agent.back_foot_density"),
            factors::binary("agent.back_foot_locked", 1),
            factors::agent_color(),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _reward: RewardFn<Self>) -> Result<()> {
        edit.common("light")?;
        edit.gravity();
        edit.floor_friction("ground")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("bfoot", "agent.back_foot_density")
    }

    fn new(model: &MjModel, reward: RewardFn<Self>) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self {
            reward,
            torso: index.body("torso")?,
            front_foot: index.body("ffoot")?,
            back_foot: index.body("bfoot")?,
            velocity: index.sensor("torso_subtreelinvel")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::randomize_limited_joints(physics, rng);
        physics.step_control(SETTLE_STEPS);
        physics.data_mut().set_time(0.0);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        observation.extend(&physics.data().qpos()[1..]);
        observation.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        (self.reward)(self, physics)
    }
}
