//! Walker: a planar walker stands, walks and runs (`dm_control/suite/walker.py`), and strikes poses (added by TD-MPC2,
//! Hansen et al. 2024, and Newt, Hansen et al. 2025).

use super::domain::{Domain, InfoColumn, RewardFn, TaskTable, tasks};
use super::measures::{height, uprightness};
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
pub const ENTRY: EnvEntry = entry::<Walker>(&[]);

/// Indicator of a standing walker, by the height of the torso in metres.
const STANDING: Tolerance = Tolerance::at_least(1.2).gaussian(0.6);
/// Indicator of a raised body in a pose, by its height in metres.
const UP: Tolerance = Tolerance::at_least(1.0).gaussian(0.5);
/// Indicator of a lying body, by its height in metres.
const LYING: Tolerance = Tolerance::at_most(0.08).gaussian(0.04);
/// Indicator of a foot on the ground in a pose, by its height in metres.
const FOOT_DOWN: Tolerance = Tolerance::at_most(0.08).gaussian(0.5);
/// Indicator of raised feet, by their mean height in metres.
const FEET_UP: Tolerance = Tolerance::at_least(1.1).gaussian(0.55);

/// The reward and the indices of the domain's elements in the model.
pub struct Walker {
    reward: RewardFn<Self>,
    torso: usize,
    /// Bodies of the left and the right foot.
    feet: [usize; 2],
    /// Bodies of the left and the right thigh.
    thighs: [usize; 2],
    velocity: usize,
}

/// The mean height of two bodies, in metres.
fn mean_height(physics: &Physics, [left, right]: [usize; 2]) -> f64 {
    f64::midpoint(height(physics, left), height(physics, right))
}

impl Walker {
    /// The forward velocity, in m/s.
    fn speed(&self, physics: &Physics) -> f64 {
        physics.data().sensordata()[self.velocity]
    }

    /// The inclination of the torso: 0 upright, 1 upside down.
    fn upside_down(&self, physics: &Physics) -> f64 {
        f64::midpoint(1.0, -uprightness(physics, self.torso))
    }

    fn stand(&self, physics: &Physics) -> f64 {
        let upright = f64::midpoint(1.0, uprightness(physics, self.torso));
        (3.0 * STANDING.of(height(physics, self.torso)) + upright) / 4.0
    }

    /// The reward for standing and moving at a speed (m/s).
    fn locomotion(&self, physics: &Physics, speed: Tolerance) -> f64 {
        self.stand(physics) * (5.0 * speed.of(self.speed(physics)) + 1.0) / 6.0
    }

    /// The reward for moving forward at `speed` m/s.
    fn forward(&self, physics: &Physics, speed: f64) -> f64 {
        self.locomotion(physics, Tolerance::at_least(speed).linear(speed / 2.0, 0.5))
    }

    fn arabesque(&self, physics: &Physics) -> f64 {
        let [left, right] = self.feet.map(|foot| height(physics, foot));
        let torso = height(physics, self.torso);
        (3.0 * UP.of(torso) + FOOT_DOWN.of(left) + UP.of(right) + self.upside_down(physics)) / 6.0
    }

    fn lie_down(&self, physics: &Physics) -> f64 {
        let (torso, thighs) = (height(physics, self.torso), mean_height(physics, self.thighs));
        (3.0 * LYING.of(torso) + LYING.of(thighs) + self.upside_down(physics)) / 5.0
    }

    fn legs_up(&self, physics: &Physics) -> f64 {
        let torso = height(physics, self.torso);
        let thighs = LYING.of(mean_height(physics, self.thighs));
        let feet = FEET_UP.of(mean_height(physics, self.feet));
        (3.0 * LYING.of(torso) + 2.0 * feet + thighs + self.upside_down(physics)) / 7.0
    }

    fn flip(&self, physics: &Physics) -> f64 {
        let (feet, thighs) = (mean_height(physics, self.feet), mean_height(physics, self.thighs));
        (3.0 * FEET_UP.of(feet) + 2.0 * UP.of(thighs)) / 5.0
    }
}

impl Domain for Walker {
    type Task = RewardFn<Self>;
    const ID: &'static str = "swm/WalkerDMControl-v0";
    const SUMMARY: &'static str = "Stand, walk, run and strike poses with a planar walker";
    const MODEL: &'static str = "walker.xml";
    const TASKS: TaskTable<RewardFn<Self>> = tasks! {
        "walk" => |walker, physics| walker.forward(physics, 1.0),
        "stand" => Walker::stand,
        "run" => |walker, physics| walker.forward(physics, 8.0),
        "walk-backward" => |walker, physics| walker.locomotion(physics, Tolerance::at_most(-1.0).linear(0.5, 0.5)),
        "arabesque" => Walker::arabesque,
        "lie_down" => Walker::lie_down,
        "legs_up" => Walker::legs_up,
        "flip" => Walker::flip,
    };
    const SUBSTEPS: usize = 10;
    const INFO: &'static [InfoColumn<Self>] = &[
        InfoColumn { name: "speed", len: 1, write: |walker, physics, into| into[0] = walker.speed(physics) },
        InfoColumn {
            name: "torso_height",
            len: 1,
            write: |walker, physics, into| into[0] = height(physics, walker.torso),
        },
        InfoColumn {
            name: "torso_upright",
            len: 1,
            write: |walker, physics, into| into[0] = uprightness(physics, walker.torso),
        },
        InfoColumn {
            name: "left_foot_height",
            len: 1,
            write: |walker, physics, into| into[0] = height(physics, walker.feet[0]),
        },
        InfoColumn {
            name: "right_foot_height",
            len: 1,
            write: |walker, physics, into| into[0] = height(physics, walker.feet[1]),
        },
        InfoColumn {
            name: "left_thigh_height",
            len: 1,
            write: |walker, physics, into| into[0] = height(physics, walker.thighs[0]),
        },
        InfoColumn {
            name: "right_thigh_height",
            len: 1,
            write: |walker, physics, into| into[0] = height(physics, walker.thighs[1]),
        },
    ];
    const IGNORED_JOINTS: &'static [&'static str] = &["rootx"];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.left_foot_density"),
            factors::binary("agent.right_knee_locked", 1),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
            factors::floor_rotation(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _reward: RewardFn<Self>) -> Result<()> {
        edit.common("light")?;
        edit.gravity();
        edit.floor_friction("floor")?;
        edit.floor_tilt("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("left_foot", "agent.left_foot_density")
    }

    fn new(model: &MjModel, reward: RewardFn<Self>) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self {
            reward,
            torso: index.body("torso")?,
            feet: [index.body("left_foot")?, index.body("right_foot")?],
            thighs: [index.body("left_thigh")?, index.body("right_thigh")?],
            velocity: index.sensor("torso_subtreelinvel")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::randomize_joints(physics, rng);
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        observation.extend(physics.data().xmat()[1..].iter().flat_map(|frame| [frame[0], frame[2]]));
        observation.push(height(physics, self.torso));
        observation.extend(physics.data().qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        (self.reward)(self, physics)
    }
}
