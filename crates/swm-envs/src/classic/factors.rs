//! The factors of variation that all worlds of classic control have: numbers of the physics, and colours that are
//! swapped for those the picture is drawn in.

use super::World;
use super::picture::Color;
use swm_core::{DType, Factor, FactorValues, Space, VariationSpace};

/// A factor `physics.<name>`: its name, bounds and default.
pub struct Parameter(pub &'static str, pub [f32; 2], pub f32);

/// A factor `visuals.<name>`: its name, bounds, and the colour of the drawing that it replaces, which is its default.
pub struct Paint(pub &'static str, pub [f32; 2], pub [u8; 3]);

/// Names, bounds, defaults and order are the reference's; all are single precision.
pub fn space<W: World>() -> VariationSpace {
    let bounded =
        |shape, [low, high]: [f32; 2]| Space::uniform_box([shape], DType::Float32, f64::from(low), f64::from(high));
    let physics = W::PHYSICS.iter().map(|Parameter(name, bounds, default)| {
        Factor::new(&format!("physics.{name}"), bounded(1, *bounds), [f64::from(*default)])
    });
    let mut visuals: Vec<Factor> = W::VISUALS
        .iter()
        .map(|Paint(name, bounds, drawn)| {
            Factor::new(&format!("visuals.{name}"), bounded(3, *bounds), drawn.map(|v| f64::from(f32::from(v) / 255.0)))
        })
        .collect();
    visuals.sort_by(|a, b| a.key.cmp(&b.key));
    VariationSpace::new(physics.chain(visuals).collect(), &[])
}

/// The values of [`World::PHYSICS`].
#[allow(clippy::cast_possible_truncation)]
pub fn physics<W: World>(values: &FactorValues) -> Vec<f32> {
    values.iter().take(W::PHYSICS.len()).map(|(_, value)| value[0] as f32).collect()
}

/// What the colours of the drawing become.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn swaps<W: World>(values: &FactorValues) -> Vec<(Color, Color)> {
    let byte = |share: f64| (share as f32 * 255.0 + 0.5) as u8;
    let target = |name| {
        let value = values.get(&format!("visuals.{name}"));
        Color::new([byte(value[0]), byte(value[1]), byte(value[2])])
    };
    W::VISUALS.iter().map(|Paint(name, _, drawn)| (Color::new(*drawn), target(name))).collect()
}
