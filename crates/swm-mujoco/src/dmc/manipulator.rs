//! A planar arm with a hand brings a ball or a peg to a target, or inserts it.

use super::blueprint::{Edit, without};
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, distance, entry, factors, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Manipulator>(&[]);

/// The joints of arm and hand.
const ARM: [&str; 8] =
    ["arm_root", "arm_shoulder", "arm_elbow", "arm_wrist", "finger", "fingertip", "thumb", "thumbtip"];
const TOUCH: [&str; 5] = ["palm_touch", "finger_touch", "thumb_touch", "fingertip_touch", "thumbtip_touch"];
/// Everything that can lie about.
const PROPS: [&str; 6] = ["ball", "target_ball", "cup", "peg", "target_peg", "slot"];
/// Things within a centimetre are together.
const CLOSE: Tolerance = Tolerance::within(0.0, 0.01).gaussian(0.02);
/// Radius of the ball's target, in metres.
const SIZE: f64 = 0.015;
/// How often the object begins in the hand, and how often at the target.
const IN_HAND: f64 = 0.1;
const AT_TARGET: f64 = 0.1;

/// What to bring, and whether into something.
#[derive(Clone, Copy)]
pub struct Task {
    object: &'static str,
    target: &'static str,
    receptacle: Option<&'static str>,
}

const BALL: Task = Task { object: "ball", target: "target_ball", receptacle: None };
const PEG: Task = Task { object: "peg", target: "target_peg", receptacle: None };

/// Pairs of sites that belong together.
struct Peg {
    grasp: [usize; 2],
    pinch: [usize; 2],
    tip: [usize; 2],
}

pub struct Manipulator {
    task: Task,
    /// Joints, and where their coordinates and velocities are.
    arm: [[usize; 3]; 8],
    /// The object's coordinates along x and z and its turn, and their velocities.
    object_joints: [[usize; 2]; 3],
    touch: [usize; 5],
    hand: usize,
    object: usize,
    target: usize,
    receptacle: Option<usize>,
    grasp: usize,
    /// The object's site and the target's.
    together: [usize; 2],
    peg: Option<Peg>,
}

impl Manipulator {
    fn close(&self, physics: &Physics, [a, b]: [usize; 2]) -> f64 {
        let places = physics.data().site_xpos();
        CLOSE.of(distance(places[a], places[b]))
    }

    /// Where a body is in the plane, and its turn as the quaternion's two numbers that are not zero.
    fn pose(physics: &Physics, body: usize) -> [f64; 4] {
        let (place, turn) = (physics.data().xpos()[body], physics.data().xquat()[body]);
        [place[0], place[2], turn[0], turn[2]]
    }

