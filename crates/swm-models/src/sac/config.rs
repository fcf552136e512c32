//! [`SacConfig`] and [`SacLoss`]: the model configuration of a SAC and the settings of the losses.

use crate::train::{check_sizes, limits};
use serde::{Deserialize, Serialize};
use swm_core::columns::PIXELS;
use swm_core::{Error, Result};

/// The model configuration of a SAC.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SacConfig {
    /// The observed columns, which are concatenated.
    pub columns: Vec<String>,
    /// Hidden features of both hidden layers of every network.
    pub hidden: usize,
}

impl SacConfig {
    /// Checks the configuration.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        check_sizes(&[("model.hidden", self.hidden, 1, limits::FEATURES)])?;
        if self.columns.is_empty() {
            return Err(Error::config("model.columns", "nothing is observed", "name a column, such as [\"state\"]"));
        }
        if self.columns.iter().any(|column| column == PIXELS) {
            return Err(Error::config(
                "model.columns",
                "'pixels' is a column of images",
                "name numeric columns, or train tdmpc2, which has an image encoder",
            ));
        }
        Ok(())
    }
}

/// The settings of the losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SacLoss {
    /// Discount per step, γ.
    pub discount: f64,
    /// Update rate of the target networks, τ.
    pub tau: f64,
    /// Target entropy per action element; -1 as published.
    pub entropy: f64,
    /// Initial temperature, α.
    pub temperature: f64,
}

impl SacLoss {
    /// Checks the settings.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        let positive = [("loss.discount", self.discount, 1.0), ("loss.tau", self.tau, 1.0)];
        let positive = positive.into_iter().chain([("loss.temperature", self.temperature, f64::MAX)]);
        for (what, value, most) in positive {
            if !(value > 0.0 && value <= most) {
                let fix = if most > 1.0 { "choose a value above 0" } else { "choose a value above 0 and at most 1" };
                return Err(Error::config(what, value.to_string(), fix));
            }
        }
        if !self.entropy.is_finite() {
            return Err(Error::config("loss.entropy", self.entropy.to_string(), "choose a finite value, such as -1"));
        }
        Ok(())
    }
}
