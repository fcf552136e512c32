//! [`Tdmpc2Config`] and [`LossConfig`]: the model configuration of a TD-MPC2 and the settings of the loss.

use crate::nn::Bins;
use crate::train::{check_sizes, limits};
use serde::{Deserialize, Serialize};
use swm_core::columns::PIXELS;
use swm_core::{Error, Result};

/// The model configuration of a TD-MPC2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tdmpc2Config {
    /// The observed columns, in the order of their encodings in a latent; images come first.
    pub encoding: Vec<Encoding>,
    /// Side of the square input images in pixels; unused by a state-only model.
    pub image: usize,
    /// Hidden features of the encoder of a column.
    pub encoder: usize,
    /// Hidden features of all other networks.
    pub hidden: usize,
    /// Size of the groups of latent elements that sum to 1 (SimNorm).
    pub simplex: usize,
    /// Bins of rewards and values.
    pub bins: Bins,
    /// Number of Q functions.
    pub critics: usize,
    /// Dropout after the first linear layer of a Q function in training.
    pub dropout: f32,
    /// Whether terminations are predicted. The published models predict no terminations.
    pub termination: bool,
}

/// The encoding of an observed column.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Encoding {
    /// The column: `pixels`, or a numeric column.
    pub column: String,
    /// Number of latent elements that encode the column.
    pub latent: usize,
}

impl Tdmpc2Config {
    /// Returns the latent dimension.
    pub fn latent(&self) -> usize {
        self.encoding.iter().map(|encoding| encoding.latent).sum()
    }

    /// Returns the encoding of images, if images are observed.
    pub fn image_encoding(&self) -> Option<&Encoding> {
        self.encoding.iter().find(|encoding| encoding.column == PIXELS)
    }

    /// Returns the encodings of the columns other than images.
    pub fn column_encodings(&self) -> impl Iterator<Item = &Encoding> {
        self.encoding.iter().filter(|encoding| encoding.column != PIXELS)
    }

    /// Returns the names of the observed columns.
    pub fn columns(&self) -> Vec<String> {
        self.encoding.iter().map(|encoding| encoding.column.clone()).collect()
    }

    /// Checks the configuration.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        let Some(first) = self.encoding.first() else {
            let fix = "name a column, such as [{ column = \"state\", latent = 64 }]";
            return Err(Error::config("model.encoding", "nothing is observed", fix));
        };
        check_sizes(&[
            ("model.image", self.image, 0, limits::SIDE),
            ("model.encoder", self.encoder, 1, limits::FEATURES),
            ("model.hidden", self.hidden, 1, limits::FEATURES),
            ("model.simplex", self.simplex, 2, limits::FEATURES),
            ("model.bins.count", self.bins.count, 2, limits::FEATURES),
            ("model.critics", self.critics, 2, limits::LAYERS),
        ])?;
        for (i, encoding) in self.encoding.iter().enumerate() {
            check_sizes(&[("model.encoding.latent", encoding.latent, 1, limits::FEATURES)])?;
            if self.encoding[..i].iter().any(|other| other.column == encoding.column) {
                let given = format!("'{}' is observed twice", encoding.column);
                return Err(Error::config("model.encoding", given, "name every column once"));
            }
        }
        if self.image_encoding().is_some_and(|images| images != first) {
            return Err(Error::config("model.encoding", "'pixels' is not the first column", "list 'pixels' first"));
        }
        if self.image_encoding().is_some() {
            super::image_encoder::check(self.image)?;
        }
        if self.latent() == 0 || !self.latent().is_multiple_of(self.simplex) {
            let given = format!("latents of {} elements in groups of {}", self.latent(), self.simplex);
            return Err(Error::config(
                "model.simplex",
                given,
                "choose latent dimensions whose sum is a multiple of model.simplex",
            ));
        }
        if self.bins.low >= self.bins.high {
            let given = format!("from {} to {}", self.bins.low, self.bins.high);
            return Err(Error::config("model.bins", given, "choose a lower bound below the upper bound"));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return Err(Error::config("model.dropout", self.dropout.to_string(), "choose a rate below 1"));
        }
        Ok(())
    }
}

/// The weights and settings of the loss. `presets/tdmpc2/paper.toml` has the published values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Discount per step, γ.
    pub discount: f64,
    /// Weight of each further step of a clip relative to the step before, ρ.
    pub rho: f64,
    /// Update rate of target networks and of the running spread, τ.
    pub tau: f64,
    /// Weight of the latent prediction error.
    pub consistency: f64,
    /// Weight of the reward loss.
    pub reward: f64,
    /// Weight of the value loss.
    pub value: f64,
    /// Weight of the policy's entropy.
    pub entropy: f64,
    /// Weight of the termination loss, if terminations are predicted.
    pub termination: f64,
    /// Weight of the Q functions' standard deviation, which lowers the final value of a plan.
    pub uncertainty: f64,
}

impl LossConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        let fractions = [("loss.discount", self.discount), ("loss.rho", self.rho), ("loss.tau", self.tau)];
        for (what, value) in fractions {
            if !(value > 0.0 && value <= 1.0) {
                return Err(Error::config(what, value.to_string(), "choose a value above 0 and at most 1"));
            }
        }
        let weights = [
            ("loss.consistency", self.consistency),
            ("loss.reward", self.reward),
            ("loss.value", self.value),
            ("loss.entropy", self.entropy),
            ("loss.termination", self.termination),
            ("loss.uncertainty", self.uncertainty),
        ];
        match weights.into_iter().find(|(_, value)| !(value.is_finite() && *value >= 0.0)) {
            Some((what, value)) => Err(Error::config(what, value.to_string(), "choose a value of at least 0")),
            None => Ok(()),
        }
    }
}
