//! The factors of variation shared by the domains. Names, bounds, defaults and order are those of the reference.

use swm_core::{DType, Factor, Space};

/// A factor for an RGB colour, each channel from 0 to 1.
pub fn color(key: &str, default: [f64; 3]) -> Factor {
    Factor::new(key, Space::uniform_box([3], DType::Float64, 0.0, 1.0), default)
}

/// The factor for the colour of the agent's body, with the default of most domains.
pub fn agent_color() -> Factor {
    color("agent.color", [0.7, 0.5, 0.3])
}

/// A factor for the density of a geom, in kg/m³.
pub fn density(key: &str) -> Factor {
    scalar(key, 500.0, 1500.0, 1000.0)
}

/// A scalar factor in single precision.
pub fn scalar(key: &str, low: f32, high: f32, default: f32) -> Factor {
    Factor::new(key, Space::uniform_box([1], DType::Float32, low.into(), high.into()), [f64::from(default)])
}

/// A factor with the values 0 and 1.
pub fn binary(key: &str, default: u8) -> Factor {
    Factor::new(key, Space::Discrete { n: 2, start: 0 }, [f64::from(default)])
}

/// The factor for the two colours of the checkered floor.
pub fn floor_color() -> Factor {
    let squares = [0.1, 0.2, 0.3, 0.2, 0.3, 0.4];
    Factor::new("floor.color", Space::uniform_box([2, 3], DType::Float64, 0.0, 1.0), squares)
}

/// The factor for the sliding friction coefficient of the floor.
pub fn floor_friction() -> Factor {
    scalar("floor.friction", 0.0, 1.0, 1.0)
}

/// The factor for the tilt of the floor about the y-axis, in degrees.
pub fn floor_rotation() -> Factor {
    Factor::new("floor.rotation_y", Space::uniform_box([1], DType::Float64, -10.0, 10.0), [0.0])
}

/// The factors for the acceleration of gravity along each axis, in m/s².
pub fn gravity() -> [Factor; 3] {
    let axis = |axis, low, high, default: f64| {
        Factor::new(&format!("gravity.{axis}"), Space::uniform_box([1], DType::Float64, low, high), [default])
    };
    [axis("x", -5.0, 5.0, 0.0), axis("y", -5.0, 5.0, 0.0), axis("z", -20.0, 0.0, -9.81)]
}

/// The factor for the intensity of the light, from 0 to 1.
pub fn light() -> Factor {
    Factor::new("light.intensity", Space::uniform_box([1], DType::Float64, 0.0, 1.0), [0.7])
}

/// The factor for rendering the target, in domains where it is hidden by default.
pub fn render_target() -> Factor {
    binary("rendering.render_target", 0)
}

/// The factors for the target's colour and shape: box (0) or sphere (1).
pub fn target() -> [Factor; 2] {
    [color("target.color", [0.6, 0.3, 0.3]), binary("target.shape", 1)]
}
