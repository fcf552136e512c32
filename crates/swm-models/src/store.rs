//! [`store`]: writes checkpoints that another program trained.

use crate::checkpoint::write;
use crate::nn::parameters::{HostTensor, Named};
use crate::registry::{FAMILIES, load_stored};
use crate::run_folder::{OPTIMIZER, RAW, STATE};
use crate::stored::{StoredCheckpoint, check_replaceable, write_unused};
use crate::tensor_file;
use crate::train::run_state::RunState;
use burn::tensor::Device;
use serde_json::Value;
use std::path::Path;
use swm_core::{Error, Manifest, Result, manifest};

/// The parts of a checkpoint that another program trained.
pub struct Parts {
    /// The content of `config.json`.
    pub file: Value,
    /// The provenance; hashes of files are replaced.
    pub manifest: Manifest,
    /// The weights, by name.
    pub weights: Named<HostTensor>,
    /// The state from which training continues, if the checkpoint has one.
    pub state: Option<StateParts>,
}

/// The state from which training continues, of a program that trains outside this crate.
pub struct StateParts {
    /// The progress of the run: the content of `state.json`.
    pub state: Value,
    /// The state of the optimizer: `first.NAME` and `second.NAME` of the weights, flattened to one axis.
    pub moments: Named<HostTensor>,
    /// The trained weights, if the weights of the checkpoint are a moving average; else `None`.
    pub raw: Option<Named<HostTensor>>,
}

/// Writes a checkpoint that another program trained to the run folder `run`, and returns the hash of its weights. Replaces
/// a checkpoint only if `replace` is set: the caller, such as a training, then keeps other writers away.
///
/// # Errors
/// When the parts are not those of a checkpoint that this program can load; without `replace`, when the folder holds one or another
/// process writes to it; when what would be replaced is no checkpoint of this program; or when writing fails. An earlier
/// checkpoint is kept.
pub fn store(run: &Path, parts: Parts, replace: bool) -> Result<String> {
    let Parts { file, mut manifest, weights, state } = parts;
    let invalid = |problem: String| {
        Error::config(run.display().to_string(), problem, "save weights and settings of a model of this family")
    };
    for (name, tensor) in &weights {
        tensor_file::check_finite(name, &tensor.values).map_err(invalid)?;
    }
    let stored = StoredCheckpoint::of_parts(run, file.clone(), manifest.clone(), weights.clone());
    load_stored(FAMILIES.rows, &stored, &Device::flex())?;
    let mut additional = vec![];
    manifest.hashes.retain(|name, _| !["optimizer", "raw"].contains(&name.as_str()));
    if let Some(StateParts { state, moments, raw }) = state {
        let state: RunState = serde_json::from_value(state).map_err(|error| invalid(format!("state: {error}")))?;
        let optimizer = tensor_file::encode(&moments)?;
        manifest.hashes.insert("optimizer".to_owned(), manifest::hash(&optimizer));
        additional.push((OPTIMIZER, optimizer));
        additional.push((STATE, state_text(&state)?));
        if let Some(raw) = raw {
            let raw = tensor_file::encode(&raw)?;
            manifest.hashes.insert("raw".to_owned(), manifest::hash(&raw));
            additional.push((RAW, raw));
        }
    }
    let mut write = || write(run, &file, &mut manifest, &weights, &additional);
    if !replace {
        return write_unused(run, write);
    }
    check_replaceable(run)?;
    std::fs::create_dir_all(run).map_err(|error| Error::io(run, "creating a folder", error))?;
    write()
}

fn state_text(state: &RunState) -> Result<Vec<u8>> {
    serde_json::to_vec_pretty(state).map_err(|error| Error::external("writing JSON", error))
}
