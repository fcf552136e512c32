//! The factors of variation of Push-T, and the columns that Push-T writes.

use super::TABLE;
use super::shapes::BodyShape;
use std::f64::consts::{PI, TAU};
use swm_core::columns::{GOAL_PROPRIO, GOAL_STATE, POS_AGENT, PROPRIO, STATE};
use swm_core::{ColumnSpec, DType, Factor, FactorValues, Space, VariationSpace};

/// Every factor, in the reference's sampling order.
pub fn variation_space() -> VariationSpace {
    let pixels = |low: f64, high: f64| Space::uniform_box([2], DType::Float64, low, high);
    let angle = || Space::uniform_box([], DType::Float64, -TAU, TAU);
    let scale = || Space::uniform_box([], DType::Float32, 20.0, 60.0);
    VariationSpace::new(
        vec![
            Factor::new("background.color", Space::Rgb, [255.0, 255.0, 255.0]),
            Factor::new("goal.angle", angle(), [PI / 4.0]),
            Factor::new("goal.color", Space::Rgb, [144.0, 238.0, 144.0]),
            Factor::new("goal.position", pixels(50.0, 450.0), [256.0, 256.0]),
            Factor::new("goal.scale", scale(), [40.0]),
            Factor::new("block.angle", angle(), [0.0]),
            Factor::new("block.color", Space::Rgb, [119.0, 136.0, 153.0]),
            Factor::new("block.scale", scale(), [30.0]),
            Factor::new("block.shape", Space::Discrete { n: 7, start: 1 }, [2.0]),
            Factor::new("block.start_position", pixels(100.0, 400.0), [400.0, 100.0]),
            Factor::new("agent.angle", angle(), [0.0]),
            Factor::new("agent.color", Space::Rgb, [65.0, 105.0, 225.0]),
            Factor::new("agent.scale", scale(), [40.0]),
            Factor::new("agent.shape", Space::Discrete { n: 8, start: 0 }, [0.0]),
            Factor::new("agent.start_position", pixels(50.0, 450.0), [256.0, 400.0]),
            Factor::new("agent.velocity", pixels(0.0, TABLE), [0.0, 0.0]),
            Factor::new("rendering.render_goal", Space::Discrete { n: 2, start: 0 }, [1.0]),
        ],
        &["agent.start_position", "block.start_position", "block.angle"],
    )
}

/// Indices of [`columns`].
pub mod index {
    pub const STATE: usize = 0;
    pub const PROPRIO: usize = 1;
    pub const POS_AGENT: usize = 2;
    pub const VEL_AGENT: usize = 3;
    pub const BLOCK_POSE: usize = 4;
    pub const GOAL_POSE: usize = 5;
    pub const GOAL_STATE: usize = 6;
    pub const GOAL_PROPRIO: usize = 7;
    pub const N_CONTACTS: usize = 8;
    pub const SHAPES: usize = 9;
    pub const AGENT_POSE: usize = 10;
}

/// The columns that the environment writes, in order.
pub fn columns() -> Vec<ColumnSpec> {
    let column = |name: &str, len: usize| ColumnSpec::new(name, DType::Float64, [len]);
    vec![
        column(STATE, 7),
        column(PROPRIO, 4),
        column(POS_AGENT, 2),
        column("vel_agent", 2),
        column("block_pose", 3),
        column("goal_pose", 3),
        column(GOAL_STATE, 7),
        column(GOAL_PROPRIO, 4),
        ColumnSpec::new("n_contacts", DType::Int64, []),
        column("shapes", 4),
        column("agent_pose", 3),
    ]
}

/// The elements of [`columns`] that are angles.
pub const ANGLES: [(&str, usize); 5] =
    [(STATE, 4), ("block_pose", 2), ("goal_pose", 2), (GOAL_STATE, 4), ("agent_pose", 2)];

/// The observation columns with the reference's bounds. As in the reference, agents may leave the bounds.
pub fn observation_space() -> Vec<(&'static str, Space)> {
    let (side, speed) = (512.0, 512.0);
    let space = |low: &[f64], high: &[f64]| Space::Box {
        shape: vec![low.len()],
        dtype: DType::Float64,
        low: low.to_vec(),
        high: high.to_vec(),
    };
    vec![
        (PROPRIO, space(&[0.0, 0.0, -speed, -speed], &[side, side, speed, speed])),
        (STATE, space(&[0.0, 0.0, 0.0, 0.0, 0.0, -speed, -speed], &[side, side, side, side, TAU, speed, speed])),
    ]
}

/// The shape of the `agent` or of the `block`.
pub fn body_shape(factors: &FactorValues, name: &str) -> BodyShape {
    BodyShape::new(factors.integer(&format!("{name}.shape")), factors.scalar(&format!("{name}.scale")))
}

/// The `shapes` column: agent shape and scale, block shape and scale.
pub fn shapes_row(factors: &FactorValues) -> [f64; 4] {
    ["agent.shape", "agent.scale", "block.shape", "block.scale"].map(|key| factors.scalar(key))
}
