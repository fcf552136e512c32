//! [`InverseCheckpoint`]: the network and the world model whose encoder it was trained on, in one run folder. The
//! network's files lie where those of any checkpoint lie; the world model's checkpoint is a copy in `world/`.

use super::InverseConfig;
use crate::checkpoint::{self, Checkpoint};
use crate::lewm::Lewm;
use crate::nn::{Init, Mlp, parameters};
use burn::tensor::Device;
use std::path::Path;
use swm_core::{Key, Manifest, Result};

/// A trained inverse-dynamics policy.
#[derive(Clone, Debug)]
pub struct InverseCheckpoint {
    /// The world model whose encoder it sees through.
    pub world: Checkpoint<Lewm>,
    /// The network: from the latents of present and goal, beside each other, to the actions of a model step in model units.
    pub model: Mlp,
    /// How it was trained.
    pub config: InverseConfig,
    /// Where it came from; `hashes["weights"]` names the network, `hashes["encoder"]` the world model.
    pub manifest: Manifest,
}

/// The family its checkpoints name.
pub(super) const FAMILY: &str = "inverse";
const WORLD: &str = "world";

impl InverseCheckpoint {
    /// The hash of the network's weights.
    pub fn hash(&self) -> &str {
        self.manifest.hashes.get("weights").map_or("", String::as_str)
    }

    /// Saves into the run folder `run`. Returns the hash of the weights.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn save(&mut self, run: &Path) -> Result<String> {
        self.world.save_to(&run.join(WORLD))?;
        let card = serde_json::json!({"family": FAMILY, "env": self.world.dataset_info.env, "config": self.config});
        checkpoint::install(run, &card, &mut self.manifest, &parameters::values(&self.model), &[])
    }

    /// Loads the checkpoint of a run folder.
    ///
    /// # Errors
    /// When there is none, it is of another family, it is damaged, or its weights do not fit its configuration.
    pub fn load(run: &Path, device: &Device) -> Result<Self> {
        let stored = checkpoint::Stored::<InverseConfig>::read(run, FAMILY)?;
        let world = Checkpoint::<Lewm>::load(&run.join(WORLD), device)?;
        let config = stored.config;
        let actions = world.actions();
        let model = Mlp::new(&Init::new(Key::new(0), device), 2 * world.config.model.latent, config.hidden, actions);
        let model =
            checkpoint::fill(model, &stored.folder.join("weights.safetensors"), stored.manifest.hashes.get("weights"))?;
        Ok(Self { world, model, config, manifest: stored.manifest })
    }
}
