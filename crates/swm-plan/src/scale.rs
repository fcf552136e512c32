//! [`ActionScale`]: between the actions an environment takes and the normalised ones a model was trained on.

use swm_core::{EnvSpec, Error, Result, Space};

/// `model = (env - mean) / std`, number by number of one environment action.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ActionScale {
    /// The mean of each number, in environment units.
    pub mean: Vec<f32>,
    /// The standard deviation of each number, in environment units; above 0.
    pub std: Vec<f32>,
}

impl ActionScale {
    /// The scale of a model that sees an environment's own units. Integers are planned as choices, without a scale.
    pub fn unscaled(spec: &EnvSpec) -> Self {
        Self::identity(scaled_numbers(&spec.action_space))
    }

    /// The scale of a model that sees environment units.
    pub fn identity(dim: usize) -> Self {
        Self { mean: vec![0.0; dim], std: vec![1.0; dim] }
    }

    /// Numbers in one environment action.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// Writes the environment's version of one action in model units.
    pub fn to_env(&self, model: &[f32], env: &mut [f32]) {
        for (i, (to, &from)) in env.iter_mut().zip(model).enumerate() {
            *to = from * self.std[i] + self.mean[i];
        }
    }

    /// Writes the model's version of one action in environment units.
    pub fn to_model(&self, env: &[f32], model: &mut [f32]) {
        for (i, (to, &from)) in model.iter_mut().zip(env).enumerate() {
            *to = (from - self.mean[i]) / self.std[i];
        }
    }

    /// Checks the scale against an environment.
    ///
    /// # Errors
    /// When the scale has not one mean and one deviation for each number of a box (none for integers), a number of it is
    /// not finite, or a standard deviation is not above 0.
    pub fn check(&self, spec: &EnvSpec) -> Result<()> {
        let numbers = scaled_numbers(&spec.action_space);
        if self.mean.len() != numbers || self.std.len() != numbers {
            return Err(Error::mismatch(
                "the action scale of a plan",
                format!("{} means and {} deviations", self.mean.len(), self.std.len()),
                format!("{numbers} of each: the actions of {} are {}", spec.id, spec.action_space.describe()),
            ));
        }
        let fine = self.mean.iter().all(|v| v.is_finite()) && self.std.iter().all(|&v| v.is_finite() && v > 0.0);
        if fine {
            return Ok(());
        }
        Err(Error::config(
            "action scale",
            format!("mean {:?}, standard deviation {:?}", self.mean, self.std),
            "means must be finite and deviations above 0; take them from the training data",
        ))
    }

    /// The bounds of `block` actions in a row, in model units: low and high, `block * dim` numbers each.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn bounds(&self, space: &Space, block: usize) -> (Vec<f32>, Vec<f32>) {
        (0..block * self.dim())
            .map(|i| {
                let i = i % self.dim();
                let (low, high) = space.bounds(i);
                let scaled = |v: f64| ((v - f64::from(self.mean[i])) / f64::from(self.std[i])) as f32;
                (scaled(low), scaled(high))
            })
            .unzip()
    }
}

/// How many numbers of an action are scaled: all of a box, none of integers.
fn scaled_numbers(space: &Space) -> usize {
    match space {
        Space::Box { low, .. } => low.len(),
        Space::Discrete { .. } | Space::MultiDiscrete { .. } | Space::Rgb => 0,
    }
}
