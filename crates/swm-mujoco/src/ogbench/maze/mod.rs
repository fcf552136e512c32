//! Mazes for a point or an ant: `swm/OGBMaze-v0`.

mod agent;
mod expert;
mod map;
mod model;
mod task;

pub use expert::EXPERTS;

use crate::env::MujocoEnv;
use crate::ogbench::floor;
use crate::ogbench::options::{PIXELS, TERMINATE_AT_GOAL};
use crate::physics::{self, shared_model};
use agent::Agent;
use map::{MAPS, Map};
use mujoco_rs::wrappers::MjModel;
use std::sync::Arc;
use swm_core::registry::EnvOption;
use swm_core::{ColumnSpec, DType, Env, EnvChoice, EnvSpec, Error, Factor, Result, Space, VariationSpace, columns};
use task::{Maze, Settings, TASK_STATE_HEAD};

/// Steps after which an episode is truncated.
const MAX_STEPS: usize = 1000;

/// The options of `swm/OGBMaze-v0`.
pub const OPTIONS: &[EnvOption] = &[
    EnvOption { key: "loco_env_type", summary: "the agent: a point or an ant", values: &["point", "ant"] },
    EnvOption { key: "maze_type", summary: "the maze", values: &["large", "arena", "medium", "giant", "teleport"] },
    EnvOption {
        key: "ob_type",
        summary: "states: frames show the goal; pixels: frames hide it, and the floor may encode the position",
        values: &["states", PIXELS],
    },
    EnvOption {
        key: "reward_task_id",
        summary: "a fixed task (0: the default task) with reward -1 until success; none: a random task",
        values: &["none", "0", "1", "2", "3", "4", "5"],
    },
    TERMINATE_AT_GOAL,
    EnvOption {
        key: "add_noise_to_goal",
        summary: "whether goals differ from the centres of cells",
        values: &["true", "false"],
    },
];

/// Creates a maze environment.
///
/// # Errors
/// When MuJoCo or OGBench's files are not installed, or the maze lacks the task of `reward_task_id`.
pub fn make(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let chosen = |key| choice.choices.get(key);
    let agent = if chosen("loco_env_type") == "ant" { Agent::Ant } else { Agent::Point };
    let map = MAPS.iter().find(|map| map.name == chosen("maze_type")).unwrap_or(&MAPS[0]);
    let pixels = chosen("ob_type") == PIXELS;
    let fixed_task = match chosen("reward_task_id").parse::<usize>() {
        Err(_) => None,
        Ok(task) if task <= map.tasks.len() => Some(task.max(1) - 1),
        Ok(task) => {
            let problem = format!("there is no task {task} in the {} maze", map.name);
            return Err(Error::config("reward_task_id", problem, format!("choose one of 1 to {}", map.tasks.len())));
        }
    };
    let model = model(agent, map, pixels)?;
    let spec = spec(choice, agent, pixels, &model);
    let settings = Settings {
        agent,
        map,
        fixed_task,
        terminate: chosen("terminate_at_goal") == "true",
        goal_noise: chosen("add_noise_to_goal") == "true",
        pixels,
    };
    let maze = Maze::new(&model, settings)?;
    Ok(Box::new(MujocoEnv::new(spec, model, maze)?))
}

/// Columns, spaces and time limit of a maze.
fn spec(choice: &EnvChoice, agent: Agent, pixels: bool, model: &MjModel) -> EnvSpec {
    let (nq, nv, action_dim) = (model.qpos0().len(), model.dof_damping().len(), model.actuator_ctrlrange().len());
    let observation_len = if agent == Agent::Ant { nq + nv } else { nq };
    let unbounded = Space::uniform_box([observation_len], DType::Float64, f64::NEG_INFINITY, f64::INFINITY);
    let float = |name: &str, n: usize| ColumnSpec::new(name, DType::Float64, [n]);
    EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([action_dim], DType::Float32, -1.0, 1.0),
        columns: vec![
            float("observation", observation_len),
            float(columns::GOAL_STATE, physics::state_len(model) + TASK_STATE_HEAD + nq + nv),
            float("xy", 2),
            float("prev_qpos", nq),
            float("prev_qvel", nv),
            float("qpos", nq),
            float("qvel", nv),
            float("goal/xy", 2),
            float("goal/next_xy", 2),
        ],
        observation_space: vec![("observation", unbounded)],
        variation_space: variation_space(pixels),
        max_episode_steps: MAX_STEPS,
        cameras: vec![],
        angles: vec![],
    }
}

/// The model of a maze, compiled once per process.
fn model(agent: Agent, map: &Map, pixels: bool) -> Result<Arc<MjModel>> {
    let name = format!("swm/OGBMaze-v0 {agent:?} {} {pixels}", map.name);
    shared_model(&name, || model::compile(agent, map, pixels))
}

/// The compiled models of all mazes, by name.
pub fn models() -> impl Iterator<Item = (String, Result<Arc<MjModel>>)> {
    let agents = [(Agent::Point, "point"), (Agent::Ant, "ant")];
    agents.into_iter().flat_map(|(agent, name)| {
        MAPS.iter().map(move |map| (format!("{name}-{}", map.name), model(agent, map, false)))
    })
}

/// The factors of variation. Names, bounds, defaults and order are those of the reference.
fn variation_space(pixels: bool) -> VariationSpace {
    let color = |shape: &[usize]| Space::uniform_box(shape, DType::Float64, 0.0, 1.0);
    let wall = if pixels { 0.6 } else { 1.0 };
    VariationSpace::new(
        vec![
            Factor::new("agent.color", color(&[3]), [0.7, 0.5, 0.3]),
            Factor::new("floor.color", color(&[2, 3]), floor::COLORS.concat()),
            Factor::new("floor.pixel_encoding", Space::Discrete { n: 2, start: 0 }, [0.0]),
            Factor::new("light.intensity", color(&[1]), [1.0]),
            Factor::new("wall.color", color(&[3]), [wall; 3]),
        ],
        &[],
    )
}
