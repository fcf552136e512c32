//! The factors of variation of the maze, their constraints, and the walls and discs that they describe.

use super::physics::{Layout, MAX_WALLS, SIZE, Wall};
use super::render::Disc;
use crate::point_agent::position;
use swm_core::{DType, Factor, FactorValues, Space, VariationSpace};

/// The default walls, which the reference draws once from a fixed seed: least corner and size of each.
#[rustfmt::skip]
const WALLS: [[[f32; 2]; 2]; MAX_WALLS] = [
    [[1.035_264_5, 3.455_474_9], [1.289_385_2, 0.840_687_3]],
    [[3.002_354_6, 3.442_296_5], [1.244_401_8, 1.042_815_8]],
    [[1.534_523_5, 2.916_535_6], [0.659_792_54, 1.363_933_2]],
    [[2.142_178_5, 2.783_088  ], [1.112_480_2, 1.099_487_4]],
    [[1.260_334_3, 3.453_317_9], [0.963_911_95, 0.616_462_47]],
    [[1.504_300_8, 2.397_299_3], [0.714_128_6, 0.655_603_7]],
];

/// Returns the variation space, with names, bounds, defaults, order and constraints of the reference.
pub fn variation_space() -> VariationSpace {
    let single = |v: f32| f64::from(v);
    let color = |key, default: [f64; 3]| Factor::new(key, Space::Rgb, default);
    let scalar = |key, low: f32, high: f32, default: f32| {
        Factor::new(key, Space::uniform_box([], DType::Float32, single(low), single(high)), [single(default)])
    };
    let position =
        |key, default: [f64; 2]| Factor::new(key, Space::uniform_box([2], DType::Float32, 0.0, single(SIZE)), default);
    // `part` selects the corner (0) or the size (1) of the default walls.
    let walls = |key, low, high, part: usize| {
        let space = Space::uniform_box([MAX_WALLS, 2], DType::Float32, low, high);
        Factor::new(key, space, WALLS.map(|wall| wall[part].map(single)).concat())
    };
    VariationSpace::new(
        vec![
            color("agent.color", [255.0, 0.0, 0.0]),
            position("agent.position", [0.5, 0.5]),
            scalar("agent.radius", 0.05, 0.5, 0.1),
            scalar("agent.speed", 0.05, 2.0, 1.0),
            color("goal.color", [0.0, 255.0, 0.0]),
            position("goal.position", [4.5, 4.5]),
            scalar("goal.radius", 0.05, 0.5, 0.2),
            Factor::new("walls.number", Space::Discrete { n: 3, start: 4 }, [5.0]),
            color("walls.color", [0.0; 3]),
            walls("walls.shape", 0.5, 1.5, 1),
            walls("walls.positions", 0.0, single(SIZE), 0),
            color("background.color", [255.0; 3]),
        ],
        &["agent.position"],
    )
    .constrain("agent.position", "the agent touches no wall", |values| fits(values, "agent"))
    .constrain("goal.position", "the goal touches no wall", |values| fits(values, "goal"))
    .constrain("walls.positions", "walls are inside the square and touch neither agent nor goal", |values| {
        let inside = |wall: &Wall| wall.high.iter().all(|&v| v <= SIZE);
        layout(values).walls().iter().all(inside) && fits(values, "agent") && fits(values, "goal")
    })
}

/// Returns whether the disc of the `agent` or of the `goal` touches no wall.
pub fn fits(factors: &FactorValues, name: &str) -> bool {
    let (center, radius) = match name {
        "agent" => ("agent.position", "agent.radius"),
        _ => ("goal.position", "goal.radius"),
    };
    !layout(factors).touches(position(factors.get(center)), single(factors, radius))
}

fn single(factors: &FactorValues, key: &str) -> f32 {
    factors.scalar(key) as f32
}

/// Returns the layout that the factors describe.
pub fn layout(factors: &FactorValues) -> Layout {
    let pairs = |key| factors.get(key).as_chunks::<2>().0.iter().map(|pair| position(pair));
    let count = usize::try_from(factors.integer("walls.number")).unwrap_or(0);
    let walls = pairs("walls.positions").zip(pairs("walls.shape")).take(count);
    let walls = walls.map(|(low, size)| Wall { low, high: [low[0] + size[0], low[1] + size[1]] });
    Layout::new(single(factors, "agent.radius"), single(factors, "agent.speed"), walls)
}

/// Returns the disc of the `agent` or of the `goal`, at the position that the factors give.
pub fn disc(factors: &FactorValues, name: &str) -> Disc {
    Disc {
        center: position(factors.get(&format!("{name}.position"))),
        radius: single(factors, &format!("{name}.radius")),
        color: factors.rgb(&format!("{name}.color")),
    }
}
