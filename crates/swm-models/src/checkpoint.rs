//! [`Checkpoint`]: a folder with a trained model, the statistics of the training dataset, and the state from which
//! training continues.
//!
//! | file | content |
//! | --- | --- |
//! | `config.json` | family, configuration, statistics of the dataset |
//! | `weights.safetensors` | weights under their published names |
//! | `optimizer.safetensors`, `state.json` | the state of the optimizer and of the run, from which training continues |
//! | `raw.safetensors` | the trained weights, if `weights.safetensors` holds the moving average of the weights |
//! | `manifest.json` | provenance, and the hashes of the files above |
//!
//! A new checkpoint is written to a second folder, which is then renamed to replace the old checkpoint, so that a
//! killed process leaves a complete checkpoint.

use crate::nn::Init;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::run_folder::{
    CHECKPOINT_PATTERNS, CONFIG, FOLDER, MANIFEST, NEW_FOLDER, OLD_FOLDER, OPTIMIZER, RAW, STATE, WEIGHTS,
};
use crate::stored::{self, StoredCheckpoint, broken, read_tensors, read_text, with_weights};
use crate::tensor_file;
use crate::train::run_state::RunState;
use crate::train::{DatasetInfo, TrainConfig, Trainable, colours};
use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use std::path::Path;
use swm_core::{Error, Manifest, Result, files, manifest};

pub use crate::stored::{check_unused, family, faults, is_unfinished};

/// A trained model, its configuration and its provenance.
#[derive(Clone, Debug)]
pub struct Checkpoint<M: Trainable> {
    /// The model.
    pub model: M,
    /// The training configuration.
    pub config: TrainConfig<M>,
    /// Statistics of the training dataset.
    pub dataset_info: DatasetInfo,
    /// The provenance of the checkpoint; `hashes["weights"]` identifies the checkpoint.
    pub manifest: Manifest,
}

/// The state from which training continues with the same results.
pub(crate) struct TrainState<M> {
    /// The progress of the run.
    pub state: RunState,
    /// The state of the optimizer.
    pub moments: Named<HostTensor>,
    /// The trained weights, if the weights of the checkpoint are a moving average; else `None`.
    pub raw: Option<M>,
}

/// The content of `config.json`.
#[derive(Serialize, Deserialize)]
struct ConfigFile {
    family: String,
    env: Option<String>,
    /// The side of the model's images, in pixels.
    image: Option<usize>,
    action_block: usize,
    #[serde(rename = "facts")]
    dataset_info: DatasetInfo,
    config: serde_json::Value,
}

impl<M: Trainable> Checkpoint<M> {
    /// Returns whether a folder holds a checkpoint.
    pub fn exists(run: &Path) -> bool {
        stored::locate(run).is_some()
    }

    /// Returns the hash of the weights.
    pub fn hash(&self) -> &str {
        self.manifest.hashes.get("weights").map_or("", String::as_str)
    }

    /// Returns the action dimension of a model step: the dimension of an environment action times the frameskip.
    pub fn action_dim(&self) -> usize {
        self.config.data.frameskip * self.dataset_info.action.dim()
    }

    /// Saves the checkpoint in the run folder `run`, replacing an earlier checkpoint. Returns the weights' hash.
    ///
    /// # Errors
    /// When writing fails; an earlier checkpoint is kept.
    pub fn save_to(&mut self, run: &Path) -> Result<String> {
        std::fs::create_dir_all(run).map_err(|error| Error::io(run, "creating a folder", error))?;
        self.save(run, None)
    }

