//! [`InverseCheckpoint`]: an inverse-dynamics network and the world model whose encoder the network uses, in one run
//! folder. The files of the network have the layout of a [`Checkpoint`]; the world model's checkpoint is copied to
//! `world/`.

use super::InverseConfig;
use crate::checkpoint::{self, Checkpoint};
use crate::lewm::Lewm;
use crate::nn::{Init, Mlp, parameters};
use crate::run_folder::WORLD_MODEL;
use crate::stored::StoredCheckpoint;
use burn::tensor::Device;
use std::path::Path;
use swm_core::{Manifest, Result};

/// A trained inverse-dynamics policy.
#[derive(Clone, Debug)]
pub struct InverseCheckpoint {
    /// The world model whose encoder the network uses.
    pub world_model: Checkpoint<Lewm>,
    /// The network: from the concatenated latents of present and goal, `[rows, 2 * latent]`, to the actions of a model
    /// step in model units, `[rows, action_dim]`.
    pub model: Mlp,
    /// The training configuration.
    pub config: InverseConfig,
    /// The origin of the checkpoint; `hashes["weights"]` is the hash of the network, `hashes["encoder"]` is the hash of
    /// the world model.
    pub manifest: Manifest,
}

/// The family id of inverse dynamics.
pub(super) const FAMILY: &str = "inverse";

impl InverseCheckpoint {
    /// Returns the hash of the network's weights.
    pub fn hash(&self) -> &str {
        self.manifest.hashes.get("weights").map_or("", String::as_str)
    }

    /// Saves the checkpoint into the run folder `run` and returns the hash of the weights.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&mut self, run: &Path) -> Result<String> {
        self.world_model.save_to(&run.join(WORLD_MODEL))?;
        let env = &self.world_model.dataset_info.env;
        let description = serde_json::json!({"family": FAMILY, "env": env, "config": self.config});
        checkpoint::write(run, &description, &mut self.manifest, &parameters::values(&self.model), &[])
    }

    /// Loads a stored checkpoint.
    ///
    /// # Errors
    /// When the checkpoint is of another family, is damaged, or has weights that do not fit its configuration, or the
    /// folder does not hold the world model.
    pub fn load(stored: &StoredCheckpoint, device: &Device) -> Result<Self> {
        let config: InverseConfig = stored.config(FAMILY)?;
        let world_model = Checkpoint::<Lewm>::of(&stored.world_model()?, device)?;
        let expected = stored.manifest().hashes.get("encoder");
        if expected.is_some_and(|hash| hash != world_model.hash()) {
            let problem =
                format!("{WORLD_MODEL} is not the world model with which this network was trained: the hash differs");
            return Err(stored.broken(problem));
        }
        config.check()?;
        let (latent, action_dim) = (world_model.config.model.latent, world_model.action_dim());
        let create = |init: &Init| Ok(Mlp::new(init, 2 * latent, config.hidden, action_dim));
        let model = stored.model(create, device)?;
        Ok(Self { world_model, model, config, manifest: stored.manifest().clone() })
    }
}
