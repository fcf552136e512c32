#![doc = include_str!("README.md")]

mod compat_332;
mod config;
mod expert;
mod factors;
mod task;

use crate::env::MujocoEnv;
use config::{PICK_AND_PLACE, PUSH, REACH, SLIDE, TaskConfig};
use swm_core::{ColumnSpec, DType, Env, EnvChoice, EnvEntry, EnvSpec, Result, Space, columns};
use task::{Fetch, ObservationKind, Reward, proprio_len};

macro_rules! entry {
    ($id:literal, $config:ident, $reward:ident, $observation:ident, $summary:literal, $experts:ident) => {
        EnvEntry {
            id: $id,
            summary: $summary,
            options: &[],
            make: |choice| make(choice, &$config, Reward::$reward, ObservationKind::$observation),
            experts: expert::$experts,
        }
    };
}

/// The registry rows of the Fetch tasks.
#[rustfmt::skip]
pub const ENTRIES: [EnvEntry; 12] = [
    entry!("swm/FetchReach-v3", REACH, Sparse, Flat, "move a robot's gripper to a point in the air", REACH_EXPERTS),
    entry!("swm/FetchReachDense-v3", REACH, Dense, Flat, "FetchReach with a dense reward: the negative distance", REACH_EXPERTS),
    entry!("swm/FetchReachDict-v3", REACH, Sparse, Dict, "FetchReach with a dictionary observation", REACH_EXPERTS),
    entry!("swm/FetchPush-v3", PUSH, Sparse, Flat, "push a block to a point on the table", PUSH_EXPERTS),
    entry!("swm/FetchPushDense-v3", PUSH, Dense, Flat, "FetchPush with a dense reward: the negative distance", PUSH_EXPERTS),
    entry!("swm/FetchPushDict-v3", PUSH, Sparse, Dict, "FetchPush with a dictionary observation", PUSH_EXPERTS),
    entry!("swm/FetchSlide-v3", SLIDE, Sparse, Flat, "hit a puck so that it slides to a point out of reach", SLIDE_EXPERTS),
    entry!("swm/FetchSlideDense-v3", SLIDE, Dense, Flat, "FetchSlide with a dense reward: the negative distance", SLIDE_EXPERTS),
    entry!("swm/FetchSlideDict-v3", SLIDE, Sparse, Dict, "FetchSlide with a dictionary observation", SLIDE_EXPERTS),
    entry!("swm/FetchPickAndPlace-v3", PICK_AND_PLACE, Sparse, Flat, "lift a block and hold it at a point", PICK_EXPERTS),
    entry!("swm/FetchPickAndPlaceDense-v3", PICK_AND_PLACE, Dense, Flat, "FetchPickAndPlace with a dense reward: the negative distance", PICK_EXPERTS),
    entry!("swm/FetchPickAndPlaceDict-v3", PICK_AND_PLACE, Sparse, Dict, "FetchPickAndPlace with a dictionary observation", PICK_EXPERTS),
];

/// Creates an environment.
fn make(
    choice: &EnvChoice,
    config: &'static TaskConfig,
    reward: Reward,
    observation: ObservationKind,
) -> Result<Box<dyn Env>> {
    let setup = config.setup()?;
    let model = setup.model.clone();
    let proprio = proprio_len(config.has_object());
    let unbounded = |n: usize, dtype| Space::uniform_box([n], dtype, f64::NEG_INFINITY, f64::INFINITY);
    let mut columns = vec![
        ColumnSpec::new(columns::PROPRIO, DType::Float64, [proprio]),
        ColumnSpec::new(columns::GOAL_STATE, DType::Float64, [setup.qpos.len() + setup.qvel.len()]),
        ColumnSpec::new("achieved_goal", DType::Float64, [3]),
        ColumnSpec::new("desired_goal", DType::Float64, [3]),
    ];
    let observation_space = match observation {
        ObservationKind::Flat => {
            columns.push(ColumnSpec::new("observation", DType::Float32, [proprio + 3]));
            vec![("observation", unbounded(proprio + 3, DType::Float32))]
        }
        ObservationKind::Dict => {
            columns.push(ColumnSpec::new("observation", DType::Float64, [proprio]));
            vec![
                ("observation", unbounded(proprio, DType::Float64)),
                ("achieved_goal", unbounded(3, DType::Float64)),
                ("desired_goal", unbounded(3, DType::Float64)),
            ]
        }
    };
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([4], DType::Float32, -1.0, 1.0),
        columns,
        observation_space,
        variation_space: factors::variation_space(config.has_object()),
        max_episode_steps: 50,
        cameras: vec![],
        angles: vec![],
    };
    Ok(Box::new(MujocoEnv::new(spec, model, Fetch::new(config, setup, reward, observation)?)?))
}
