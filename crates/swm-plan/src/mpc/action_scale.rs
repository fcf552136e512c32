//! [`ActionScale`]: converts between an environment's actions and the normalised actions a model was trained on.

use swm_core::{EnvSpec, Error, Result, Space};

/// The normalisation `model = (env - mean) / std` of every dimension of an environment action.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ActionScale {
    /// The mean of each dimension, in environment units.
    pub mean: Vec<f32>,
    /// The standard deviation of each dimension, in environment units; above 0.
    pub std: Vec<f32>,
}

impl ActionScale {
    /// The scale of a model that uses an environment's own units. Integers are planned as choices, without a scale.
    pub fn unscaled(spec: &EnvSpec) -> Self {
        Self::identity(scaled_dim(&spec.action_space))
    }

    /// The scale of a model that uses environment units, for actions of `dim` dimensions.
    pub fn identity(dim: usize) -> Self {
        Self { mean: vec![0.0; dim], std: vec![1.0; dim] }
    }

    /// The dimension of an environment action.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// Converts an action from model units to environment units, both `[dim]`.
    pub fn to_env(&self, model: &[f32], env: &mut [f32]) {
        for (i, (to, &from)) in env.iter_mut().zip(model).enumerate() {
            *to = from * self.std[i] + self.mean[i];
        }
    }

    /// Converts an action from environment units to model units, both `[dim]`.
    pub fn to_model(&self, env: &[f32], model: &mut [f32]) {
        for (i, (to, &from)) in model.iter_mut().zip(env).enumerate() {
            *to = (from - self.mean[i]) / self.std[i];
        }
    }

    /// Checks the scale against an environment.
    ///
    /// # Errors
    /// When the scale does not have one mean and one standard deviation for each dimension of a box (none for
    /// integers), a value is not finite, or a standard deviation is not above 0.
    pub fn check(&self, spec: &EnvSpec) -> Result<()> {
        let dim = scaled_dim(&spec.action_space);
        if self.mean.len() != dim || self.std.len() != dim {
            return Err(Error::mismatch(
                "the action scale of a plan",
                format!("{} means and {} deviations", self.mean.len(), self.std.len()),
                format!("{dim} of each: the actions of {} are {}", spec.id, spec.action_space.describe()),
            ));
        }
        let valid = self.mean.iter().all(|v| v.is_finite()) && self.std.iter().all(|&v| v.is_finite() && v > 0.0);
        if valid {
            return Ok(());
        }
        Err(Error::config(
            "action scale",
            format!("mean {:?}, standard deviation {:?}", self.mean, self.std),
            "means must be finite and deviations above 0; take them from the training data",
        ))
    }

    /// The lower and upper bounds of `block` consecutive actions in model units, `[block * dim]` each.
    pub(super) fn bounds(&self, space: &Space, block: usize) -> (Vec<f32>, Vec<f32>) {
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

/// Returns the number of scaled dimensions of an action: every dimension of a box, 0 for integers.
fn scaled_dim(space: &Space) -> usize {
    match space {
        Space::Box { low, .. } => low.len(),
        Space::Discrete { .. } | Space::MultiDiscrete { .. } | Space::Rgb => 0,
    }
}
