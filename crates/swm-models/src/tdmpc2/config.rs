//! The sizes of a TD-MPC2 and the settings of its loss.

use crate::nn::Bins;
use crate::train::config::at_least;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The column of pictures.
pub const PIXELS: &str = "pixels";

/// The sizes of a [`super::Tdmpc2`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tdmpc2Config {
    /// What it observes. The parts of a latent follow in this order, that of the pictures first.
    pub encoding: Vec<Encoding>,
    /// The side of the pictures, where it observes any.
    pub image: usize,
    /// Hidden features of an encoder of numbers.
    pub encoder: usize,
    /// Hidden features of everything else.
    pub hidden: usize,
    /// Numbers of a latent that add up to 1.
    pub simplex: usize,
    /// Bins of rewards and values.
    pub bins: Bins,
    /// Q functions.
    pub critics: usize,
    /// Dropout behind the first product of a Q function, in training.
    pub dropout: f32,
    /// Whether it predicts that an episode terminates. The published models do not.
    pub termination: bool,
}

/// What becomes of an observed column.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Encoding {
    /// The column: `pixels`, or one of numbers.
    pub column: String,
    /// Numbers of the latent it becomes.
    pub latent: usize,
}

impl Tdmpc2Config {
    /// Numbers of a latent.
    pub fn latent(&self) -> usize {
        self.encoding.iter().map(|part| part.latent).sum()
    }

    /// The part that comes from pictures.
    pub fn pictures(&self) -> Option<&Encoding> {
        self.encoding.iter().find(|part| part.column == PIXELS)
    }

    /// The parts that come from columns of numbers.
    pub fn numbers(&self) -> impl Iterator<Item = &Encoding> {
        self.encoding.iter().filter(|part| part.column != PIXELS)
    }

    /// The columns it observes.
    pub fn columns(&self) -> Vec<String> {
        self.encoding.iter().map(|part| part.column.clone()).collect()
    }

    /// Checks that the sizes fit each other.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        let Some(first) = self.encoding.first() else {
            let fix = "name a column, such as [{ column = \"state\", latent = 64 }]";
            return Err(Error::config("model.encoding", "nothing is observed", fix));
        };
        at_least(&[
            ("model.encoder", self.encoder, 1),
            ("model.hidden", self.hidden, 1),
            ("model.simplex", self.simplex, 1),
            ("model.bins.count", self.bins.count, 2),
            ("model.critics", self.critics, 2),
        ])?;
        for (i, part) in self.encoding.iter().enumerate() {
            if self.encoding[..i].iter().any(|other| other.column == part.column) {
                let given = format!("'{}' is observed twice", part.column);
                return Err(Error::config("model.encoding", given, "name every column once"));
            }
        }
        if self.pictures().is_some_and(|pictures| pictures != first) {
            return Err(Error::config("model.encoding", "'pixels' is not its first column", "move it to the front"));
        }
        if self.pictures().is_some() {
            super::eyes::check(self.image)?;
        }
        if self.latent() == 0 || !self.latent().is_multiple_of(self.simplex) {
            let given = format!("latents of {} numbers, {} of which add up to 1", self.latent(), self.simplex);
            return Err(Error::config("model.simplex", given, "choose latents that are a multiple of it"));
        }
        if self.bins.low >= self.bins.high {
            let given = format!("from {} to {}", self.bins.low, self.bins.high);
            return Err(Error::config("model.bins", given, "choose a lower bound below the upper one"));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return Err(Error::config("model.dropout", self.dropout.to_string(), "choose a rate below 1"));
        }
        Ok(())
    }
}

/// The weights and settings of the loss. Those of the publication are in `presets/tdmpc2/paper.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// What a reward one step later is worth, γ.
    pub discount: f64,
    /// How much less each further step of a clip weighs, ρ.
    pub rho: f64,
    /// The share of the new in target networks and running scale, τ.
    pub tau: f64,
    /// The weight of latents that differ from those of the frames to come.
    pub consistency: f64,
    /// The weight of rewards.
    pub reward: f64,
    /// The weight of values.
    pub value: f64,
    /// What entropy of the policy is worth.
    pub entropy: f64,
    /// The weight of terminations, where they are predicted.
    pub termination: f64,
    /// How much disagreement of the Q functions costs a plan, per unit of value.
    pub uncertainty: f64,
}

impl LossConfig {
    /// Checks that the settings make sense.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        let shares = [("loss.discount", self.discount), ("loss.rho", self.rho), ("loss.tau", self.tau)];
        for (what, value) in shares {
            if !(value > 0.0 && value <= 1.0) {
                return Err(Error::config(what, value.to_string(), "choose a number above 0, at most 1"));
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
            Some((what, value)) => Err(Error::config(what, value.to_string(), "choose a number of at least 0")),
            None => Ok(()),
        }
    }
}
