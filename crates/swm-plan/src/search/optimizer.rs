//! [`Optimizer`]: turns gradients into steps, on plain arrays.
//!
//! Gradient descent with momentum, Adam (Kingma and Ba, *Adam: A Method for Stochastic Optimization*, 2015) and
//! `RMSProp` (Tieleman and Hinton, 2012), with the formulas and the defaults of `torch.optim`, which the reference
//! implementation uses. Every value is updated from its own gradient and memory only, so a step does not depend on
//! other values in the array.

use super::settings::Settings;
use serde::{Deserialize, Serialize};
use swm_core::Result;

/// Turns a gradient into a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum Optimizer {
    /// Gradient descent with momentum.
    Sgd(Sgd),
    /// Adam.
    Adam(Adam),
    /// `RMSProp`.
    RmsProp(RmsProp),
}

/// Gradient descent with momentum: `b ← μ b + g`, `x ← x - η b`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sgd {
    /// The step size, η.
    pub step: f32,
    /// The weight of the previous step, μ, at least 0 and below 1.
    pub momentum: f32,
}

impl Default for Sgd {
    fn default() -> Self {
        Self { step: 1.0, momentum: 0.0 }
    }
}

/// Adam: a step of the size η along the mean gradient divided by its root mean square.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Adam {
    /// The step size, η.
    pub step: f32,
    /// The decay rate of the mean gradient, β₁.
    pub beta1: f32,
    /// The decay rate of the mean squared gradient, β₂.
    pub beta2: f32,
    /// Added to the denominator, ε.
    pub epsilon: f32,
}

impl Default for Adam {
    fn default() -> Self {
        Self { step: 0.1, beta1: 0.9, beta2: 0.999, epsilon: 1e-8 }
    }
}

/// `RMSProp`: `v ← α v + (1 - α) g²`, `x ← x - η g / (√v + ε)`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RmsProp {
    /// The step size, η.
    pub step: f32,
    /// The decay rate of the mean squared gradient, α.
    pub decay: f32,
    /// Added to the denominator, ε.
    pub epsilon: f32,
}

impl Default for RmsProp {
    fn default() -> Self {
        Self { step: 0.01, decay: 0.99, epsilon: 1e-8 }
    }
}

/// The running means of an optimizer.
#[derive(Clone, Debug, Default)]
pub struct Memory {
    steps: i32,
    /// Momentum, or the mean gradient.
    first: Vec<f32>,
    /// The mean squared gradient.
    second: Vec<f32>,
}

impl Memory {
    /// The memory for `len` values before the first step.
    pub fn new(len: usize) -> Self {
        Self { steps: 0, first: vec![0.0; len], second: vec![0.0; len] }
    }

    /// Resets the memory to the state before the first step.
    pub fn clear(&mut self) {
        self.steps = 0;
        self.first.fill(0.0);
        self.second.fill(0.0);
    }
}

impl Optimizer {
    /// Moves `x` once against its gradient.
    ///
    /// # Shapes
    /// `x`, `gradient` and the memory have the same length.
    pub fn step(&self, memory: &mut Memory, x: &mut [f32], gradient: &[f32]) {
        memory.steps += 1;
        let moving = x.iter_mut().zip(gradient).zip(memory.first.iter_mut().zip(&mut memory.second));
        match *self {
            Self::Sgd(Sgd { step, momentum }) => moving.for_each(|((x, &g), (b, _))| {
                *b = momentum * *b + g;
                *x -= step * *b;
            }),
            Self::Adam(Adam { step, beta1, beta2, epsilon }) => {
                // Both means start at zero; these factors correct the bias (Kingma and Ba, section 3).
                let correction = |beta: f32| 1.0 - f64::from(beta).powi(memory.steps);
                let step = (f64::from(step) / correction(beta1)) as f32;
                let root = correction(beta2).sqrt() as f32;
                moving.for_each(|((x, &g), (mean, square))| {
                    *mean += (1.0 - beta1) * (g - *mean);
                    *square = beta2 * *square + (1.0 - beta2) * g * g;
                    *x -= step * *mean / (square.sqrt() / root + epsilon);
                });
            }
            Self::RmsProp(RmsProp { step, decay, epsilon }) => moving.for_each(|((x, &g), (_, square))| {
                *square = decay * *square + (1.0 - decay) * g * g;
                *x -= step * g / (square.sqrt() + epsilon);
            }),
        }
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// When a step size or ε is not a finite number above 0, or a decay rate is not at least 0 and below 1.
    pub fn check(&self, solver: &str) -> Result<()> {
        let (positive, decay): (&[_], &[_]) = match *self {
            Self::Sgd(Sgd { step, momentum }) => (&[("step", step)], &[("momentum", momentum)]),
            Self::Adam(Adam { step, beta1, beta2, epsilon }) => {
                (&[("step", step), ("epsilon", epsilon)], &[("beta1", beta1), ("beta2", beta2)])
            }
            Self::RmsProp(RmsProp { step, decay, epsilon }) => {
                (&[("step", step), ("epsilon", epsilon)], &[("decay", decay)])
            }
        };
        let owner = format!("{solver} optimizer,");
        let settings = Settings(&owner);
        positive.iter().try_for_each(|&(name, value)| settings.positive(name, value))?;
        decay.iter().try_for_each(|&(name, value)| settings.momentum(name, value))
    }
}

/// Scales every row whose norm exceeds `norm` down to that norm.
///
/// # Shapes
/// `gradient` is `[rows, width]`.
pub fn clip_norm(gradient: &mut [f32], width: usize, norm: f32) {
    for row in gradient.chunks_exact_mut(width) {
        let length = row.iter().map(|&g| f64::from(g).powi(2)).sum::<f64>().sqrt();
        if length > f64::from(norm) {
            let scale = (f64::from(norm) / length) as f32;
            row.iter_mut().for_each(|g| *g *= scale);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn optimizer_errors_name_the_invalid_setting() {
        let read = |json: &str| serde_json::from_str::<Optimizer>(json);
        let adam = read(r#"{"kind": "adam", "step": 0.2}"#).expect("parsing the optimizer");
        assert_eq!(adam, Optimizer::Adam(Adam { step: 0.2, ..Adam::default() }));
        assert_eq!(
            read(r#"{"kind": "rmsprop"}"#).expect("parsing the optimizer"),
            Optimizer::RmsProp(RmsProp::default())
        );
        let unknown = read(r#"{"kind": "adam", "momentum": 0.9}"#).expect_err("Adam has no momentum").to_string();
        assert!(unknown.contains("momentum"), "{unknown}");
        let message = |optimizer: Optimizer| optimizer.check("gd").expect_err("invalid settings").to_string();
        let sgd = message(Optimizer::Sgd(Sgd { momentum: 1.0, ..Sgd::default() }));
        assert_eq!(sgd, "gd optimizer, momentum: 1; choose a number of at least 0 and below 1");
        assert!(message(Optimizer::RmsProp(RmsProp { step: 0.0, ..RmsProp::default() })).contains("step: 0"));
        assert!(message(Optimizer::Adam(Adam { beta2: f32::NAN, ..Adam::default() })).contains("beta2: NaN"));
    }

    #[test]
    fn clip_norm_scales_rows_above_the_limit() {
        let mut gradient = [3.0, 4.0, 0.3, 0.4];
        clip_norm(&mut gradient, 2, 1.0);
        assert_eq!(gradient, [0.6, 0.8, 0.3, 0.4]);
    }
}
