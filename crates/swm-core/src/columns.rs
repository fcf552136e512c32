//! Column names: constants for the standard columns, their indices in a schema, and the encodings of names.
//!
//! Other modules refer to standard columns by these constants, and encode and decode names by these functions, so that
//! a column has the same name in environments, datasets, models and reports.

use crate::{Result, Schema};

/// The frame of the default camera, `[height, width, 3]` bytes.
pub const PIXELS: &str = "pixels";
/// The frame of the goal, in the form of [`PIXELS`].
pub const GOAL: &str = "goal";
/// A depth image of the default camera, `[height, width]` of `Float32`, in metres.
pub const DEPTH: &str = "depth";
/// A segmentation image of the default camera, `[height, width]` of `Int32`.
pub const SEGMENTATION: &str = "segmentation";
/// The full state of the environment, in a layout that the environment defines.
pub const STATE: &str = "state";
/// The goal in the layout of [`STATE`].
pub const GOAL_STATE: &str = "goal_state";
/// The proprioceptive observation: the state of the agent's own body.
pub const PROPRIO: &str = "proprio";
/// The position of the agent, in environments that have other objects.
pub const POS_AGENT: &str = "pos_agent";
/// The goal in the layout of [`PROPRIO`].
pub const GOAL_PROPRIO: &str = "goal_proprio";
/// The action taken from the observation of the same row.
pub const ACTION: &str = "action";
/// The reward of the step.
pub const REWARD: &str = "reward";
/// Whether the step ended the episode by reaching a terminal state.
pub const TERMINATED: &str = "terminated";
/// Whether the step ended the episode by its time limit.
pub const TRUNCATED: &str = "truncated";
/// Whether the observation of the same row satisfies the goal.
pub const SUCCESS: &str = "success";
/// Steps since the start of the episode.
pub const STEP_IDX: &str = "step_idx";
/// The index of the episode in the dataset.
pub const EPISODE_IDX: &str = "episode_idx";
/// The reset seed of the episode, as [`split_seed`] stores it.
pub const EPISODE_SEED: &str = "episode_seed";
/// The index of the episode's policy in the mixture that the manifest lists.
pub const POLICY_INDEX: &str = "policy_index";
/// The reset seed of the episode as one integer, the form in which other programs store it.
pub const SEED: &str = "seed";

/// The prefix of factor columns under their full names.
const FACTOR: &str = "variation.";
/// The prefix of factor columns under their flat names.
const FLAT_FACTOR: &str = "variation_";
/// The prefix of a column that holds another column's value at the goal.
const OF_GOAL: &str = "goal_";

/// The indices of the standard columns in a schema.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ColumnIndices {
    /// The index of [`REWARD`].
    pub reward: usize,
    /// The index of [`TERMINATED`].
    pub terminated: usize,
    /// The index of [`TRUNCATED`].
    pub truncated: usize,
    /// The index of [`SUCCESS`].
    pub success: usize,
    /// The index of [`ACTION`]; absent from the infos of a pool.
    pub action: Option<usize>,
    /// The index of [`STEP_IDX`]; absent from collected episodes.
    pub step_idx: Option<usize>,
    /// The index of [`PIXELS`]; present if frames are rendered.
    pub pixels: Option<usize>,
    /// The index of [`GOAL`]; present if frames of the goal are rendered.
    pub goal: Option<usize>,
}

impl ColumnIndices {
    /// Looks the standard columns up in a schema.
    ///
    /// # Errors
    /// When `reward`, `terminated`, `truncated` or `success` is missing.
    pub fn of(schema: &Schema) -> Result<Self> {
        Ok(Self {
            reward: schema.index(REWARD)?,
            terminated: schema.index(TERMINATED)?,
            truncated: schema.index(TRUNCATED)?,
            success: schema.index(SUCCESS)?,
            action: schema.find(ACTION),
            step_idx: schema.find(STEP_IDX),
            pixels: schema.find(PIXELS),
            goal: schema.find(GOAL),
        })
    }
}

/// The flat form of a column name: `variation_agent_color` for `variation.agent.color`.
///
/// Formats that read a dot as a path into a structure store flat names, and environments read dataset rows of every
/// format under flat names.
pub fn flat(name: &str) -> String {
    name.replace('.', "_")
}

/// Whether `stored` is the full or the flat name of column `name`.
pub fn is_stored_as(name: &str, stored: &str) -> bool {
    stored == name || stored == flat(name)
}

