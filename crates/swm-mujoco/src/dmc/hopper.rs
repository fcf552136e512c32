//! Hopper: a planar one-legged hopper stands and hops (`dm_control/suite/hopper.py`), hops backward and flips (added by
//! TD-MPC2, Hansen et al. 2024, and Newt, Hansen et al. 2025).

use super::domain::{Domain, InfoColumn, RewardFn, TaskTable, tasks};
use super::measures::forward_spin;
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::observation::ObservationWriter;
use super::reward::{Tolerance, mean};
use super::suite_env::entry;
use super::{factors, start};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Hopper>(&[]);

/// Indicator of standing, by the height of the torso above the foot in metres.
const STANDING: Tolerance = Tolerance::within(0.6, 2.0);
/// Indicator of a flip, by the forward angular momentum in kg m²/s.
const FLIP: Tolerance = Tolerance::at_least(5.0).linear(2.5, 0.0);

/// The reward and the indices of the domain's elements in the model.
pub struct Hopper {
    reward: RewardFn<Self>,
    torso: usize,
    foot: usize,
    velocity: usize,
    touch: [usize; 2],
}

impl Hopper {
    /// The forward velocity, in m/s.
    fn speed(&self, physics: &Physics) -> f64 {
        physics.data().sensordata()[self.velocity]
    }

    /// The height of the torso above the foot, in metres.
    fn height(&self, physics: &Physics) -> f64 {
        let centres = physics.data().xipos();
        centres[self.torso][2] - centres[self.foot][2]
    }

    /// The reward for standing and moving at a speed (m/s).
    fn hop(&self, physics: &Physics, speed: Tolerance) -> f64 {
        STANDING.of(self.height(physics)) * speed.of(self.speed(physics))
    }

    /// The reward for standing with small controls.
    fn stand(&self, physics: &Physics) -> f64 {
        let standing = STANDING.of(self.height(physics));
        let small_control = mean(Tolerance::within(0.0, 0.0).quadratic(1.0), physics.data().ctrl());
        standing * (small_control + 4.0) / 5.0
    }
}

impl Domain for Hopper {
    type Task = RewardFn<Self>;
    const ID: &'static str = "swm/HopperDMControl-v0";
    const SUMMARY: &'static str = "Stand, hop and flip on one leg";
    const MODEL: &'static str = "hopper.xml";
    const TASKS: TaskTable<RewardFn<Self>> = tasks! {
        "hop" => |hopper, physics| hopper.hop(physics, Tolerance::at_least(2.0).linear(1.0, 0.5)),
        "stand" => Hopper::stand,
        "hop-backward" => |hopper, physics| hopper.hop(physics, Tolerance::at_most(-1.0).linear(0.5, 0.5)),
        "flip" => |hopper, physics| FLIP.of(forward_spin(physics, hopper.torso)),
        "flip-backward" => |hopper, physics| FLIP.of(-forward_spin(physics, hopper.torso)),
    };
    const SUBSTEPS: usize = 4;
    const INFO: &'static [InfoColumn<Self>] = &[
        InfoColumn { name: "speed", len: 1, write: |hopper, physics, into| into[0] = hopper.speed(physics) },
        InfoColumn { name: "height", len: 1, write: |hopper, physics, into| into[0] = hopper.height(physics) },
        InfoColumn {
            name: "angmomentum",
            len: 1,
            write: |hopper, physics, into| into[0] = forward_spin(physics, hopper.torso),
        },
    ];
    const IGNORED_JOINTS: &'static [&'static str] = &["rootx"];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.foot_density"),
            factors::binary("agent.foot_locked", 1),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _reward: RewardFn<Self>) -> Result<()> {
        edit.common("top")?;
        edit.gravity();
        edit.floor_friction("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("foot", "agent.foot_density")
    }

    fn new(model: &MjModel, reward: RewardFn<Self>) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self {
            reward,
            torso: index.body("torso")?,
            foot: index.body("foot")?,
            velocity: index.sensor("torso_subtreelinvel")?,
            touch: [index.sensor("touch_toe")?, index.sensor("touch_heel")?],
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::randomize_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        observation.extend(&physics.data().qpos()[1..]);
        observation.extend(physics.data().qvel());
        observation.extend(self.touch.map(|sensor| physics.data().sensordata()[sensor].ln_1p()));
    }

    fn reward(&self, physics: &Physics) -> f64 {
        (self.reward)(self, physics)
    }
}
