//! [`Predictor`]: latent predictions that can be compared with recorded trajectories.

use crate::{Batch, Result};

/// A model that encodes observations and predicts later latents from actions.
pub trait Predictor: Send {
    /// Returns the number of environment steps in a model step.
    fn frameskip(&self) -> usize;

    /// Returns the names of the observation columns that [`Predictor::encode`] reads.
    fn columns(&self) -> Vec<String>;

    /// Returns the dimension of a latent.
    fn latent_dim(&self) -> usize;

    /// Writes the latent of every row. A row's latent does not depend on the other rows.
    ///
    /// # Shapes
    /// `latents` is `[rows, latent]`.
    ///
    /// # Errors
    /// When the columns differ from the columns of the training data.
    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()>;

    /// Writes the predicted latents after each of `horizon` model steps. Actions are in the environment's units.
    ///
    /// # Shapes
    /// `start` is `[n, latent]`, `actions` is `[n, horizon, frameskip * action]`, `latents` is `[n, horizon, latent]`.
    ///
    /// # Errors
    /// When the actions do not fit the model.
    fn rollout(&mut self, start: &[f32], actions: &[f32], horizon: usize, latents: &mut [f32]) -> Result<()>;
}
