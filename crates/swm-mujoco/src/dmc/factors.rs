//! The factors of variation that the worlds of the suite share. Names, bounds, defaults and order are the reference's.

use swm_core::{DType, Factor, Space};

/// A colour: red, green and blue from 0 to 1.
pub fn color(key: &str, default: [f64; 3]) -> Factor {
    Factor::new(key, Space::uniform_box([3], DType::Float64, 0.0, 1.0), default)
}

/// The colour of the body that acts, in most worlds.
pub fn agent_color() -> Factor {
    color("agent.color", [0.7, 0.5, 0.3])
}

/// A density in kg/m³.
pub fn density(key: &str) -> Factor {
    number(key, 500.0, 1500.0, 1000.0)
}

/// One number in single precision.
pub fn number(key: &str, low: f32, high: f32, default: f32) -> Factor {
    Factor::new(key, Space::uniform_box([1], DType::Float32, low.into(), high.into()), [f64::from(default)])
}

/// One of two.
pub fn choice(key: &str, default: u8) -> Factor {
    Factor::new(key, Space::Discrete { n: 2, start: 0 }, [f64::from(default)])
}

/// The two colours of the floor's squares.
pub fn floor_color() -> Factor {
    let squares = [0.1, 0.2, 0.3, 0.2, 0.3, 0.4];
    Factor::new("floor.color", Space::uniform_box([2, 3], DType::Float64, 0.0, 1.0), squares)
}

/// The floor's sliding friction.
pub fn floor_friction() -> Factor {
    number("floor.friction", 0.0, 1.0, 1.0)
}

/// How the floor is tilted about the y-axis, in degrees.
pub fn floor_rotation() -> Factor {
    Factor::new("floor.rotation_y", Space::uniform_box([1], DType::Float64, -10.0, 10.0), [0.0])
}

/// The pull of gravity, in m/s².
pub fn gravity() -> [Factor; 3] {
    let pull = |axis, low, high, default: f64| {
        Factor::new(&format!("gravity.{axis}"), Space::uniform_box([1], DType::Float64, low, high), [default])
    };
    [pull("x", -5.0, 5.0, 0.0), pull("y", -5.0, 5.0, 0.0), pull("z", -20.0, 0.0, -9.81)]
}

/// How bright the lamp is.
pub fn light() -> Factor {
    Factor::new("light.intensity", Space::uniform_box([1], DType::Float64, 0.0, 1.0), [0.7])
}

/// Whether the target is seen, in worlds that can hide it.
pub fn render_target() -> Factor {
    choice("rendering.render_target", 0)
}

/// The target's colour, and its shape: a box (0) or a sphere (1).
pub fn target() -> [Factor; 2] {
    [color("target.color", [0.6, 0.3, 0.3]), choice("target.shape", 1)]
}
