//! Published checkpoints: the reference's configuration, whose weights carry our names already.

use super::config::{Encoding, LossConfig, PIXELS, Tdmpc2Config};
use super::model::Tdmpc2;
use crate::nn::parameters::{self, HostTensor};
use crate::nn::{Bins, Named};
use burn::tensor::Device;
use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use std::collections::BTreeMap;
use std::fmt;
use swm_core::{Error, Key, Result};

/// A configuration as the reference writes it.
#[derive(serde::Deserialize)]
pub struct Published {
    action_dim: usize,
    #[serde(default)]
    extra_dims: BTreeMap<String, usize>,
    #[serde(default)]
    image_size: usize,
    wm: World,
}

/// Defaults are the reference's.
#[derive(serde::Deserialize)]
#[serde(default)]
struct World {
    encoding: InOrder,
    enc_dim: usize,
    mlp_dim: usize,
    num_bins: usize,
    vmin: f64,
    vmax: f64,
    num_q: usize,
    simnorm_dim: usize,
    tau: f64,
    rho: f64,
    discount: f64,
    uncertainty_penalty: f64,
    entropy_coef: f64,
    consistency_coef: f64,
    reward_coef: f64,
    value_coef: f64,
}

impl Default for World {
    fn default() -> Self {
        Self {
            encoding: InOrder(vec![]),
            enc_dim: 256,
            mlp_dim: 512,
            num_bins: 101,
            vmin: -10.0,
            vmax: 10.0,
            num_q: 5,
            simnorm_dim: 8,
            tau: 0.01,
            rho: 0.5,
            discount: 0.99,
            uncertainty_penalty: 0.5,
            entropy_coef: 1e-4,
            consistency_coef: 20.0,
            reward_coef: 0.1,
            value_coef: 0.1,
        }
    }
}

/// The entries of a JSON object as they are written: parts of a latent follow in that order.
struct InOrder(Vec<(String, usize)>);

impl<'de> Deserialize<'de> for InOrder {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        struct Entries;
        impl<'de> Visitor<'de> for Entries {
            type Value = InOrder;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("numbers by column")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<InOrder, A::Error> {
                let mut entries = vec![];
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(InOrder(entries))
            }
        }
        deserializer.deserialize_map(Entries)
    }
}

impl Published {
    /// Reads the JSON of a configuration.
    ///
    /// # Errors
    /// When it is no configuration of a TD-MPC2.
    pub fn read(json: &str) -> Result<Self> {
        serde_json::from_str(json).map_err(|error| {
            Error::config(
                "the configuration of a published TD-MPC2",
                error.to_string(),
                "give the reference's config.json",
            )
        })
    }

    /// The same sizes.
    pub fn model(&self) -> Tdmpc2Config {
        let World { encoding, enc_dim, mlp_dim, num_bins, vmin, vmax, num_q, simnorm_dim, .. } = &self.wm;
        // Pictures come first in a latent, wherever they are named.
        let (seen, read): (Vec<_>, Vec<_>) = encoding.0.iter().partition(|(column, _)| column == PIXELS);
        let part = |(column, latent): &(String, usize)| Encoding { column: column.clone(), latent: *latent };
        Tdmpc2Config {
            encoding: seen.into_iter().chain(read).map(part).collect(),
            image: self.image_size,
            encoder: *enc_dim,
            hidden: *mlp_dim,
            simplex: *simnorm_dim,
            bins: Bins { count: *num_bins, low: *vmin, high: *vmax },
            critics: *num_q,
            dropout: 0.01,
            termination: false,
        }
    }

    /// The same loss.
    pub fn loss(&self) -> LossConfig {
        LossConfig {
            discount: self.wm.discount,
            rho: self.wm.rho,
            tau: self.wm.tau,
            consistency: self.wm.consistency_coef,
            reward: self.wm.reward_coef,
            value: self.wm.value_coef,
            entropy: self.wm.entropy_coef,
            termination: 0.0,
            uncertainty: self.wm.uncertainty_penalty,
        }
    }

    /// The model with published weights.
    ///
    /// # Errors
    /// When a column's width is not said, or a weight is missing, of another shape, or one too many.
    pub fn with(&self, weights: &Named<HostTensor>, device: &Device) -> Result<Tdmpc2> {
        let config = self.model();
        config.check()?;
        let width = |part: &Encoding| {
            self.extra_dims.get(&part.column).copied().ok_or_else(|| {
                let fix = "name it there with the numbers it has";
                Error::config("extra_dims", format!("the column '{}' is not in it", part.column), fix)
            })
        };
        let widths: Vec<usize> = config.numbers().map(width).collect::<Result<_>>()?;
        let model = Tdmpc2::init(&config, &widths, self.action_dim, Key::new(0), device);
        let shapes = parameters::shapes(&model);
        for (name, shape) in &shapes {
            let given = weights.get(name).map(|weight| &weight.shape);
            if given != Some(shape) {
                let given = given.map_or("nothing".to_owned(), |shape| format!("{shape:?}"));
                return Err(Error::mismatch(
                    format!("loading '{name}' of a published TD-MPC2"),
                    given,
                    format!("{shape:?}"),
                ));
            }
        }
        match weights.keys().find(|name| !shapes.contains_key(*name)) {
            None => Ok(parameters::load(model, weights)),
            Some(name) => {
                let expected = "the weights that its configuration describes";
                Err(Error::mismatch("loading a published TD-MPC2", format!("a weight '{name}'"), expected))
            }
        }
    }
}