    /// Draws arm, target and object once.
    fn scatter(&self, physics: &mut Physics, rng: &mut Rng) {
        for [joint, position, _] in self.arm {
            let (limited, [low, high]) = (physics.model().jnt_limited()[joint], physics.model().jnt_range()[joint]);
            let (low, high) = if limited { (low, high) } else { (-PI, PI) };
            physics.data_mut().qpos_mut()[position] = rng.random_range(low..high);
        }
        let [finger, thumb] = [4, 6].map(|i: usize| self.arm[i][1]);
        physics.data_mut().qpos_mut()[finger] = physics.data().qpos()[thumb];

        let (x, z) = (rng.random_range(-0.4..0.4), rng.random_range(0.1..0.4));
        let widest = if self.task.receptacle.is_some() { PI / 3.0 } else { PI };
        let turn: f64 = rng.random_range(-widest..widest);
        self.place(physics, &[x, z, (turn / 2.0).cos(), (turn / 2.0).sin()]);

        let chance = rng.random::<f64>();
        let object = if chance < IN_HAND {
            physics.forward_passive();
            let (place, frame) = (physics.data().site_xpos()[self.grasp], physics.data().site_xmat()[self.grasp]);
            [place[0], place[2], PI - frame[6].atan2(frame[0])]
        } else if chance < IN_HAND + AT_TARGET {
            [x, z, turn]
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
    const TASKS: &'static [(&'static str, Task)] = &[
        ("bring_ball", BALL),
        ("bring_peg", PEG),
        ("insert_ball", Task { receptacle: Some("cup"), ..BALL }),
        ("insert_peg", Task { receptacle: Some("slot"), ..PEG }),
    ];
    const NAMES: &'static [&'static str] = &task_names::<_, 4>(Self::TASKS);
    const SUBSTEPS: usize = 10;
    const IDLE: &'static [&'static str] = &["ball_y"];
    const TARGET: usize = 4;

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

    fn draft(text: String, task: Task) -> Result<String> {
        let kept = [Some(task.object), Some(task.target), task.receptacle];
        PROPS
            .iter()
            .filter(|&&prop| !kept.contains(&Some(prop)))
            .try_fold(text, |text, prop| without(&text, "body", prop))
    }

    fn edit(edit: &mut Edit<'_>, task: Task) -> Result<()> {
        edit.scene("light")?;
        edit.density("upper_arm", "agent.upper_arm_density")?;
        edit.density("hand", "agent.hand_density")?;
        edit.target_color()?;
        match task.target {
            "target_ball" => edit.target_geom("target_ball", SIZE),
            _ => Ok(()),
        }
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        let both = |joint: &str| Ok([names.position(joint)?, names.velocity(joint)?]);
        let mut arm = [[0; 3]; 8];
        for (places, name) in arm.iter_mut().zip(ARM) {
            *places = [names.joint(name)?, names.position(name)?, names.velocity(name)?];
        }
        let mut touch = [0; 5];
        for (sensor, name) in touch.iter_mut().zip(TOUCH) {
            *sensor = names.sensor(name)?;
        }
        let joint = |axis: &str| both(&format!("{}_{axis}", task.object));
        let peg = match task.object {
            "peg" => Some(Peg {
                grasp: [names.site("peg_grasp")?, names.site("grasp")?],
                pinch: [names.site("peg_pinch")?, names.site("pinch")?],
                tip: [names.site("target_peg_tip")?, names.site("peg_tip")?],
            }),
            _ => None,
        };
        Ok(Self {
            task,
            arm,
            object_joints: [joint("x")?, joint("z")?, joint("y")?],
            touch,
            hand: names.body("hand")?,
            object: names.body(task.object)?,
            target: names.body(task.target)?,
            receptacle: task.receptacle.map(|name| names.body(name)).transpose()?,
            grasp: names.site("grasp")?,
            together: [names.site(task.object)?, names.site(task.target)?],
            peg,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        start::without_contacts(physics, rng, |physics, rng| self.scatter(physics, rng))
    }

    fn target(&self, physics: &Physics, into: &mut [f64]) {
        let (place, turn) = (physics.model().body_pos()[self.target], physics.model().body_quat()[self.target]);
        into.copy_from_slice(&[place[0], place[2], turn[0], turn[2]]);
    }

    fn place(&self, physics: &mut Physics, target: &[f64]) {
        for body in [Some(self.target), self.receptacle].into_iter().flatten() {
            let place = &mut physics.model_mut().body_pos_mut()[body];
            (place[0], place[2]) = (target[0], target[1]);
            let turn = &mut physics.model_mut().body_quat_mut()[body];
            (turn[0], turn[2]) = (target[2], target[3]);
        }
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        let data = physics.data();
        for [_, position, _] in self.arm {
            let (sin, cos) = data.qpos()[position].sin_cos();
            seen.extend([sin, cos]);
        }
        seen.extend(self.arm.map(|[_, _, velocity]| data.qvel()[velocity]));
        seen.extend(self.touch.map(|sensor| data.sensordata()[sensor].ln_1p()));
        seen.extend(Self::pose(physics, self.hand));
        seen.extend(Self::pose(physics, self.object));
        seen.extend(self.object_joints.map(|[_, velocity]| data.qvel()[velocity]));
        seen.extend(Self::pose(physics, self.target));
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let brought = self.close(physics, self.together);
        match &self.peg {
            None => brought,
            Some(peg) => {
                let held = f64::midpoint(self.close(physics, peg.grasp), self.close(physics, peg.pinch));
                f64::midpoint(brought, self.close(physics, peg.tip)).max(held / 3.0)
            }
        }
    }
}
