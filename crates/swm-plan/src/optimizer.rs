//! [`Optimizer`]: from gradients to steps, on plain arrays.
//!
//! Stochastic gradient descent with momentum, Adam (Kingma and Ba, *Adam: A Method for Stochastic Optimization*, 2015) and
//! `RMSProp` (Tieleman and Hinton, 2012), with the formulas and the defaults of `torch.optim`, whose classes the reference
//! hands its gradient solvers. Every number moves by its own gradient and memory alone, so a step does not depend on what
//! else is optimised in the same array.

use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// How a gradient becomes a step.
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
    /// How much of the last step is kept, μ, at least 0 and below 1.
    pub momentum: f32,
}

impl Default for Sgd {
    fn default() -> Self {
        Self { step: 1.0, momentum: 0.0 }
    }
}

/// Adam: steps of the size η in the direction of the mean gradient over its root mean square.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Adam {
    /// The step size, η.
    pub step: f32,
    /// How slowly the mean of the gradient forgets, β₁.
    pub beta1: f32,
    /// How slowly the mean of its square forgets, β₂.
    pub beta2: f32,
    /// What keeps the quotient finite, ε.
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
    /// How slowly the mean of the square forgets, α.
    pub decay: f32,
    /// What keeps the quotient finite, ε.
    pub epsilon: f32,
}

impl Default for RmsProp {
    fn default() -> Self {
        Self { step: 0.01, decay: 0.99, epsilon: 1e-8 }
    }
}

/// What an optimizer remembers of earlier gradients.
#[derive(Clone, Debug, Default)]
pub struct Memory {
    steps: i32,
    /// Momentum, or the mean gradient.
    first: Vec<f32>,
    /// The mean squared gradient.
    second: Vec<f32>,
}

impl Memory {
    /// Of `len` numbers that have not moved yet.
    pub fn new(len: usize) -> Self {
        Self { steps: 0, first: vec![0.0; len], second: vec![0.0; len] }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.steps = 0;
        self.first.fill(0.0);
        self.second.fill(0.0);
    }
}

impl Optimizer {
    /// Moves `x` once against its gradient; all three have equally many numbers.
    #[allow(clippy::cast_possible_truncation)]
    pub fn step(&self, memory: &mut Memory, x: &mut [f32], gradient: &[f32]) {
        memory.steps += 1;
        let moving = x.iter_mut().zip(gradient).zip(memory.first.iter_mut().zip(&mut memory.second));
        match *self {
            Self::Sgd(Sgd { step, momentum }) => moving.for_each(|((x, &g), (b, _))| {
                *b = momentum * *b + g;
                *x -= step * *b;
            }),
            Self::Adam(Adam { step, beta1, beta2, epsilon }) => {
                // Both means begin at zero; dividing by what is not zero any more corrects that.
                let begun = |beta: f32| 1.0 - f64::from(beta).powi(memory.steps);
                let step = (f64::from(step) / begun(beta1)) as f32;
                let root = begun(beta2).sqrt() as f32;
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

    /// Refuses settings of `solver` that make no sense.
    ///
    /// # Errors
    /// When a step size or ε is not a finite number above 0, or a share that is kept not in `0 ..= 1` without 1.
    pub fn check(&self, solver: &str) -> Result<()> {
        let (positive, shares) = match *self {
            Self::Sgd(Sgd { step, momentum }) => (vec![("step", step)], vec![("momentum", momentum)]),
            Self::Adam(Adam { step, beta1, beta2, epsilon }) => {
                (vec![("step", step), ("epsilon", epsilon)], vec![("beta1", beta1), ("beta2", beta2)])
            }
            Self::RmsProp(RmsProp { step, decay, epsilon }) => {
                (vec![("step", step), ("epsilon", epsilon)], vec![("decay", decay)])
            }
        };
        let wrong = |name: &str, value: f32, fix: &str| {
            Err(Error::config(format!("{solver} optimizer, {name}"), value.to_string(), fix))
        };
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return wrong(name, value, "choose a finite number above 0");
            }
        }
        for (name, value) in shares {
            if !(0.0..1.0).contains(&value) {
                return wrong(name, value, "choose a number of at least 0 and below 1");
            }
        }
        Ok(())
    }
}

/// Shortens every row of `width` numbers whose norm exceeds `norm` to that norm.
#[allow(clippy::cast_possible_truncation)]
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
    fn settings_are_named_and_checked() {
        let read = |json: &str| serde_json::from_str::<Optimizer>(json);
        let adam = read(r#"{"kind": "adam", "step": 0.2}"#).expect("an optimizer");
        assert_eq!(adam, Optimizer::Adam(Adam { step: 0.2, ..Adam::default() }));
        assert_eq!(read(r#"{"kind": "rmsprop"}"#).expect("an optimizer"), Optimizer::RmsProp(RmsProp::default()));
        let unknown = read(r#"{"kind": "adam", "momentum": 0.9}"#).expect_err("Adam has no momentum").to_string();
        assert!(unknown.contains("momentum"), "{unknown}");
        let message = |optimizer: Optimizer| optimizer.check("gd").expect_err("wrong").to_string();
        let sgd = message(Optimizer::Sgd(Sgd { momentum: 1.0, ..Sgd::default() }));
        assert_eq!(sgd, "gd optimizer, momentum: 1; choose a number of at least 0 and below 1");
        assert!(message(Optimizer::RmsProp(RmsProp { step: 0.0, ..RmsProp::default() })).contains("step: 0"));
        assert!(message(Optimizer::Adam(Adam { beta2: f32::NAN, ..Adam::default() })).contains("beta2: NaN"));
    }

    #[test]
    fn long_gradients_are_shortened_row_by_row() {
        let mut gradient = [3.0, 4.0, 0.3, 0.4];
        clip_norm(&mut gradient, 2, 1.0);
        assert_eq!(gradient, [0.6, 0.8, 0.3, 0.4]);
    }
}
