//! The robot: a UR5e arm with a Robotiq 2F-85 gripper that points down.
//!
//! An action moves the gripper relative to its present pose: up to 5 cm along each axis, 0.3 rad about the vertical,
//! and the full range of the fingers. The target pose is clipped to the workspace and converted to joint angles by
//! inverse kinematics; the arm's position actuators hold these angles for one control step. Constants are OGBench's
//! (`manipspace/envs/manipspace_env.py`).

pub mod ik;
pub mod pose;

use crate::Physics;
use ik::{Chain, JOINTS, Link};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use pose::{Pose, Quat, Vec3};
use std::f64::consts::FRAC_PI_2;
use swm_core::{Error, Result};

/// The number of elements of an action.
pub const ACTION: usize = 5;
/// The number of actuators: six joints and the fingers.
pub const CONTROLS: usize = JOINTS + 1;

/// The effect of an action of 1: metres along x, y and z, radians of yaw, and fraction of the fingers' range.
const ACTION_SCALE: [f64; ACTION] = [0.05, 0.05, 0.05, 0.3, 1.0];
/// The orientation of a gripper that points down.
const DOWN: Quat = [0.0, 1.0, 0.0, 0.0];
/// The home position of the joints, in radians.
pub const HOME: [f64; JOINTS] = [-FRAC_PI_2, -FRAC_PI_2, FRAC_PI_2, -FRAC_PI_2, -FRAC_PI_2, 0.0];
/// The finger joint of a closed gripper, in radians.
const CLOSED: f64 = 0.8;
/// The control of a closed gripper.
const CLOSED_CONTROL: f64 = 255.0;
/// The norm of force (N) and torque (N m) on a finger's pad that counts as full contact.
const FULL_CONTACT: f64 = 50.0;

/// The links of the arm, each with the joint about which it turns.
const LINKS: [(&str, &str); JOINTS] = [
    ("ur5e/shoulder_link", "ur5e/shoulder_pan_joint"),
    ("ur5e/upper_arm_link", "ur5e/shoulder_lift_joint"),
    ("ur5e/forearm_link", "ur5e/elbow_joint"),
    ("ur5e/wrist_1_link", "ur5e/wrist_1_joint"),
    ("ur5e/wrist_2_link", "ur5e/wrist_2_joint"),
    ("ur5e/wrist_3_link", "ur5e/wrist_3_joint"),
];

/// The index of a named element of a model.
///
/// # Errors
/// When the model has no such element: its files are not those of the pinned version.
pub fn find(model: &MjModel, kind: MjtObjBase, name: &str) -> Result<usize> {
    model.name_to_id(kind, name).ok_or_else(|| {
        let problem = format!("it has no element '{name}'; `swm assets verify` checks the installed model files");
        Error::external("searching OGBench's model", problem)
    })
}

/// The arm in a model. Its joints and actuators have the first indices in `qpos`, `qvel` and `ctrl`.
#[derive(Clone, Debug)]
pub struct Arm {
    chain: Chain,
    /// The pose of the flange in the frame of the pinch site.
    pinch_to_flange: Pose,
    /// The site between the fingers.
    pinch: usize,
    /// The body of the right finger's pad, whose contact force is measured.
    pad: usize,
}

/// The state of the gripper.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Proprioception {
    /// Position of the pinch site, in metres.
    pub position: Vec3,
    /// Rotation of the gripper about the vertical, in radians.
    pub yaw: f64,
    /// The closure of the fingers: 0 (open) to 1 (closed).
    pub closed: f64,
    /// Velocity of the finger joint, in rad/s.
    pub closing: f64,
    /// Contact with an object: 0 (none) to 1 (full).
    pub contact: f64,
}

