//! The worlds of OGBench: tables with an arm, and mazes.
mod arm;
mod floor;
mod table;

use mujoco_rs::wrappers::MjModel;
use std::sync::Arc;
use swm_core::{EnvEntry, Result};

/// The registry rows.
pub const ENTRIES: [EnvEntry; 2] = [
    EnvEntry {
        id: "swm/OGBCube-v0",
        summary: "an arm puts cubes where they should go, on a table",
        options: table::CUBE_OPTIONS,
        make: table::make_cube,
        experts: &[],
    },
    EnvEntry {
        id: "swm/OGBScene-v0",
        summary: "an arm moves a cube, presses buttons that lock a drawer and a window, and opens and closes these",
        options: table::SCENE_OPTIONS,
        make: table::make_scene,
        experts: &[],
    },
];

/// The models of these worlds as they are compiled, by name: for whoever compares them with the reference's.
pub fn models() -> impl Iterator<Item = (&'static str, Result<Arc<MjModel>>)> {
    table::models()
}
