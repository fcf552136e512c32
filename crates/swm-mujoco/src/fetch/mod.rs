#![doc = include_str!("README.md")]

mod boxes;
mod era;
mod expert;
mod factors;
mod kind;
mod task;

use crate::env::World;
use kind::{Kind, PICK_AND_PLACE, PUSH, REACH, SLIDE};
use swm_core::{ColumnSpec, DType, Env, EnvChoice, EnvEntry, EnvSpec, Result, Space};
use task::{Fetch, Reward, Sight, known_len};

macro_rules! entry {
    ($id:literal, $kind:ident, $reward:ident, $sight:ident, $summary:literal, $experts:ident) => {
        EnvEntry {
            id: $id,
            summary: $summary,
            options: &[],
            make: |choice| make(choice, &$kind, Reward::$reward, Sight::$sight),
            experts: expert::$experts,
        }
    };
}

/// The registry rows.
#[rustfmt::skip]
pub const ENTRIES: [EnvEntry; 12] = [
    entry!("swm/FetchReach-v3", REACH, Sparse, Flat, "lead a robot's gripper to a place in the air", REACHERS),
    entry!("swm/FetchReachDense-v3", REACH, Dense, Flat, "FetchReach, rewarded by distance", REACHERS),
    entry!("swm/FetchReachDict-v3", REACH, Sparse, Parted, "FetchReach, observed in three parts", REACHERS),
    entry!("swm/FetchPush-v3", PUSH, Sparse, Flat, "push a block to a place on the table", PUSHERS),
    entry!("swm/FetchPushDense-v3", PUSH, Dense, Flat, "FetchPush, rewarded by distance", PUSHERS),
    entry!("swm/FetchPushDict-v3", PUSH, Sparse, Parted, "FetchPush, observed in three parts", PUSHERS),
    entry!("swm/FetchSlide-v3", SLIDE, Sparse, Flat, "strike a puck, so that it slides to a place out of reach", SLIDERS),
    entry!("swm/FetchSlideDense-v3", SLIDE, Dense, Flat, "FetchSlide, rewarded by distance", SLIDERS),
    entry!("swm/FetchSlideDict-v3", SLIDE, Sparse, Parted, "FetchSlide, observed in three parts", SLIDERS),
    entry!("swm/FetchPickAndPlace-v3", PICK_AND_PLACE, Sparse, Flat, "pick a block and hold it at a place", PICKERS),
    entry!("swm/FetchPickAndPlaceDense-v3", PICK_AND_PLACE, Dense, Flat, "FetchPickAndPlace, rewarded by distance", PICKERS),
    entry!("swm/FetchPickAndPlaceDict-v3", PICK_AND_PLACE, Sparse, Parted, "FetchPickAndPlace, observed in three parts", PICKERS),
];

/// Makes one.
fn make(choice: &EnvChoice, kind: &'static Kind, reward: Reward, sight: Sight) -> Result<Box<dyn Env>> {
    let setup = kind.setup()?;
    let model = setup.model.clone();
    let known = known_len(kind.has_object());
    let everything = |n: usize, dtype| Space::uniform_box([n], dtype, f64::NEG_INFINITY, f64::INFINITY);
    let mut columns = vec![
        ColumnSpec::new("proprio", DType::Float64, [known]),
        ColumnSpec::new("goal_state", DType::Float64, [setup.qpos.len() + setup.qvel.len()]),
        ColumnSpec::new("achieved_goal", DType::Float64, [3]),
        ColumnSpec::new("desired_goal", DType::Float64, [3]),
    ];
    let observation_space = match sight {
        Sight::Flat => {
            columns.push(ColumnSpec::new("observation", DType::Float32, [known + 3]));
            vec![("observation", everything(known + 3, DType::Float32))]
        }
        Sight::Parted => {
            columns.push(ColumnSpec::new("observation", DType::Float64, [known]));
            vec![
                ("observation", everything(known, DType::Float64)),
                ("achieved_goal", everything(3, DType::Float64)),
                ("desired_goal", everything(3, DType::Float64)),
            ]
        }
    };
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([4], DType::Float32, -1.0, 1.0),
        columns,
        observation_space,
        variation_space: factors::variation_space(kind.has_object()),
        max_episode_steps: 50,
        cameras: vec![],
    };
    Ok(Box::new(World::new(spec, model, Fetch::new(kind, setup, reward, sight)?)?))
}