impl Arm {
    /// Finds the arm in a model.
    ///
    /// # Errors
    /// When the model lacks a part of the arm.
    pub fn new(model: &MjModel) -> Result<Self> {
        let body = |name| find(model, MjtObjBase::mjOBJ_BODY, name);
        let site = |name| find(model, MjtObjBase::mjOBJ_SITE, name);
        let body_pose = |body: usize| Pose { position: model.body_pos()[body], rotation: model.body_quat()[body] };
        let site_pose = |site: usize| Pose { position: model.site_pos()[site], rotation: model.site_quat()[site] };
        let mut links = [Link { rest: body_pose(0), axis: [0.0; 3] }; JOINTS];
        for (link, (body_name, joint_name)) in links.iter_mut().zip(LINKS) {
            let joint = find(model, MjtObjBase::mjOBJ_JOINT, joint_name)?;
            *link = Link { rest: body_pose(body(body_name)?), axis: model.jnt_axis()[joint] };
        }
        let (flange, pinch) = (site_pose(site("ur5e/attachment_site")?), site("ur5e/robotiq/pinch")?);
        // The pose of the gripper's base in the frame of the last link.
        let mut gripper = body_pose(body("ur5e/robotiq/")?);
        for name in ["ur5e/robotiq/base_mount", "ur5e/robotiq/base"] {
            gripper = gripper.then(body_pose(body(name)?));
        }
        Ok(Self {
            chain: Chain { base: body_pose(body("ur5e/base")?), links, flange },
            pinch_to_flange: gripper.then(site_pose(pinch)).inverse().then(flange),
            pinch,
            pad: body("ur5e/robotiq/right_pad")?,
        })
    }

    /// Position (m) and yaw (rad) of the pinch site.
    fn pose(&self, physics: &Physics) -> (Vec3, f64) {
        let data = physics.data();
        (data.site_xpos()[self.pinch], pose::yaw_of_matrix(&data.site_xmat()[self.pinch]))
    }

    /// Sets the controls for an action in [-1, 1].
    pub fn apply_action(&self, physics: &mut Physics, action: &[f32], workspace: &[Vec3; 2]) {
        // Halved in single precision, as in the reference.
        let scaled = |i: usize| f64::from(0.5 * (action[i] + 1.0)) * (2.0 * ACTION_SCALE[i]) - ACTION_SCALE[i];
        let (position, yaw) = self.pose(physics);
        let position = std::array::from_fn(|i| (position[i] + scaled(i)).clamp(workspace[0][i], workspace[1][i]));
        let joints = self.joints(physics);
        let target = self.solve(position, yaw + scaled(3), joints);
        let closed = (closed_fraction(physics) + scaled(4)).clamp(0.0, 1.0);
        let controls = physics.data_mut().ctrl_mut();
        controls[..JOINTS].copy_from_slice(&target);
        controls[JOINTS] = CLOSED_CONTROL * closed;
    }

    /// Joint angles (rad) near `start` that put the pinch site at a position (m), pointing down, rotated by `yaw`
    /// (rad).
    pub fn solve(&self, position: Vec3, yaw: f64, start: [f64; JOINTS]) -> [f64; JOINTS] {
        let pinch = Pose { position, rotation: pose::mul(pose::about_z(pose::wrap(yaw)), DOWN) };
        self.chain.solve(pinch.then(self.pinch_to_flange), start)
    }

    /// The joint angles, in radians.
    fn joints(&self, physics: &Physics) -> [f64; JOINTS] {
        std::array::from_fn(|i| physics.data().qpos()[i])
    }

    /// Sets the joint angles; the caller updates derived quantities.
    pub fn set_joints(&self, physics: &mut Physics, joints: [f64; JOINTS]) {
        physics.data_mut().qpos_mut()[..JOINTS].copy_from_slice(&joints);
    }

    /// Contact of the gripper, 0 to 1. Valid after [`Physics::contact_forces`].
    pub fn contact(&self, physics: &Physics) -> f64 {
        (pose::norm(&physics.data().cfrc_ext()[self.pad]) / FULL_CONTACT).clamp(0.0, 1.0)
    }

    /// The state of the gripper. `contact` is the value computed with the last contact forces.
    pub fn proprioception(&self, physics: &Physics, contact: f64) -> Proprioception {
        let (position, yaw) = self.pose(physics);
        let closing = physics.data().qvel()[JOINTS];
        Proprioception { position, yaw, closed: closed_fraction(physics), closing, contact }
    }
}

/// The closure of the fingers: 0 (open) to 1 (closed).
fn closed_fraction(physics: &Physics) -> f64 {
    (physics.data().qpos()[JOINTS] / CLOSED).clamp(0.0, 1.0)
}
