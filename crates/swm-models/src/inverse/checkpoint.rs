//! [`InverseCheckpoint`]: an inverse-dynamics network and the world model whose encoder the network uses, in one run
//! folder. The files of the network have the layout of a [`Checkpoint`]; the world model's checkpoint is copied to
//! `world/`.

use super::InverseConfig;
use crate::checkpoint::{self, Checkpoint};
use crate::lewm::Lewm;
use crate::nn::{Init, Mlp, parameters};
use crate::run_folder::{WEIGHTS, WORLD_MODEL};
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

    /// Loads the checkpoint of a run folder.
    ///
    /// # Errors
    /// When the folder holds no checkpoint, or the checkpoint is of another family, is damaged, or has weights that
    /// do not fit its configuration.
    pub fn load(run: &Path, device: &Device) -> Result<Self> {
        let stored = checkpoint::StoredCheckpoint::<InverseConfig>::read(run, FAMILY)?;
        let world_model = Checkpoint::<Lewm>::load(&run.join(WORLD_MODEL), device)?;
        let config = stored.config;
        config.check()?;
        let (latent, action_dim) = (world_model.config.model.latent, world_model.action_dim());
        let path = stored.folder.join(WEIGHTS);
        let create = |init: &Init| Ok(Mlp::new(init, 2 * latent, config.hidden, action_dim));
        let model = checkpoint::load_weights(create, &path, stored.manifest.hashes.get("weights"), device)?;
        Ok(Self { world_model, model, config, manifest: stored.manifest })
    }
}
