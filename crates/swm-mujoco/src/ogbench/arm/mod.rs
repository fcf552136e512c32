//! The arm: a UR5e with a Robotiq 2F-85 gripper that points down.
//!
//! An action moves the gripper relative to where it is: up to 5 cm along each axis, 0.3 rad about the vertical, and the
//! whole way of its fingers. The pose asked for is kept in the workspace; inverse kinematics makes joint positions of it,
//! which the arm's position actuators hold for one control step.

pub mod ik;
pub mod pose;

use crate::Physics;
use ik::{Chain, JOINTS, Link};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use pose::{Pose, Quat, Vec3};
use std::f64::consts::FRAC_PI_2;
use swm_core::{Error, Result};

/// Numbers of an action.
pub const ACTION: usize = 5;
/// Actuators: six joints, and the fingers.
pub const CONTROLS: usize = JOINTS + 1;

/// What the largest action means: metres, radians, and the share of the fingers' way.
const REACH: [f64; ACTION] = [0.05, 0.05, 0.05, 0.3, 1.0];
/// The turn of a gripper that points down.
const DOWN: Quat = [0.0, 1.0, 0.0, 0.0];
/// Where the joints are at home, in radians.
pub const HOME: [f64; JOINTS] = [-FRAC_PI_2, -FRAC_PI_2, FRAC_PI_2, -FRAC_PI_2, -FRAC_PI_2, 0.0];
/// Where the finger joint is when the gripper is closed, in radians.
const CLOSED: f64 = 0.8;
/// What closes the fingers.
const FINGER_CONTROL: f64 = 255.0;
/// The force on a finger's pad that counts as full contact, in newtons and newton metres.
const FULL_CONTACT: f64 = 50.0;

/// The links of the arm and the joint that each turns about.
const LINKS: [(&str, &str); JOINTS] = [
    ("ur5e/shoulder_link", "ur5e/shoulder_pan_joint"),
    ("ur5e/upper_arm_link", "ur5e/shoulder_lift_joint"),
    ("ur5e/forearm_link", "ur5e/elbow_joint"),
    ("ur5e/wrist_1_link", "ur5e/wrist_1_joint"),
    ("ur5e/wrist_2_link", "ur5e/wrist_2_joint"),
    ("ur5e/wrist_3_link", "ur5e/wrist_3_joint"),
];

/// The place of a name in the model.
///
/// # Errors
/// When the model has no such thing: its files are not those of the pinned version.
pub fn find(model: &MjModel, kind: MjtObjBase, name: &str) -> Result<usize> {
    model.name_to_id(kind, name).ok_or_else(|| Error::external("looking into OGBench's model", format!("no '{name}'")))
}

/// The arm, and where it is in a model. Its joints and actuators come first: they have the first places of positions,
/// velocities and controls.
#[derive(Clone, Debug)]
pub struct Arm {
    chain: Chain,
    /// From the place between the fingers to the flange.
    grip_to_flange: Pose,
    /// The site between the fingers.
    grip: usize,
    /// The body of the pad that feels contact.
    pad: usize,
}

/// What the arm feels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Proprioception {
    /// Where the place between the fingers is.
    pub place: Vec3,
    /// How the gripper is turned about the vertical.
    pub yaw: f64,
    /// How far the fingers are closed, 0 to 1.
    pub closed: f64,
    /// How fast they close, in radians a second.
    pub closing: f64,
    /// How firmly they hold something, 0 to 1.
    pub contact: f64,
}

