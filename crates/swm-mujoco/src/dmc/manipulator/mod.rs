//! Manipulator: a planar arm with a hand brings a ball or a peg to a target, or inserts the
//! object into a receptacle (`dm_control/suite/manipulator.py`).

mod arm;
mod expert;

use super::domain::{Domain, TaskTable, tasks};
use super::measures::distance;
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::model_source::without_element;
use super::observation::ObservationWriter;
use super::reward::Tolerance;
use super::suite_env::entry;
use super::{factors, start};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Manipulator>(expert::EXPERTS);

/// The joints of the arm and the hand.
const ARM: [&str; 8] =
    ["arm_root", "arm_shoulder", "arm_elbow", "arm_wrist", "finger", "fingertip", "thumb", "thumbtip"];
/// The touch sensors of the hand.
const TOUCH: [&str; 5] = ["palm_touch", "finger_touch", "thumb_touch", "fingertip_touch", "thumbtip_touch"];
/// The bodies that only some tasks use. The model of a task lacks the bodies that the task does not use.
const PROPS: [&str; 6] = ["ball", "target_ball", "cup", "peg", "target_peg", "slot"];
/// Reward for the closeness of two sites, as a function of their distance in metres (`_CLOSE` of the suite).
const CLOSE: Tolerance = Tolerance::within(0.0, 0.01).gaussian(0.02);
/// Radius of the ball's target, in metres.
const TARGET_RADIUS: f64 = 0.015;
/// Probability that the object starts in the hand (`_P_IN_HAND`).
const P_IN_HAND: f64 = 0.1;
/// Probability that the object starts at the target (`_P_IN_TARGET`).
const P_AT_TARGET: f64 = 0.1;

/// The bodies of a task.
#[derive(Clone, Copy)]
pub struct Task {
    object: &'static str,
    target: &'static str,
    /// The body to insert the object into.
    receptacle: Option<&'static str>,
}

const BALL: Task = Task { object: "ball", target: "target_ball", receptacle: None };
const PEG: Task = Task { object: "peg", target: "target_peg", receptacle: None };

/// Pairs of sites whose closeness is the reward of tasks with a peg.
struct Peg {
    grasp: [usize; 2],
    pinch: [usize; 2],
    tip: [usize; 2],
}

/// The task and the indices of the domain's elements in the model.
pub struct Manipulator {
    task: Task,
    /// Index, `qpos` index and `qvel` index of each joint of [`ARM`].
    arm: [[usize; 3]; 8],
    /// `qpos` and `qvel` indices of the object's joints along x, along z, and about y.
    object_joints: [[usize; 2]; 3],
    touch: [usize; 5],
    hand: usize,
    object: usize,
    target: usize,
    receptacle: Option<usize>,
    grasp: usize,
    /// The sites of object and target.
    object_and_target: [usize; 2],
    peg: Option<Peg>,
}

impl Manipulator {
    /// The closeness of two sites: 1 up to a distance of 1 cm, falling towards 0 as the distance grows.
    fn closeness(&self, physics: &Physics, [a, b]: [usize; 2]) -> f64 {
        let sites = physics.data().site_xpos();
        CLOSE.of(distance(sites[a], sites[b]))
    }

    /// Position (x, z) of a body, and the two elements of its quaternion (w, y) that are not zero in the plane.
    fn planar_pose(physics: &Physics, body: usize) -> [f64; 4] {
        let (position, quat) = (physics.data().xpos()[body], physics.data().xquat()[body]);
        [position[0], position[2], quat[0], quat[2]]
    }

    /// Draws configurations of arm, target and object.
    fn draw_start(&self, physics: &mut Physics, rng: &mut Rng) {
        for [joint, position, _] in self.arm {
            let (limited, [low, high]) = (physics.model().jnt_limited()[joint], physics.model().jnt_range()[joint]);
            let (low, high) = if limited { (low, high) } else { (-PI, PI) };
            physics.data_mut().qpos_mut()[position] = rng.random_range(low..high);
        }
        let [finger, thumb] = [4, 6].map(|i: usize| self.arm[i][1]);
        physics.data_mut().qpos_mut()[finger] = physics.data().qpos()[thumb];

        let (x, z) = (rng.random_range(-0.4..0.4), rng.random_range(0.1..0.4));
        let max_angle = if self.task.receptacle.is_some() { PI / 3.0 } else { PI };
        let angle: f64 = rng.random_range(-max_angle..max_angle);
        self.set_target(physics, &[x, z, (angle / 2.0).cos(), (angle / 2.0).sin()]);

        let choice = rng.random::<f64>();
        let object = if choice < P_IN_HAND {
            physics.forward_passive();
            let (position, frame) = (physics.data().site_xpos()[self.grasp], physics.data().site_xmat()[self.grasp]);
            [position[0], position[2], PI - frame[6].atan2(frame[0])]
        } else if choice < P_IN_HAND + P_AT_TARGET {
            [x, z, angle]
        } else {
            physics.data_mut().qvel_mut()[self.object_joints[0][1]] = rng.random_range(-5.0..5.0);
            [rng.random_range(-0.5..0.5), rng.random_range(0.0..0.7), rng.random_range(0.0..2.0 * PI)]
        };
        for ([position, _], value) in self.object_joints.into_iter().zip(object) {
            physics.data_mut().qpos_mut()[position] = value;
        }
    }
}