    /// Saves the checkpoint as [`Checkpoint::save_to`] does, and the state from which training continues.
    pub(crate) fn save(&mut self, run: &Path, state: Option<&TrainState<M>>) -> Result<String> {
        let config = ConfigFile {
            family: M::FAMILY.to_owned(),
            env: self.dataset_info.env.clone(),
            image: M::image_size(&self.config.model),
            action_block: self.config.data.frameskip,
            dataset_info: self.dataset_info.clone(),
            config: json(&self.config)?,
        };
        let mut additional = vec![];
        // The manifest describes the files of this checkpoint only, not those of one that was loaded or saved before.
        self.manifest.hashes.retain(|name, _| !matches!(&**name, "optimizer" | "raw"));
        if let Some(state) = state {
            let optimizer = tensor_file::encode(&state.moments)?;
            self.manifest.hashes.insert("optimizer".to_owned(), manifest::hash(&optimizer));
            additional.push((OPTIMIZER, optimizer));
            additional.push((STATE, text(&state.state)?.into_bytes()));
            if let Some(raw) = &state.raw {
                let raw = tensor_file::encode(&parameters::values(raw))?;
                self.manifest.hashes.insert("raw".to_owned(), manifest::hash(&raw));
                additional.push((RAW, raw));
            }
        }
        write(run, &config, &mut self.manifest, &parameters::values(&self.model), &additional)
    }

    /// Loads the checkpoint of a run folder (or the checkpoint folder itself), or a capsule.
    ///
    /// # Errors
    /// When there is no checkpoint at `run`, or the checkpoint is of another family, is damaged, or has weights that do
    /// not fit its configuration.
    pub fn load(run: &Path, device: &Device) -> Result<Self> {
        Self::of(&StoredCheckpoint::read(run)?, device)
    }

    /// Loads a stored checkpoint.
    ///
    /// # Errors
    /// As [`Checkpoint::load`].
    pub fn of(stored: &StoredCheckpoint, device: &Device) -> Result<Self> {
        let config: TrainConfig<M> = stored.config(M::FAMILY)?;
        let invalid = |error: Error| stored.broken(error.to_string());
        let ConfigFile { dataset_info, image, action_block, .. } = stored.parsed()?;
        config.check().and_then(|()| dataset_info.check()).map_err(invalid)?;
        if colours::are_missing(&config) {
            return Err(stored.broken("its encoder has no colours, which a training finds".to_owned()));
        }
        let expected = (M::image_size(&config.model), config.data.frameskip);
        if (image, action_block) != expected {
            let describe = |(image, block): (Option<usize>, usize)| {
                format!("image = {}, action_block = {block}", image.map_or("none".to_owned(), |side| side.to_string()))
            };
            let (given, expected) = (describe((image, action_block)), describe(expected));
            return Err(stored.broken(format!("it says {given}, but its config gives {expected}")));
        }
        let create = |init: &Init| M::new(&config, &dataset_info, init).map_err(invalid);
        let model = stored.model(create, device)?;
        Ok(Self { model, config, dataset_info, manifest: stored.manifest().clone() })
    }

    /// Loads the checkpoint and the state from which training continues.
    ///
    /// # Errors
    /// As [`Checkpoint::load`], and when the checkpoint was saved without the state of training.
    pub(crate) fn load_to_resume(run: &Path, device: &Device) -> Result<(Self, TrainState<M>)> {
        let stored = StoredCheckpoint::read(run)?;
        let checkpoint = Self::of(&stored, device)?;
        let fix = "train again from the beginning";
        let folder = stored.folder().ok_or_else(|| Error::corrupt(run, "a capsule holds no state of training", fix))?;
        let path = folder.join(STATE);
        let unusable = |problem: String| Error::corrupt(&path, problem, fix);
        let state: RunState =
            serde_json::from_slice(&read_text(&path)?).map_err(|error| unusable(error.to_string()))?;
        if state.step > checkpoint.config.schedule.steps {
            return Err(unusable(format!("it is at step {} of {}", state.step, checkpoint.config.schedule.steps)));
        }
        let hashes = &checkpoint.manifest.hashes;
        let path = folder.join(OPTIMIZER);
        let moments = read_tensors(&path, hashes.get("optimizer"))?;
        let shapes = parameters::shapes(&checkpoint.model);
        let fits = |name: &str, tensor: &HostTensor| {
            let shape = name.split_once('.').and_then(|(_, parameter)| shapes.get(parameter));
            shape.is_some_and(|shape| shape.iter().product::<usize>() == tensor.values.len())
        };
        if let Some((name, _)) = moments.iter().find(|(name, tensor)| !fits(name, tensor)) {
            return Err(broken(&path, format!("'{name}' does not fit the model")));
        }
        let raw = match checkpoint.config.optim.ema > 0.0 {
            true => {
                let path = folder.join(RAW);
                Some(with_weights(checkpoint.model.clone(), &read_tensors(&path, hashes.get("raw"))?, &path)?)
            }
            false => None,
        };
        Ok((checkpoint, TrainState { state, moments, raw }))
    }
}

