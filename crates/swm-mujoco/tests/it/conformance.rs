//! The conformance suite over every environment of this crate. Rendering takes tens of milliseconds here, so the checks
//! run with fewer repetitions than for 2-D environments.

use swm_conformance::Suite;
use swm_mujoco::ENVS;

/// The reference declares the factor and never applies it.
const NEVER_APPLIED: &str = "the reference never applies it";
/// A density has no effect on a geom with an explicit mass.
const EXPLICIT_MASS: &str = "the geom has an explicit mass";
/// Sites of hidden groups are not rendered.
const HIDDEN_GROUP: &str = "it is in a group that is not rendered";
/// Planar environments do not move along y.
const PLANAR: &str = "nothing moves along y";
/// The effect appears only at a contact, which needs more steps than the check takes.
const NO_EARLY_CONTACT: &str = "it has no effect before a contact, which the first steps do not have";
/// The default camera of Fetch is free, and the factor rotates only the cameras of the model.
const FREE_CAMERA: &str = "it does not rotate the default camera";
/// The factor applies with `mode=data_collection` only.
const SET_BY_TASK: &str = "the task sets it";
/// The factor applies with `ob_type=pixels` only.
const PIXELS_ONLY: &str = "it applies with ob_type=pixels only";
/// Reach has no object.
const NO_OBJECT: &str = "there is no object";

/// Factors without effect in these environments, or without effect in the first steps.
const INERT: &[(&str, &str, &str)] = &[
    ("swm/AcrobotDMControl-v0", "agent.lower_arm_density", EXPLICIT_MASS),
    ("swm/AcrobotDMControl-v0", "agent.upper_arm_density", EXPLICIT_MASS),
    ("swm/AcrobotDMControl-v0", "agent.upper_arm_locked", NEVER_APPLIED),
    ("swm/AcrobotDMControl-v0", "gravity.y", PLANAR),
    ("swm/AcrobotDMControl-v0", "target.color", HIDDEN_GROUP),
    ("swm/AcrobotDMControl-v0", "target.shape", HIDDEN_GROUP),
    ("swm/BallInCupDMControl-v0", "ball.color", NEVER_APPLIED),
    ("swm/BallInCupDMControl-v0", "rendering.render_target", HIDDEN_GROUP),
    ("swm/BallInCupDMControl-v0", "target.color", HIDDEN_GROUP),
    ("swm/BallInCupDMControl-v0", "target.shape", HIDDEN_GROUP),
    ("swm/CartpoleDMControl-v0", "agent.cart_shape", NEVER_APPLIED),
    ("swm/CartpoleDMControl-v0", "agent.pole_density", EXPLICIT_MASS),
    ("swm/CartpoleDMControl-v0", "gravity.y", PLANAR),
    ("swm/CheetahDMControl-v0", "agent.back_foot_locked", NEVER_APPLIED),
    ("swm/CheetahDMControl-v0", "gravity.y", PLANAR),
    ("swm/FetchPickAndPlace-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchPickAndPlaceDense-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchPickAndPlaceDict-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchPush-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchPushDense-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchPushDict-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchReach-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchReach-v3", "object.color", NO_OBJECT),
    ("swm/FetchReachDense-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchReachDense-v3", "object.color", NO_OBJECT),
    ("swm/FetchReachDict-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchReachDict-v3", "object.color", NO_OBJECT),
    ("swm/FetchSlide-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchSlideDense-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FetchSlideDict-v3", "camera.angle_delta", FREE_CAMERA),
    ("swm/FingerDMControl-v0", "spinner.density", NO_EARLY_CONTACT),
    ("swm/FingerDMControl-v0", "spinner.friction", NO_EARLY_CONTACT),
    ("swm/HopperDMControl-v0", "agent.foot_locked", NEVER_APPLIED),
    ("swm/HopperDMControl-v0", "floor.friction", NO_EARLY_CONTACT),
    ("swm/HopperDMControl-v0", "gravity.y", PLANAR),
    ("swm/HumanoidDMControl-v0", "agent.left_knee_locked", NEVER_APPLIED),
    ("swm/ManipulatorDMControl-v0", "agent.upper_arm_length", NEVER_APPLIED),
    ("swm/OGBCube-v0", "cube.goal_position", SET_BY_TASK),
    ("swm/OGBCube-v0", "cube.goal_yaw", SET_BY_TASK),
    ("swm/OGBCube-v0", "cube.start_position", SET_BY_TASK),
    ("swm/OGBCube-v0", "cube.start_yaw", SET_BY_TASK),
    ("swm/OGBMaze-v0", "floor.pixel_encoding", PIXELS_ONLY),
    ("swm/OGBScene-v0", "cube.goal_position", SET_BY_TASK),
    ("swm/OGBScene-v0", "cube.goal_yaw", SET_BY_TASK),
    ("swm/OGBScene-v0", "cube.start_position", SET_BY_TASK),
    ("swm/OGBScene-v0", "cube.start_yaw", SET_BY_TASK),
    ("swm/PendulumDMControl-v0", "agent.mass_density", EXPLICIT_MASS),
    ("swm/PendulumDMControl-v0", "agent.mass_shape", NEVER_APPLIED),
    ("swm/PendulumDMControl-v0", "agent.pole_density", EXPLICIT_MASS),
    ("swm/PendulumDMControl-v0", "gravity.y", PLANAR),
    ("swm/QuadrupedDMControl-v0", "agent.knee_back_left_locked", NEVER_APPLIED),
    ("swm/QuadrupedDMControl-v0", "floor.friction", NO_EARLY_CONTACT),
    ("swm/ReacherDMControl-v0", "agent.finger_locked", NEVER_APPLIED),
    ("swm/WalkerDMControl-v0", "agent.right_knee_locked", NEVER_APPLIED),
    ("swm/WalkerDMControl-v0", "gravity.y", PLANAR),
];

static SUITE: Suite = Suite {
    require_experts: false,
    frame_size: (48, 64),
    frame_sizes: &[(1, 1), (13, 7)],
    steps: 2,
    goals: 2,
    restored_rows: 1,
    values: 1,
    contexts: 1,
    requests: 1,
    resets: 20,
    inert_factors: INERT,
    ..Suite::of(ENVS.rows)
};

swm_conformance::tests!(SUITE);