impl Arm {
    /// Finds the arm in a model.
    ///
    /// # Errors
    /// When it is not there.
    pub fn new(model: &MjModel) -> Result<Self> {
        let body = |name| find(model, MjtObjBase::mjOBJ_BODY, name);
        let site = |name| find(model, MjtObjBase::mjOBJ_SITE, name);
        let at = |body: usize| Pose { place: model.body_pos()[body], turn: model.body_quat()[body] };
        let on = |site: usize| Pose { place: model.site_pos()[site], turn: model.site_quat()[site] };
        let mut links = [Link { at: at(0), axis: [0.0; 3] }; JOINTS];
        for (link, (body_name, joint_name)) in links.iter_mut().zip(LINKS) {
            let joint = find(model, MjtObjBase::mjOBJ_JOINT, joint_name)?;
            *link = Link { at: at(body(body_name)?), axis: model.jnt_axis()[joint] };
        }
        let (flange, grip) = (on(site("ur5e/attachment_site")?), site("ur5e/robotiq/pinch")?);
        // From the last link to the gripper, and on to the place between its fingers.
        let mut gripper = at(body("ur5e/robotiq/")?);
        for name in ["ur5e/robotiq/base_mount", "ur5e/robotiq/base"] {
            gripper = gripper.then(at(body(name)?));
        }
        Ok(Self {
            chain: Chain { base: at(body("ur5e/base")?), links, flange },
            grip_to_flange: gripper.then(on(grip)).inverse().then(flange),
            grip,
            pad: body("ur5e/robotiq/right_pad")?,
        })
    }

    /// Where the gripper is and how it is turned about the vertical.
    fn pose(&self, physics: &Physics) -> (Vec3, f64) {
        let data = physics.data();
        (data.site_xpos()[self.grip], pose::yaw_of_matrix(&data.site_xmat()[self.grip]))
    }

    /// Sets the controls for an action from -1 to 1.
    pub fn act(&self, physics: &mut Physics, action: &[f32], workspace: &[Vec3; 2]) {
        // Halved in single precision, as the reference does.
        let share = |i: usize| f64::from(0.5 * (action[i] + 1.0)) * (2.0 * REACH[i]) - REACH[i];
        let (place, yaw) = self.pose(physics);
        let place = std::array::from_fn(|i| (place[i] + share(i)).clamp(workspace[0][i], workspace[1][i]));
        let joints = self.joints_of(physics);
        let target = self.reach(place, yaw + share(3), joints);
        let closed = (fingers(physics) + share(4)).clamp(0.0, 1.0);
        let controls = physics.data_mut().ctrl_mut();
        controls[..JOINTS].copy_from_slice(&target);
        controls[JOINTS] = FINGER_CONTROL * closed;
    }

    /// Joint positions near `start` with the gripper at a place, pointing down and turned by `yaw`.
    pub fn reach(&self, place: Vec3, yaw: f64, start: [f64; JOINTS]) -> [f64; JOINTS] {
        let grip = Pose { place, turn: pose::mul(pose::about_z(pose::wrap(yaw)), DOWN) };
        self.chain.solve(grip.then(self.grip_to_flange), start)
    }

    /// Where the joints are.
    pub fn joints_of(&self, physics: &Physics) -> [f64; JOINTS] {
        std::array::from_fn(|i| physics.data().qpos()[i])
    }

    /// Puts the joints somewhere; the caller computes what follows.
    pub fn put(&self, physics: &mut Physics, joints: [f64; JOINTS]) {
        physics.data_mut().qpos_mut()[..JOINTS].copy_from_slice(&joints);
    }

    /// How firmly the fingers hold something. Valid where contact forces were computed.
    pub fn contact(&self, physics: &Physics) -> f64 {
        (pose::norm(&physics.data().cfrc_ext()[self.pad]) / FULL_CONTACT).clamp(0.0, 1.0)
    }

    /// What the arm feels; `contact` as it was when forces were computed.
    pub fn feel(&self, physics: &Physics, contact: f64) -> Proprioception {
        let (place, yaw) = self.pose(physics);
        Proprioception { place, yaw, closed: fingers(physics), closing: physics.data().qvel()[JOINTS], contact }
    }
}

/// How far the fingers are closed.
fn fingers(physics: &Physics) -> f64 {
    (physics.data().qpos()[JOINTS] / CLOSED).clamp(0.0, 1.0)
}