/// The column of an environment's observation in a collected dataset: a `/`, which most formats cannot hold, becomes
/// `.`.
pub fn collected(name: &str) -> String {
    name.replace('/', ".")
}

/// The column of a factor of variation: `variation.agent.color` for `agent.color`.
pub fn factor(key: &str) -> String {
    format!("{FACTOR}{key}")
}

/// The [`flat`] column of a factor of variation: `variation_agent_color` for `agent.color`.
pub fn flat_factor(key: &str) -> String {
    flat(&factor(key))
}

/// Whether `name` is the [`flat`] name of a factor column.
pub fn is_flat_factor(name: &str) -> bool {
    name.starts_with(FLAT_FACTOR)
}

/// The column of a camera's images: `pixels`, `depth.CAMERA`, `segmentation`.
pub fn of_camera(modality: &str, camera: Option<&str>) -> String {
    match camera {
        None => modality.to_owned(),
        Some(camera) => format!("{modality}.{camera}"),
    }
}

/// The column that holds the value of column `name` at the goal: `goal_state` for `state`, `goal` for `pixels`.
pub fn of_goal(name: &str) -> String {
    if name == PIXELS { GOAL.to_owned() } else { format!("{OF_GOAL}{name}") }
}

/// The inverse of [`of_goal`]: `state` for `goal_state`, `pixels` for `goal`; `None` if `name` is not a goal column.
pub fn goal_source(name: &str) -> Option<&str> {
    if name == GOAL { Some(PIXELS) } else { name.strip_prefix(OF_GOAL) }
}

/// Bits of one element of [`EPISODE_SEED`]: `Float32`, in which formats may store it, holds integers up to 2^24.
const SEED_BITS: u32 = 21;

/// Splits a seed of at most 63 bits into the three elements of [`EPISODE_SEED`], the lowest bits first.
pub fn split_seed(seed: u64) -> [i32; 3] {
    [0, SEED_BITS, 2 * SEED_BITS].map(|shift| (seed >> shift & ((1 << SEED_BITS) - 1)) as i32)
}

/// Joins the elements of [`EPISODE_SEED`] to a seed: the inverse of [`split_seed`].
pub fn join_seed(elements: [f64; 3]) -> u64 {
    elements.iter().rev().fold(0, |seed, &element| seed << SEED_BITS | element as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ColumnSpec, DType};

    #[test]
    fn column_indices_are_those_of_the_schema() -> Result<()> {
        let names = [STATE, REWARD, TERMINATED, TRUNCATED, SUCCESS, STEP_IDX, PIXELS];
        let schema = Schema::new(names.map(|name| ColumnSpec::new(name, DType::U8, [])))?;
        let found = ColumnIndices::of(&schema)?;
        assert_eq!([found.reward, found.terminated, found.truncated, found.success], [1, 2, 3, 4]);
        assert_eq!([found.action, found.step_idx, found.pixels, found.goal], [None, Some(5), Some(6), None]);
        let error = ColumnIndices::of(&Schema::new(vec![])?).expect_err("a schema without a reward column").to_string();
        assert!(error.contains("reward"), "{error}");
        Ok(())
    }

    #[test]
    fn column_names_are_encoded_and_decoded() {
        assert_eq!(flat_factor("agent.color"), "variation_agent_color");
        assert_eq!(factor("agent.color"), "variation.agent.color");
        assert!(is_flat_factor("variation_agent_color") && !is_flat_factor("variation.agent.color"));
        assert!(is_stored_as("a.b", "a_b") && is_stored_as("a.b", "a.b") && !is_stored_as("a_b", "a.b"));
        assert_eq!(collected("joint/position"), "joint.position");
        assert_eq!(of_camera(DEPTH, Some("top")), "depth.top");
        for (name, goal) in [(STATE, GOAL_STATE), (PROPRIO, GOAL_PROPRIO), (PIXELS, GOAL)] {
            assert_eq!(of_goal(name), goal);
            assert_eq!(goal_source(goal), Some(name));
            assert_eq!(goal_source(name), None);
        }
    }

    #[test]
    fn split_seeds_are_exact_in_single_precision() {
        for seed in [0, 1, 0x1f_ffff, 1 << 42, u64::MAX >> 1] {
            assert_eq!(join_seed(split_seed(seed).map(|element| f64::from(element as f32))), seed);
        }
    }
}
