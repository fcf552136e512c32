#![doc = include_str!("README.md")]
mod arm;
mod floor;
mod maze;
mod table;

use mujoco_rs::wrappers::MjModel;
use std::sync::Arc;
use swm_core::{EnvEntry, Result};

/// The registry rows.
pub const ENTRIES: [EnvEntry; 3] = [
    EnvEntry {
        id: "swm/OGBCube-v0",
        summary: "an arm puts cubes where they should go, on a table",
        options: table::CUBE_OPTIONS,
        make: table::make_cube,
        experts: table::EXPERTS,
    },
    EnvEntry {
        id: "swm/OGBScene-v0",
        summary: "an arm moves a cube, presses buttons that lock a drawer and a window, and opens and closes these",
        options: table::SCENE_OPTIONS,
        make: table::make_scene,
        experts: table::EXPERTS,
    },
    EnvEntry {
        id: "swm/OGBMaze-v0",
        summary: "a point or an ant finds the way through a maze",
        options: maze::OPTIONS,
        make: maze::make,
        experts: maze::EXPERTS,
    },
];

/// The models of these worlds as they are compiled, by name: for whoever compares them with the reference's.
pub fn models() -> impl Iterator<Item = (String, Result<Arc<MjModel>>)> {
    table::models().chain(maze::models())
}