/// Writes a checkpoint with additional files to a new folder, which then replaces the old checkpoint. Stores the hashes
/// of configuration and weights in the manifest and returns that of the weights.
pub(crate) fn write(
    run: &Path,
    config: &impl Serialize,
    manifest: &mut Manifest,
    weights: &Named<HostTensor>,
    additional: &[(&str, Vec<u8>)],
) -> Result<String> {
    let new = run.join(NEW_FOLDER);
    files::delete(&new, CHECKPOINT_PATTERNS)?;
    std::fs::create_dir_all(&new).map_err(|error| Error::io(&new, "creating a checkpoint", error))?;
    let written = write_new(&new, config, manifest, weights, additional);
    if written.is_err() {
        // On a full disk, for example. If this fails too, `swm checkpoints remove` deletes the rest.
        let _ = files::delete(&new, CHECKPOINT_PATTERNS);
        let _ = files::remove_empty_folder(&new);
    }
    let hash = written?;
    replace(run, &new)?;
    Ok(hash)
}

/// Writes the files of a checkpoint to the folder `new` and returns the hash of the weights.
fn write_new(
    new: &Path,
    config: &impl Serialize,
    manifest: &mut Manifest,
    weights: &Named<HostTensor>,
    additional: &[(&str, Vec<u8>)],
) -> Result<String> {
    let write_file = |name: &str, bytes: &[u8]| files::write(&new.join(name), bytes);
    let config = text(config)?;
    write_file(CONFIG, config.as_bytes())?;
    manifest.hashes.insert("config".to_owned(), manifest::hash(config.as_bytes()));
    let weights = tensor_file::encode(weights)?;
    let hash = manifest::hash(&weights);
    write_file(WEIGHTS, &weights)?;
    manifest.hashes.insert("weights".to_owned(), hash.clone());
    additional.iter().try_for_each(|(name, bytes)| write_file(name, bytes))?;
    write_file(MANIFEST, text(manifest)?.as_bytes())?;
    Ok(hash)
}

/// Renames the folder `new` to the name of the checkpoint folder and deletes the old checkpoint. Files of other names in
/// the old checkpoint's folder move to the new one.
fn replace(run: &Path, new: &Path) -> Result<()> {
    let (current, old) = (run.join(FOLDER), run.join(OLD_FOLDER));
    let rename = |from: &Path, to: &Path| {
        std::fs::rename(from, to).map_err(|error| Error::io(to, "replacing a checkpoint", error))
    };
    if current.exists() {
        move_other_files(&old, &current)?;
        rename(&current, &old)?;
    }
    rename(new, &current)?;
    move_other_files(&old, &current)
}

/// Gives the old checkpoint its name back if a process was killed between the two renamings of [`replace`].
pub(crate) fn restore_old(run: &Path) -> Result<()> {
    let current = run.join(FOLDER);
    if stored::locate(run) != Some(run.join(OLD_FOLDER)) || current.exists() {
        return Ok(());
    }
    std::fs::rename(run.join(OLD_FOLDER), &current)
        .map_err(|error| Error::io(&current, "restoring a checkpoint", error))
}

/// Deletes the checkpoint in the folder `old`, moves the remaining entries to the folder `current`, and removes `old`
/// if it is empty then. An entry whose name exists in `current` stays.
fn move_other_files(old: &Path, current: &Path) -> Result<()> {
    let remaining = files::delete(old, CHECKPOINT_PATTERNS)?;
    for path in &remaining {
        let target = current.join(path.file_name().unwrap_or_default());
        if !target.exists() {
            std::fs::rename(path, &target).map_err(|error| Error::io(&target, "moving a file", error))?;
        }
    }
    if old.exists() { files::remove_empty_folder(old) } else { Ok(()) }
}

fn json<T: Serialize>(value: &T) -> Result<serde_json::Value> {
    serde_json::to_value(value).map_err(|error| Error::external("writing JSON", error))
}

fn text<T: Serialize>(value: &T) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|error| Error::external("writing JSON", error))
}
