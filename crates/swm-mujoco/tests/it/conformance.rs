//! What every environment must keep. Pictures take tens of milliseconds here, so everything is looked at less often than
//! in worlds of two dimensions.

use swm_conformance::Worlds;
use swm_mujoco::ENVS;

/// What the reference announces and never applies.
const ANNOUNCED: &str = "the reference never applies it";
/// What has a mass needs no density.
const MASS: &str = "its mass is given";
/// Sites of groups that are not drawn.
const HIDDEN: &str = "it is in a group that is not drawn";
/// A planar world along whose y-axis nothing moves.
const PLANAR: &str = "nothing moves along y";

/// What shows later than a few steps from the start.
const UNTOUCHED: &str = "nothing touches it so early";

/// Fetch's default picture is of a free camera, and the factor turns the model's.
const ANOTHER_CAMERA: &str = "the default camera is none of the model's";
/// What tasks decide unless data are collected.
const BY_TASK: &str = "the task says so";
/// What is of pictures for an agent that sees.
const SEEING: &str = "it matters with ob_type=pixels alone";
/// Reaching is done with nothing on the table.
const NO_OBJECT: &str = "there is no object";

/// Factors that change nothing, in the reference as here, or not so early.
const IDLE: &[(&str, &str, &str)] = &[
    ("swm/AcrobotDMControl-v0", "agent.lower_arm_density", MASS),
    ("swm/AcrobotDMControl-v0", "agent.upper_arm_density", MASS),
    ("swm/AcrobotDMControl-v0", "agent.upper_arm_locked", ANNOUNCED),
    ("swm/AcrobotDMControl-v0", "gravity.y", PLANAR),
    ("swm/AcrobotDMControl-v0", "target.color", HIDDEN),
    ("swm/AcrobotDMControl-v0", "target.shape", HIDDEN),
    ("swm/BallInCupDMControl-v0", "ball.color", ANNOUNCED),
    ("swm/BallInCupDMControl-v0", "rendering.render_target", HIDDEN),
    ("swm/BallInCupDMControl-v0", "target.color", HIDDEN),
    ("swm/BallInCupDMControl-v0", "target.shape", HIDDEN),
    ("swm/CartpoleDMControl-v0", "agent.cart_shape", ANNOUNCED),
    ("swm/CartpoleDMControl-v0", "agent.pole_density", MASS),
    ("swm/CartpoleDMControl-v0", "gravity.y", PLANAR),
    ("swm/CheetahDMControl-v0", "agent.back_foot_locked", ANNOUNCED),
    ("swm/CheetahDMControl-v0", "gravity.y", PLANAR),
    ("swm/FetchPickAndPlace-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchPickAndPlaceDense-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchPickAndPlaceDict-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchPush-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchPushDense-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchPushDict-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchReach-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchReach-v3", "object.color", NO_OBJECT),
    ("swm/FetchReachDense-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchReachDense-v3", "object.color", NO_OBJECT),
    ("swm/FetchReachDict-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchReachDict-v3", "object.color", NO_OBJECT),
    ("swm/FetchSlide-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchSlideDense-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FetchSlideDict-v3", "camera.angle_delta", ANOTHER_CAMERA),
    ("swm/FingerDMControl-v0", "spinner.density", UNTOUCHED),
    ("swm/FingerDMControl-v0", "spinner.friction", UNTOUCHED),
    ("swm/HopperDMControl-v0", "agent.foot_locked", ANNOUNCED),
    ("swm/HopperDMControl-v0", "floor.friction", UNTOUCHED),
    ("swm/HopperDMControl-v0", "gravity.y", PLANAR),
    ("swm/HumanoidDMControl-v0", "agent.left_knee_locked", ANNOUNCED),
    ("swm/ManipulatorDMControl-v0", "agent.upper_arm_length", ANNOUNCED),
    ("swm/OGBCube-v0", "cube.goal_position", BY_TASK),
    ("swm/OGBCube-v0", "cube.goal_yaw", BY_TASK),
    ("swm/OGBCube-v0", "cube.start_position", BY_TASK),
    ("swm/OGBCube-v0", "cube.start_yaw", BY_TASK),
    ("swm/OGBMaze-v0", "floor.pixel_encoding", SEEING),
    ("swm/OGBScene-v0", "cube.goal_position", BY_TASK),
    ("swm/OGBScene-v0", "cube.goal_yaw", BY_TASK),
    ("swm/OGBScene-v0", "cube.start_position", BY_TASK),
    ("swm/OGBScene-v0", "cube.start_yaw", BY_TASK),
    ("swm/PendulumDMControl-v0", "agent.mass_density", MASS),
    ("swm/PendulumDMControl-v0", "agent.mass_shape", ANNOUNCED),
    ("swm/PendulumDMControl-v0", "agent.pole_density", MASS),
    ("swm/PendulumDMControl-v0", "gravity.y", PLANAR),
    ("swm/QuadrupedDMControl-v0", "agent.knee_back_left_locked", ANNOUNCED),
    ("swm/QuadrupedDMControl-v0", "floor.friction", UNTOUCHED),
    ("swm/ReacherDMControl-v0", "agent.finger_locked", ANNOUNCED),
    ("swm/WalkerDMControl-v0", "agent.right_knee_locked", ANNOUNCED),
    ("swm/WalkerDMControl-v0", "gravity.y", PLANAR),
];

static WORLDS: Worlds = Worlds {
    demonstrated: false,
    size: (48, 64),
    sizes: &[(1, 1), (13, 7)],
    steps: 2,
    goals: 2,
    rows_restored: 1,
    values: 1,
    contexts: 1,
    requests: 1,
    resets: 20,
    idle: IDLE,
    ..Worlds::of(ENVS.rows)
};

swm_conformance::tests!(WORLDS);