impl Domain for Manipulator {
    type Task = Task;
    const ID: &'static str = "swm/ManipulatorDMControl-v0";
    const SUMMARY: &'static str = "Bring a ball or a peg to a target with an arm and a hand, or insert it";
    const MODEL: &'static str = "manipulator.xml";
    const TASKS: TaskTable<Task> = tasks! {
        "bring_ball" => BALL,
        "bring_peg" => PEG,
        "insert_ball" => Task { receptacle: Some("cup"), ..BALL },
        "insert_peg" => Task { receptacle: Some("slot"), ..PEG },
    };
    const SUBSTEPS: usize = 10;
    const IGNORED_JOINTS: &'static [&'static str] = &["ball_y"];
    const TARGET_LEN: usize = 4;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.hand_density"),
            factors::density("agent.upper_arm_density"),
            factors::density("agent.upper_arm_length"),
            factors::floor_color(),
            factors::light(),
            factors::render_target(),
        ];
        all.extend(factors::target());
        all
    }

    fn prepare_xml(text: String, task: Task) -> Result<String> {
        let used = [Some(task.object), Some(task.target), task.receptacle];
        PROPS
            .iter()
            .filter(|&&prop| !used.contains(&Some(prop)))
            .try_fold(text, |text, prop| without_element(&text, "body", prop))
    }

    fn edit(edit: &mut ModelEdit<'_>, task: Task) -> Result<()> {
        edit.common("light")?;
        edit.density("upper_arm", "agent.upper_arm_density")?;
        edit.density("hand", "agent.hand_density")?;
        edit.target_color()?;
        match task.target {
            "target_ball" => edit.target_geom("target_ball", TARGET_RADIUS),
            _ => Ok(()),
        }
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let index = ModelIndex(model);
        let addresses = |joint: &str| Ok([index.qpos(joint)?, index.qvel(joint)?]);
        let mut arm = [[0; 3]; 8];
        for (indices, name) in arm.iter_mut().zip(ARM) {
            *indices = [index.joint(name)?, index.qpos(name)?, index.qvel(name)?];
        }
        let mut touch = [0; 5];
        for (sensor, name) in touch.iter_mut().zip(TOUCH) {
            *sensor = index.sensor(name)?;
        }
        let joint = |axis: &str| addresses(&format!("{}_{axis}", task.object));
        let peg = match task.object {
            "peg" => Some(Peg {
                grasp: [index.site("peg_grasp")?, index.site("grasp")?],
                pinch: [index.site("peg_pinch")?, index.site("pinch")?],
                tip: [index.site("target_peg_tip")?, index.site("peg_tip")?],
            }),
            _ => None,
        };
        Ok(Self {
            task,
            arm,
            object_joints: [joint("x")?, joint("z")?, joint("y")?],
            touch,
            hand: index.body("hand")?,
            object: index.body(task.object)?,
            target: index.body(task.target)?,
            receptacle: task.receptacle.map(|name| index.body(name)).transpose()?,
            grasp: index.site("grasp")?,
            object_and_target: [index.site(task.object)?, index.site(task.target)?],
            peg,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::sample_without_contacts(physics, rng, |physics, rng| self.draw_start(physics, rng))
    }

    fn target(&self, physics: &Physics, into: &mut [f64]) {
        let (position, quat) = (physics.model().body_pos()[self.target], physics.model().body_quat()[self.target]);
        into.copy_from_slice(&[position[0], position[2], quat[0], quat[2]]);
    }

    fn set_target(&self, physics: &mut Physics, target: &[f64]) {
        for body in [Some(self.target), self.receptacle].into_iter().flatten() {
            let position = &mut physics.model_mut().body_pos_mut()[body];
            (position[0], position[2]) = (target[0], target[1]);
            let quat = &mut physics.model_mut().body_quat_mut()[body];
            (quat[0], quat[2]) = (target[2], target[3]);
        }
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let data = physics.data();
        for [_, position, _] in self.arm {
            let (sin, cos) = data.qpos()[position].sin_cos();
            observation.extend([sin, cos]);
        }
        observation.extend(self.arm.map(|[_, _, velocity]| data.qvel()[velocity]));
        observation.extend(self.touch.map(|sensor| data.sensordata()[sensor].ln_1p()));
        observation.extend(Self::planar_pose(physics, self.hand));
        observation.extend(Self::planar_pose(physics, self.object));
        observation.extend(self.object_joints.map(|[_, velocity]| data.qvel()[velocity]));
        observation.extend(Self::planar_pose(physics, self.target));
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let brought = self.closeness(physics, self.object_and_target);
        match &self.peg {
            None => brought,
            Some(peg) => {
                let held = f64::midpoint(self.closeness(physics, peg.grasp), self.closeness(physics, peg.pinch));
                f64::midpoint(brought, self.closeness(physics, peg.tip)).max(held / 3.0)
            }
        }
    }
}
