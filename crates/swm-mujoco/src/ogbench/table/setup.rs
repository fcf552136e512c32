//! What tells one table from another: how many cubes, whether there are buttons, a drawer and a window, where things may
//! be, who looks, and which tasks there are. Numbers are OGBench's.

use super::tasks;

/// The least and the most of each coordinate.
pub type Bounds<const N: usize> = [[f64; N]; 2];

/// A camera.
#[derive(Debug)]
pub struct Camera {
    /// Its name.
    pub name: &'static str,
    /// Where it is, in metres.
    pub place: [f64; 3],
    /// What is right in its picture, and what is up.
    pub axes: [f64; 6],
}

/// A task: where everything begins and where it should go.
#[derive(Debug)]
pub struct Task {
    /// Where each cube begins.
    pub starts: &'static [[f64; 3]],
    /// Where each cube should go.
    pub goals: &'static [[f64; 3]],
    /// The fixtures, at the beginning and at the goal; tables without fixtures ignore them.
    pub fixtures: [Fixed; 2],
}

/// How buttons, drawer and window stand.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fixed {
    /// 0 locks (the first button the drawer, the second the window), 1 unlocks.
    pub buttons: [u8; 2],
    /// How far the drawer is open: 0 closed, -0.16 m open.
    pub drawer: f64,
    /// How far the window is open: 0 closed, 0.2 m open.
    pub window: f64,
}

/// What is special about the factors of a table.
#[derive(Debug)]
pub struct FactorSetup {
    /// The most a camera is turned, in degrees.
    pub camera_turn: f64,
    /// Where cubes begin and end unless that varies.
    pub cube: [f64; 2],
    /// How bright it is unless that varies.
    pub light: f64,
    /// What a reset samples that asks for nothing.
    pub defaults: &'static [&'static str],
}

/// A table.
#[derive(Debug)]
pub struct Setup {
    /// The id of its world.
    pub id: &'static str,
    /// What models of it are called: one a kind.
    pub name: &'static str,
    /// How many cubes.
    pub cubes: usize,
    /// Whether there are buttons, drawer and window.
    pub fixtures: bool,
    /// Where the gripper may begin.
    pub arm_bounds: Bounds<3>,
    /// Where cubes may begin and end.
    pub object_bounds: Bounds<2>,
    /// Its cameras.
    pub cameras: &'static [Camera],
    /// What is special about its factors.
    pub factors: FactorSetup,
    /// Its tasks.
    pub tasks: &'static [Task],
    /// Steps of an episode.
    pub limit: usize,
}

/// Where the gripper may go: whoever asks for more stays at the border.
pub const WORKSPACE: Bounds<3> = [[0.25, -0.35, 0.02], [0.6, 0.35, 0.35]];

/// The cubes' colours, in their order.
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
    Camera { name: "front", place: [1.287, 0.0, 0.509], axes: [0.0, 1.0, 0.0, -0.342, 0.0, 0.940] },
    Camera { name: FRONT, place: [1.053, -0.014, 0.639], axes: [0.0, 1.0, 0.0, -0.628, 0.001, 0.778] },
    Camera { name: SIDE, place: [0.414, -0.753, 0.639], axes: [1.0, 0.0, 0.0, -0.001, 0.628, 0.778] },
    Camera { name: "side", place: [1.287, 0.0, 0.509], axes: [1.0, 0.0, 0.0, -0.001, 0.628, 0.778] },
];

const SCENE_CAMERAS: &[Camera] = &[
    Camera { name: "front", place: [1.139, 0.0, 0.821], axes: [0.0, 1.0, 0.0, -0.627, 0.0, 0.779] },
    Camera { name: FRONT, place: [0.905, 0.0, 0.762], axes: [0.0, 1.0, 0.0, -0.771, 0.0, 0.637] },
    Camera { name: SIDE, place: [0.4, -0.505, 0.762], axes: [1.0, 0.0, 0.0, 0.0, 0.771, 0.637] },
];

/// The camera that looks unless another is asked for.
pub const FRONT: &str = "front_pixels";
/// The camera from the side.
pub const SIDE: &str = "side_pixels";

/// A table with cubes alone.
const fn table(name: &'static str, cubes: usize, tasks: &'static [Task], limit: usize) -> Setup {
    Setup {
        id: "swm/OGBCube-v0",
        name,
        cubes,
        fixtures: false,
        arm_bounds: [[0.25, -0.35, 0.20], [0.6, 0.35, 0.35]],
        object_bounds: [[0.3, -0.3], [0.55, 0.3]],
        cameras: CUBE_CAMERAS,
        factors: FactorSetup {
            camera_turn: 10.0,
            light: 0.7,
            cube: [0.3, 0.0],
            defaults: &["cube.start_position", "cube.start_yaw", "cube.goal_position", "cube.goal_yaw"],
        },
        tasks,
        limit,
    }
}

/// The tables of `swm/OGBCube-v0`, by `env_type`; the first is the default.
pub static CUBES: [Setup; 5] = [
    table("single", 1, tasks::SINGLE, 200),
    table("double", 2, tasks::DOUBLE, 500),
    table("triple", 3, tasks::TRIPLE, 1000),
    table("quadruple", 4, tasks::QUADRUPLE, 1000),
    table("octuple", 8, tasks::OCTUPLE, 1500),
];

/// The table of `swm/OGBScene-v0`.
pub static SCENE: Setup = Setup {
    id: "swm/OGBScene-v0",
    name: "scene",
    cubes: 1,
    fixtures: true,
    arm_bounds: [[0.25, -0.2, 0.20], [0.6, 0.2, 0.35]],
    object_bounds: [[0.3, -0.07], [0.45, 0.18]],
    cameras: SCENE_CAMERAS,
    factors: FactorSetup { camera_turn: 5.0, light: 0.6, cube: [0.375, 0.054_999_999_999_999_99], defaults: &[] },
    tasks: tasks::SCENE,
    limit: 750,
};
