//! Import and export of PLDM checkpoints of the reference implementation. These checkpoints hold the world model only;
//! import initialises the inverse dynamics with random weights.

use super::model::{Idm, Pldm};
use crate::checkpoint::Checkpoint;
use crate::lewm::import::{state, tree, world_model};
use crate::nn::Init;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::Naming;
use crate::weights::reference::{Reference, write};
use burn::tensor::Device;
use serde_json::json;
use std::path::Path;
use swm_core::{Key, Manifest, Result};

/// The Python module with the building blocks of the reference implementation's PLDM.
const MODULES: &str = "stable_worldmodel.wm.pldm.module";
const CLASS: &str = "stable_worldmodel.wm.pldm.pldm.PLDM";

/// Converts a PLDM of the reference implementation, as [`crate::lewm::import::import`] converts a LeWM.
///
/// # Errors
/// As [`crate::lewm::import::import`].
pub fn import(from: &Path, dataset_info: DatasetInfo) -> Result<Checkpoint<Pldm>> {
    let (model, sizes, frameskip) = world_model(Reference::open(from, "PLDM")?, &dataset_info)?;
    let mut config = TrainConfig::<Pldm>::load("paper", &[])?;
    config.data.num_steps = sizes.predictor.history + 1;
    config.data.frameskip = frameskip;
    let init = Init::new(Key::new(config.seed), &Device::flex()).of("idm");
    let idm = Idm::new(&init, sizes.latent, config.loss.idm_hidden, frameskip * dataset_info.action.dim());
    config.model = sizes;
    config.check()?;
    let manifest = Manifest::new("import", 0, json!({ "from": from.display().to_string() }));
    Ok(Checkpoint { model: Pldm { model, idm }, config, dataset_info, manifest })
}

/// Writes the `weights.pt` and `config.json` that `load_pretrained` of the reference implementation reads.
///
/// # Errors
/// As [`crate::lewm::import::export`].
pub fn export(checkpoint: &Checkpoint<Pldm>, folder: &Path, naming: Naming) -> Result<()> {
    let config = tree(&checkpoint.config.model, checkpoint.action_dim(), CLASS, MODULES)?;
    write(folder, &config, &state(&checkpoint.model.model, naming))
}
