//! A humanoid with 21 joints gets up, stands, walks and runs.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::reward::{Tolerance, mean};
use super::{Domain, entry, factors, norm, seen_from, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Humanoid>(&[]);

/// A head this high stands, in metres.
const STANDING: Tolerance = Tolerance::at_least(1.4).gaussian(0.35);
/// How upright a torso stands.
const UPRIGHT: Tolerance = Tolerance::at_least(0.9).linear(1.9, 0.0);
/// Numbers of `qpos` that say where the body is and how it is turned.
const ROOT: usize = 7;

/// How fast it should move, in m/s, and what is observed.
#[derive(Clone, Copy)]
pub struct Task {
    speed: f64,
    /// Positions and velocities alone.
    pure_state: bool,
}

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

    fn upright(&self, physics: &Physics) -> f64 {
        physics.data().xmat()[self.torso][8]
    }

    fn head_height(&self, physics: &Physics) -> f64 {
        physics.data().xpos()[self.head][2]
    }
}

impl Domain for Humanoid {
    type Task = Task;
    const ID: &'static str = "swm/HumanoidDMControl-v0";
    const SUMMARY: &'static str = "Get a humanoid up, and walk or run";
    const MODEL: &'static str = "humanoid.xml";
    const TASKS: &'static [(&'static str, Task)] = &[
        ("walk", Task { speed: 1.0, pure_state: false }),
        ("stand", Task { speed: 0.0, pure_state: false }),
        ("run", Task { speed: 10.0, pure_state: false }),
        ("run_pure_state", Task { speed: 10.0, pure_state: true }),
    ];
    const NAMES: &'static [&'static str] = &task_names::<_, 4>(Self::TASKS);
    const SUBSTEPS: usize = 5;
    const INFO: &'static [(&'static str, usize)] = &[("speed", 1), ("torso_upright", 1), ("head_height", 1)];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::choice("agent.left_knee_locked", 1),
            factors::density("agent.right_lower_arm_density"),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn edit(edit: &mut Edit<'_>, _task: Task) -> Result<()> {
        edit.scene("top")?;
        edit.gravity();
        edit.friction("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("right_lower_arm", "agent.right_lower_arm_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        Ok(Self {
            task,
            torso: names.body("torso")?,
            head: names.body("head")?,
            limbs: [
                names.body("left_hand")?,
                names.body("left_foot")?,
                names.body("right_hand")?,
                names.body("right_foot")?,
            ],
            velocity: names.sensor("torso_subtreelinvel")?,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::without_contacts(physics, rng, start::random_joints)
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        let data = physics.data();
        if self.task.pure_state {
            seen.extend(data.qpos());
        } else {
            let (frame, place) = (&data.xmat()[self.torso], data.xpos()[self.torso]);
            seen.extend(&data.qpos()[ROOT..]);
            seen.push(self.head_height(physics));
            for limb in self.limbs.map(|limb| data.xpos()[limb]) {
                seen.extend(seen_from(frame, std::array::from_fn(|axis| limb[axis] - place[axis])));
            }
            seen.extend(&frame[6..]);
            seen.extend(self.velocity(physics));
        }
        seen.extend(data.qvel());
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let zero = Tolerance::within(0.0, 0.0);
        let standing = STANDING.of(self.head_height(physics)) * UPRIGHT.of(self.upright(physics));
        let calm = (4.0 + mean(zero.quadratic(1.0), physics.data().ctrl())) / 5.0;
        let [x, y, _] = self.velocity(physics);
        let speed = self.task.speed;
        if speed == 0.0 {
            calm * standing * mean(zero.gaussian(2.0), &[x, y])
        } else {
            let moving = Tolerance::at_least(speed).linear(speed, 0.0).of(norm(&[x, y]));
            calm * standing * (5.0 * moving + 1.0) / 6.0
        }
    }

    fn info(&self, physics: &Physics, column: usize, into: &mut [f64]) {
        into[0] = match column {
            0 => norm(&self.velocity(physics)[..2]),
            1 => self.upright(physics),
            _ => self.head_height(physics),
        };
    }
}
