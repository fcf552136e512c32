//! [`TableConfig`]: the objects, bounds, cameras and tasks that distinguish the tables. Values are OGBench's
//! (`manipspace/envs/cube_env.py`, `scene_env.py`).

use super::tasks;
use crate::ogbench::arm::pose::Vec3;

/// Lower and upper bound of each coordinate, in metres.
pub type Bounds<const N: usize> = [[f64; N]; 2];

/// A camera of a table's model.
#[derive(Debug)]
pub struct Camera {
    /// The name of the camera.
    pub name: &'static str,
    /// The position, in metres.
    pub position: [f64; 3],
    /// The x-axis (right in the frame), then the y-axis (up in the frame).
    pub axes: [f64; 6],
}

/// A task: the initial and the goal state of all objects.
#[derive(Debug)]
pub struct Task {
    /// The initial position of each cube, in metres.
    pub starts: &'static [[f64; 3]],
    /// The goal position of each cube, in metres.
    pub goals: &'static [[f64; 3]],
    /// Initial and goal state of the fixtures; ignored without fixtures.
    pub fixtures: [FixtureState; 2],
}

/// The state of buttons, drawer and window.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FixtureState {
    /// The locks of drawer and window: 0 locked, 1 unlocked.
    pub buttons: [u8; 2],
    /// The opening of the drawer, in metres: 0 closed, -0.16 open.
    pub drawer: f64,
    /// The opening of the window, in metres: 0 closed, 0.2 open.
    pub window: f64,
}

/// Bounds and defaults of a table's factors of variation.
#[derive(Debug)]
pub struct FactorConfig {
    /// The largest rotation of a camera, in degrees.
    pub camera_angle: f64,
    /// The default position of cubes at start and goal, in metres.
    pub cube: [f64; 2],
    /// The default light intensity.
    pub light: f64,
    /// The factors that are sampled when a reset requests none.
    pub sampled_by_default: &'static [&'static str],
}

/// The configuration of a table.
#[derive(Debug)]
pub struct TableConfig {
    /// The id of the environment.
    pub id: &'static str,
    /// The name of the model.
    pub name: &'static str,
    /// The number of cubes.
    pub cubes: usize,
    /// Whether there are buttons, a drawer and a window.
    pub fixtures: bool,
    /// Bounds of the gripper's initial position.
    pub arm_bounds: Bounds<3>,
    /// Bounds of the cubes' initial and goal positions.
    pub object_bounds: Bounds<2>,
    /// The cameras.
    pub cameras: &'static [Camera],
    /// The factors of variation.
    pub factors: FactorConfig,
    /// The tasks.
    pub tasks: &'static [Task],
    /// The number of steps after which an episode is truncated.
    pub max_steps: usize,
}

/// Height of the centre of a cube on the table, in metres; for cubes of any size, as in the reference.
pub const CUBE_HEIGHT: f64 = 0.02;
/// The position of markers that are not used, in metres.
pub const AWAY: Vec3 = [0.0, 0.0, -0.3];
/// The openings of an open drawer and an open window, in metres.
pub const OPEN: [f64; 2] = [-0.16, 0.2];

/// The number of elements of an observation: arm, cubes and fixtures.
pub const fn observation_len(cubes: usize, fixtures: bool) -> usize {
    19 + 9 * cubes + if fixtures { 12 } else { 0 }
}

/// Bounds of the gripper's target position (m), to which targets are clipped.
pub const WORKSPACE: Bounds<3> = [[0.25, -0.35, 0.02], [0.6, 0.35, 0.35]];

/// The default colours of the cubes.
pub const CUBE_COLORS: [[f64; 3]; 8] = [
    [0.96, 0.26, 0.33],
    [0.35, 0.55, 0.91],
    [1.0, 0.69, 0.21],
    [0.06, 0.74, 0.21],
    [0.61, 0.28, 0.82],
    [0.76, 0.96, 0.04],
    [0.82, 0.28, 0.61],
    [0.5, 0.5, 0.5],
];

const CUBE_CAMERAS: &[Camera] = &[
    Camera { name: "front", position: [1.287, 0.0, 0.509], axes: [0.0, 1.0, 0.0, -0.342, 0.0, 0.940] },
    Camera { name: FRONT, position: [1.053, -0.014, 0.639], axes: [0.0, 1.0, 0.0, -0.628, 0.001, 0.778] },
    Camera { name: SIDE, position: [0.414, -0.753, 0.639], axes: [1.0, 0.0, 0.0, -0.001, 0.628, 0.778] },
    Camera { name: "side", position: [1.287, 0.0, 0.509], axes: [1.0, 0.0, 0.0, -0.001, 0.628, 0.778] },
];

const SCENE_CAMERAS: &[Camera] = &[
    Camera { name: "front", position: [1.139, 0.0, 0.821], axes: [0.0, 1.0, 0.0, -0.627, 0.0, 0.779] },
    Camera { name: FRONT, position: [0.905, 0.0, 0.762], axes: [0.0, 1.0, 0.0, -0.771, 0.0, 0.637] },
    Camera { name: SIDE, position: [0.4, -0.505, 0.762], axes: [1.0, 0.0, 0.0, 0.0, 0.771, 0.637] },
];

/// The default camera.
pub const FRONT: &str = "front_pixels";
/// The camera at the side.
pub const SIDE: &str = "side_pixels";

/// A table with cubes only.
const fn table(name: &'static str, cubes: usize, tasks: &'static [Task], max_steps: usize) -> TableConfig {
    TableConfig {
        id: "swm/OGBCube-v0",
        name,
        cubes,
        fixtures: false,
        arm_bounds: [[0.25, -0.35, 0.20], [0.6, 0.35, 0.35]],
        object_bounds: [[0.3, -0.3], [0.55, 0.3]],
        cameras: CUBE_CAMERAS,
        factors: FactorConfig {
            camera_angle: 10.0,
            light: 0.7,
            cube: [0.3, 0.0],
            sampled_by_default: &["cube.start_position", "cube.start_yaw", "cube.goal_position", "cube.goal_yaw"],
        },
        tasks,
        max_steps,
    }
}

/// The tables of `swm/OGBCube-v0`, by `env_type`; the first is the default.
pub static CUBES: [TableConfig; 5] = [
    table("single", 1, tasks::SINGLE, 200),
    table("double", 2, tasks::DOUBLE, 500),
    table("triple", 3, tasks::TRIPLE, 1000),
    table("quadruple", 4, tasks::QUADRUPLE, 1000),
    table("octuple", 8, tasks::OCTUPLE, 1500),
];

/// The table of `swm/OGBScene-v0`.
pub static SCENE: TableConfig = TableConfig {
    id: "swm/OGBScene-v0",
    name: "scene",
    cubes: 1,
    fixtures: true,
    arm_bounds: [[0.25, -0.2, 0.20], [0.6, 0.2, 0.35]],
    object_bounds: [[0.3, -0.07], [0.45, 0.18]],
    cameras: SCENE_CAMERAS,
    factors: FactorConfig {
        camera_angle: 5.0,
        light: 0.6,
        cube: [0.375, 0.054_999_999_999_999_99],
        sampled_by_default: &[],
    },
    tasks: tasks::SCENE,
    max_steps: 750,
};
