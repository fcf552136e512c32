#![doc = include_str!("README.md")]
mod arm;
mod floor;
mod maze;
mod options;
mod table;

use mujoco_rs::wrappers::MjModel;
use std::sync::Arc;
use swm_core::{EnvEntry, Result};

/// The registry rows of OGBench.
pub const ENTRIES: [EnvEntry; 3] = [
    EnvEntry {
        id: "swm/OGBCube-v0",
        summary: "a robot arm moves cubes on a table to their goals",
        options: table::CUBE_OPTIONS,
        make: table::make_cube,
        experts: table::EXPERTS,
    },
    EnvEntry {
        id: "swm/OGBScene-v0",
        summary: "a robot arm moves a cube, presses buttons that lock a drawer and a window, and opens and closes both",
        options: table::SCENE_OPTIONS,
        make: table::make_scene,
        experts: table::EXPERTS,
    },
    EnvEntry {
        id: "swm/OGBMaze-v0",
        summary: "a point or an ant moves through a maze to its goal",
        options: maze::OPTIONS,
        make: maze::make,
        experts: maze::EXPERTS,
    },
];

/// The compiled models of these environments by name, for a comparison with the models of the reference.
pub fn models() -> impl Iterator<Item = (String, Result<Arc<MjModel>>)> {
    table::models().chain(maze::models())
}
