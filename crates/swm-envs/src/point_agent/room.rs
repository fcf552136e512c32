//! The 224-pixel room that Two-Room and Piecewise have in common: constants, columns, factors and the target disc.
//!
//! Constants are those of the reference (`two_room/env.py`, `piecewise/piecewise_env.py`). Lengths are in pixels of the
//! 224-pixel frame, x to the right, y down.

use super::position::{Position, position};
use crate::draw::SoftDisc;
use swm_core::columns::{GOAL_STATE, PROPRIO, STATE};
use swm_core::{ColumnSpec, DType, EnvSpec, Factor, FactorValues, RowMut, Space, VariationSpace};

/// Side of the square environment, in pixels.
pub const SIZE: f64 = 224.0;
/// Width of the border that the agent cannot enter, on every side, in pixels.
pub const BORDER: f64 = 14.0;
/// Width of the lines drawn around the room, whose inner edges are those of the border, in pixels.
pub const LINE: f64 = 4.0;
/// The distance to the target below which the episode terminates, in pixels.
pub const GOAL_RADIUS: f32 = 16.0;
/// The maximal number of candidates drawn for a sampled goal.
pub const GOAL_TRIES: usize = 256;

/// Indices of the columns of [`spec`].
mod index {
    pub const STATE: usize = 0;
    pub const PROPRIO: usize = 1;
    pub const GOAL_STATE: usize = 2;
    pub const DISTANCE: usize = 3;
    pub const OBSERVATION: usize = 4;
    pub const PRIVILEGED: usize = 5;
}

/// Describes an environment in the room: an `observation` of `observation_len` values, and a column `privileged`, given
/// as name and length, with the values that the experts read.
pub fn spec(id: &str, observation_len: usize, privileged: (&str, usize), variation_space: VariationSpace) -> EnvSpec {
    let column = |name: &str, len: usize| ColumnSpec::new(name, DType::Float32, [len]);
    EnvSpec {
        id: id.to_owned(),
        action_space: Space::uniform_box([2], DType::Float32, -1.0, 1.0),
        columns: vec![
            column(STATE, 2),
            column(PROPRIO, 2),
            column(GOAL_STATE, 2),
            ColumnSpec::new("distance_to_target", DType::Float32, []),
            column("observation", observation_len),
            column(privileged.0, privileged.1),
        ],
        observation_space: vec![("observation", Space::uniform_box([observation_len], DType::Float32, 0.0, SIZE))],
        variation_space,
        max_episode_steps: 100,
        cameras: vec![],
        angles: vec![],
    }
}

/// Writes the columns of [`spec`].
pub fn observe(agent: Position, goal: Position, observation: &[f32], privileged: &[f32], row: &mut RowMut<'_>) {
    row.set(index::STATE, &agent);
    row.set(index::PROPRIO, &agent);
    row.set(index::GOAL_STATE, &goal);
    row.set(index::DISTANCE, &[distance(agent, goal)]);
    row.set(index::OBSERVATION, observation);
    row.set(index::PRIVILEGED, privileged);
}

/// Returns the Euclidean distance between two positions, in pixels.
///
/// It is computed in single precision with a fused sum of squares, because the reference decides termination with
/// `torch.norm`, which rounds this way.
pub fn distance(a: Position, b: Position) -> f32 {
    let [dx, dy] = [a[0] - b[0], a[1] - b[1]];
    dy.mul_add(dy, dx * dx).sqrt()
}

/// Returns the least and the greatest coordinate of the centre of an agent of this radius, in pixels.
pub fn reach(radius: f64) -> [f64; 2] {
    [BORDER + radius, SIZE - BORDER - radius]
}

/// Returns the target's disc, or `None` when the factor `rendering.render_target` hides it.
pub fn target_disc(factors: &FactorValues) -> Option<SoftDisc> {
    (factors.integer("rendering.render_target") == 1).then(|| SoftDisc {
        center: position(factors.get("target.position")),
        radius: factors.scalar("target.radius"),
        color: factors.rgb("target.color"),
    })
}

/// A colour factor.
pub fn color(key: &str, default: [f64; 3]) -> Factor {
    Factor::new(key, Space::Rgb, default)
}

/// A single-precision factor with bounds.
pub fn scalar(key: &str, low: f64, high: f64, default: f64) -> Factor {
    Factor::new(key, Space::uniform_box([1], DType::Float32, low, high), [default])
}

/// A factor that is a position within the border, in pixels.
pub fn position_factor(key: &str, default: [f64; 2]) -> Factor {
    Factor::new(key, Space::uniform_box([2], DType::Float32, BORDER, SIZE - BORDER - 1.0), default)
}

/// A factor with `n` integer values from `start` on.
pub fn choice(key: &str, n: i64, start: i64, default: f64) -> Factor {
    Factor::new(key, Space::Discrete { n, start }, [default])
}
