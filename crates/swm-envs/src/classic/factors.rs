//! The factors of variation of classic control: physical constants, and colours that replace the default colours.

use super::frame::Color;
use super::task::ControlTask;
use swm_core::{DType, Factor, FactorValues, Space, VariationSpace};

/// A factor `physics.<name>`: name, bounds and default.
pub struct PhysicsFactor(pub &'static str, pub [f32; 2], pub f32);

/// A factor `visuals.<name>`: name, bounds and default colour. Its value replaces the default colour in frames.
pub struct ColorFactor(pub &'static str, pub [f32; 2], pub [u8; 3]);

/// Returns the variation space with names, bounds, defaults and order of the reference, in single precision.
pub fn variation_space<T: ControlTask>() -> VariationSpace {
    let bounded =
        |shape, [low, high]: [f32; 2]| Space::uniform_box([shape], DType::Float32, f64::from(low), f64::from(high));
    let physics = T::PHYSICS_FACTORS.iter().map(|PhysicsFactor(name, bounds, default)| {
        Factor::new(&format!("physics.{name}"), bounded(1, *bounds), [f64::from(*default)])
    });
    let mut colors: Vec<Factor> = T::COLOR_FACTORS
        .iter()
        .map(|ColorFactor(name, bounds, default)| {
            Factor::new(
                &format!("visuals.{name}"),
                bounded(3, *bounds),
                default.map(|v| f64::from(f32::from(v) / 255.0)),
            )
        })
        .collect();
    colors.sort_by(|a, b| a.key.cmp(&b.key));
    VariationSpace::new(physics.chain(colors).collect(), &[])
}

/// Returns the values of [`ControlTask::PHYSICS_FACTORS`].
pub fn physics<T: ControlTask>(values: &FactorValues) -> Vec<f32> {
    values.iter().take(T::PHYSICS_FACTORS.len()).map(|(_, value)| value[0] as f32).collect()
}

/// Returns pairs of a default colour and the colour that replaces it, in the order of replacement.
pub fn color_swaps<T: ControlTask>(values: &FactorValues) -> Vec<(Color, Color)> {
    let byte = |intensity: f64| (intensity as f32 * 255.0 + 0.5) as u8;
    let target = |name| {
        let value = values.get(&format!("visuals.{name}"));
        Color::new([byte(value[0]), byte(value[1]), byte(value[2])])
    };
    T::COLOR_FACTORS.iter().map(|ColorFactor(name, _, default)| (Color::new(*default), target(name))).collect()
}
