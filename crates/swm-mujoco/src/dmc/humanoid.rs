//! Humanoid: a humanoid with 21 joints stands, walks and runs (`dm_control/suite/humanoid.py`).

use super::domain::{Domain, InfoColumn, TaskTable, tasks};
use super::measures::{height, in_frame, norm, uprightness};
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
pub const ENTRY: EnvEntry = entry::<Humanoid>(&[]);

/// Indicator of standing, by the height of the head in metres.
const STANDING: Tolerance = Tolerance::at_least(1.4).gaussian(0.35);
/// Indicator of an upright torso, by the vertical component of its z-axis.
const UPRIGHT: Tolerance = Tolerance::at_least(0.9).linear(1.9, 0.0);
/// The number of elements of `qpos` for position and orientation of the root body.
const ROOT_LEN: usize = 7;

/// The speed and the observation of a task.
#[derive(Clone, Copy)]
pub struct Task {
    /// The horizontal speed to reach, in m/s; 0 to stand.
    speed: f64,
    /// Whether the observation is `qpos` and `qvel` only.
    pure_state: bool,
}

/// The task and the indices of the domain's elements in the model.
pub struct Humanoid {
    task: Task,
    torso: usize,
    head: usize,
    /// Left hand, left foot, right hand, right foot.
    limbs: [usize; 4],
    velocity: usize,
}

impl Humanoid {
    /// The velocity of the centre of mass, in m/s.
    fn velocity(&self, physics: &Physics) -> [f64; 3] {
        std::array::from_fn(|axis| physics.data().sensordata()[self.velocity + axis])
    }

    fn head_height(&self, physics: &Physics) -> f64 {
        height(physics, self.head)
    }
}

impl Domain for Humanoid {
    type Task = Task;
    const ID: &'static str = "swm/HumanoidDMControl-v0";
    const SUMMARY: &'static str = "Stand, walk and run with a humanoid of 21 joints";
    const MODEL: &'static str = "humanoid.xml";
    const TASKS: TaskTable<Task> = tasks! {
        "walk" => Task { speed: 1.0, pure_state: false },
        "stand" => Task { speed: 0.0, pure_state: false },
        "run" => Task { speed: 10.0, pure_state: false },
        "run_pure_state" => Task { speed: 10.0, pure_state: true },
    };
    const SUBSTEPS: usize = 5;
    const INFO: &'static [InfoColumn<Self>] = &[
        InfoColumn {
            name: "speed",
            len: 1,
            write: |humanoid, physics, into| into[0] = norm(&humanoid.velocity(physics)[..2]),
        },
        InfoColumn {
            name: "torso_upright",
            len: 1,
            write: |humanoid, physics, into| into[0] = uprightness(physics, humanoid.torso),
        },
        InfoColumn {
            name: "head_height",
            len: 1,
            write: |humanoid, physics, into| into[0] = humanoid.head_height(physics),
        },
    ];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::binary("agent.left_knee_locked", 1),
            factors::density("agent.right_lower_arm_density"),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, _task: Task) -> Result<()> {
        edit.common("top")?;
        edit.gravity();
        edit.floor_friction("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("right_lower_arm", "agent.right_lower_arm_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let index = ModelIndex(model);
        Ok(Self {
            task,
            torso: index.body("torso")?,
            head: index.body("head")?,
            limbs: [
                index.body("left_hand")?,
                index.body("left_foot")?,
                index.body("right_hand")?,
                index.body("right_foot")?,
            ],
            velocity: index.sensor("torso_subtreelinvel")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::sample_without_contacts(physics, rng, start::randomize_joints)
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let data = physics.data();
        if self.task.pure_state {
            observation.extend(data.qpos());
        } else {
            let (frame, torso) = (&data.xmat()[self.torso], data.xpos()[self.torso]);
            observation.extend(&data.qpos()[ROOT_LEN..]);
            observation.push(self.head_height(physics));
            for limb in self.limbs.map(|limb| data.xpos()[limb]) {
                observation.extend(in_frame(frame, std::array::from_fn(|axis| limb[axis] - torso[axis])));
            }
            observation.extend(&frame[6..]);
            observation.extend(self.velocity(physics));
        }
        observation.extend(data.qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let zero = Tolerance::within(0.0, 0.0);
        let standing = STANDING.of(self.head_height(physics)) * UPRIGHT.of(uprightness(physics, self.torso));
        let small_control = (4.0 + mean(zero.quadratic(1.0), physics.data().ctrl())) / 5.0;
        let [x, y, _] = self.velocity(physics);
        let speed = self.task.speed;
        if speed == 0.0 {
            small_control * standing * mean(zero.gaussian(2.0), &[x, y])
        } else {
            let moving = Tolerance::at_least(speed).linear(speed, 0.0).of(norm(&[x, y]));
            small_control * standing * (5.0 * moving + 1.0) / 6.0
        }
    }
}
