//! A table with an arm and cubes, and in the scene buttons, a drawer and a window: `swm/OGBCube-v0` and
//! `swm/OGBScene-v0`.

mod arena;
mod config;
mod expert;
mod factors;
mod goal;
mod objects;
mod observe;
mod start;
mod task;
mod tasks;

pub use expert::EXPERTS;

use super::arm::ACTION;
use crate::env::MujocoEnv;
use crate::ogbench::options::{PIXELS, TERMINATE_AT_GOAL};
use crate::physics::shared_model;
use arena::ArmRendering;
use config::{CUBES, SCENE, TableConfig, observation_len};
use mujoco_rs::wrappers::MjModel;
use std::sync::Arc;
use swm_core::registry::EnvOption;
use swm_core::{DType, Env, EnvChoice, EnvSpec, Result, Space};
use task::{Mode, Table};

/// The options of both tables, preceded by the given options.
macro_rules! options {
    ($($own:expr,)*) => {
        &[
            $($own,)*
            EnvOption {
                key: "mode",
                summary: "task: episodes perform a task; data_collection: the factors set the start, one object is the goal; play: likewise, one goal after another",
                values: &["task", "data_collection", "play"],
            },
            EnvOption {
                key: "reward_task_id",
                summary: "a fixed task (0: the default task), rewarded by -1 per unreached object; none: a random task",
                values: &["none", "0", "1", "2", "3", "4", "5"],
            },
            EnvOption {
                key: "ob_type",
                summary: "states: the arm is opaque; pixels: it is transparent and does not hide the cubes",
                values: &["states", PIXELS],
            },
            EnvOption {
                key: "permute_blocks",
                summary: "whether the cubes of a task are shuffled",
                values: &["true", "false"],
            },
            TERMINATE_AT_GOAL,
            EnvOption {
                key: "multiview",
                summary: "whether camera.angle_delta also rotates the camera at the side",
                values: &["false", "true"],
            },
        ]
    };
}

/// The options of `swm/OGBCube-v0`.
pub const CUBE_OPTIONS: &[EnvOption] = options![EnvOption {
    key: "env_type",
    summary: "the number of cubes: 1, 2, 3, 4 or 8",
    values: &["single", "double", "triple", "quadruple", "octuple"],
},];

/// The options of `swm/OGBScene-v0`.
pub const SCENE_OPTIONS: &[EnvOption] = options![];

/// The task that `reward_task_id=0` selects, counted from 1.
const DEFAULT_TASK: usize = 2;

/// Creates a table environment with cubes.
///
/// # Errors
/// When MuJoCo or OGBench's files are not installed.
pub fn make_cube(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let name = choice.choices.get("env_type");
    make(CUBES.iter().find(|config| config.name == name).unwrap_or(&CUBES[0]), choice)
}

/// Creates the scene environment.
///
/// # Errors
/// When MuJoCo or OGBench's files are not installed.
pub fn make_scene(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    make(&SCENE, choice)
}

/// The model of a table, compiled once per process.
fn model(config: &TableConfig, arm_rendering: ArmRendering) -> Result<Arc<MjModel>> {
    let name = format!("{} {} {arm_rendering:?}", config.id, config.name);
    shared_model(&name, || arena::compile(config, arm_rendering))
}

/// The compiled models of all tables, by name.
pub fn models() -> impl Iterator<Item = (String, Result<Arc<MjModel>>)> {
    CUBES.iter().chain([&SCENE]).map(|config| (config.name.to_owned(), model(config, ArmRendering::Opaque)))
}

/// Creates a table environment.
fn make(config: &'static TableConfig, choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let chosen = |key| choice.choices.get(key);
    let arm_rendering = if chosen("ob_type") == PIXELS { ArmRendering::Transparent } else { ArmRendering::Opaque };
    let model = model(config, arm_rendering)?;
    let mode = match (chosen("mode"), chosen("reward_task_id").parse()) {
        ("data_collection", _) => Mode::DataCollection,
        ("play", _) => Mode::Play,
        (_, Err(_)) => Mode::RandomTask,
        (_, Ok(0)) => Mode::FixedTask(DEFAULT_TASK - 1),
        (_, Ok(task)) => Mode::FixedTask(task - 1),
    };
    let (permute, terminate) = (chosen("permute_blocks") == "true", chosen("terminate_at_goal") == "true");
    let table = Table::new(config, &model, mode, permute, terminate)?;
    let len = observation_len(config.cubes, config.fixtures);
    let unbounded = Space::uniform_box([len], DType::Float64, f64::NEG_INFINITY, f64::INFINITY);
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([ACTION], DType::Float32, -1.0, 1.0),
        columns: table.columns(&model),
        observation_space: vec![("observation", unbounded)],
        variation_space: factors::space(config, if chosen("multiview") == "true" { 2 } else { 1 }),
        max_episode_steps: config.max_steps,
        cameras: vec![],
        angles: vec![],
    };
    Ok(Box::new(MujocoEnv::new(spec, model, table)?))
}
