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

use crate::nn::parameters::{self, HostTensor, Named};
use crate::run_folder::{CHECKPOINT_FILES, CONFIG, FOLDER, MANIFEST, OPTIMIZER, RAW, STATE, WEIGHTS};
use crate::train::run_state::RunState;
use crate::train::{DatasetInfo, TrainConfig, Trainable};
use crate::weights;
use burn::tensor::Device;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use swm_core::{Error, Key, Manifest, Result, files, manifest};

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
        locate(run).is_some()
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
        if let Some(state) = state {
            let optimizer = pack(&state.moments)?;
            self.manifest.hashes.insert("optimizer".to_owned(), manifest::hash(&optimizer));
            additional.push((OPTIMIZER, optimizer));
            additional.push((STATE, text(&state.state)?.into_bytes()));
            if let Some(raw) = &state.raw {
                let raw = pack(&parameters::values(raw))?;
                self.manifest.hashes.insert("raw".to_owned(), manifest::hash(&raw));
                additional.push((RAW, raw));
            }
        }
        write(run, &config, &mut self.manifest, &parameters::values(&self.model), &additional)
    }

    /// Loads the checkpoint of a run folder (or the checkpoint folder itself).
    ///
    /// # Errors
    /// When the folder holds no checkpoint, or the checkpoint is of another family, is damaged, or has weights that
    /// do not fit its configuration.
    pub fn load(run: &Path, device: &Device) -> Result<Self> {
        Ok(Self::read(run, device)?.0)
    }

    /// Returns the checkpoint of a run folder, and the folder of the checkpoint's files.
    fn read(run: &Path, device: &Device) -> Result<(Self, PathBuf)> {
        let StoredCheckpoint { folder, file, manifest, config } =
            StoredCheckpoint::<TrainConfig<M>>::read(run, M::FAMILY)?;
        config.check()?;
        let ConfigFile { dataset_info, .. } =
            serde_json::from_value(file).map_err(|error| broken(&folder.join(CONFIG), error.to_string()))?;
        let model = M::new(&config, &dataset_info, Key::new(0), device)?;
        let model = load_weights(model, &folder.join(WEIGHTS), manifest.hashes.get("weights"))?;
        Ok((Self { model, config, dataset_info, manifest }, folder))
    }

    /// Loads the checkpoint and the state from which training continues.
    ///
    /// # Errors
    /// As [`Checkpoint::load`], and when the checkpoint was saved without the state of training.
    pub(crate) fn load_to_resume(run: &Path, device: &Device) -> Result<(Self, TrainState<M>)> {
        let (checkpoint, folder) = Self::read(run, device)?;
        let path = folder.join(STATE);
        let state = serde_json::from_slice(&read(&path)?)
            .map_err(|error| Error::corrupt(&path, error.to_string(), "train again from the beginning"))?;
        let hashes = &checkpoint.manifest.hashes;
        let moments = unpack(&folder.join(OPTIMIZER), hashes.get("optimizer"))?;
        let raw = match checkpoint.config.optim.ema > 0.0 {
            true => Some(load_weights(checkpoint.model.clone(), &folder.join(RAW), hashes.get("raw"))?),
            false => None,
        };
        Ok((checkpoint, TrainState { state, moments, raw }))
    }
}

/// Returns the family of the model in a run folder; `None` if the folder holds no checkpoint.
pub fn family(run: &Path) -> Option<String> {
    let file: serde_json::Value = serde_json::from_slice(&read(&locate(run)?.join(CONFIG)).ok()?).ok()?;
    Some(file.get("family")?.as_str()?.to_owned())
}

/// The files, except the weights, of a checkpoint of any family.
pub(crate) struct StoredCheckpoint<C> {
    /// The checkpoint's folder.
    pub folder: PathBuf,
    /// The parsed `config.json`.
    pub file: serde_json::Value,
    /// The field `config` of `config.json`.
    pub config: C,
    /// The provenance of the checkpoint.
    pub manifest: Manifest,
}

impl<C: serde::de::DeserializeOwned> StoredCheckpoint<C> {
    /// Reads the checkpoint of a run folder (or the checkpoint folder itself).
    ///
    /// # Errors
    /// When the folder holds no checkpoint, or the checkpoint is of another family or is damaged.
    pub fn read(run: &Path, family: &str) -> Result<Self> {
        let folder = locate(run).ok_or_else(|| {
            Error::corrupt(run, "there is no checkpoint", "give the folder that `swm train` wrote to")
        })?;
        let path = folder.join(CONFIG);
        let invalid = |error: serde_json::Error| broken(&path, error.to_string());
        let file: serde_json::Value = serde_json::from_slice(&read(&path)?).map_err(invalid)?;
        let found = file.get("family").and_then(|family| family.as_str()).unwrap_or("unknown");
        if found != family {
            return Err(Error::corrupt(
                &path,
                format!("it holds a model of the family '{found}'"),
                format!("give a checkpoint of the family '{family}'"),
            ));
        }
        let config = serde_json::from_value(file["config"].clone()).map_err(invalid)?;
        let path = folder.join(MANIFEST);
        let manifest = serde_json::from_slice(&read(&path)?).map_err(|error| broken(&path, error.to_string()))?;
        Ok(Self { folder, file, config, manifest })
    }
}

/// Writes a checkpoint with additional files to a new folder, which then replaces the old checkpoint. Stores the hash
/// of the weights in the manifest and returns the hash.
pub(crate) fn write(
    run: &Path,
    config: &impl Serialize,
    manifest: &mut Manifest,
    weights: &Named<HostTensor>,
    additional: &[(&str, Vec<u8>)],
) -> Result<String> {
    let new = run.join(format!("{FOLDER}.new"));
    files::delete(&new, CHECKPOINT_FILES)?;
    std::fs::create_dir_all(&new).map_err(|error| Error::io(&new, "creating a checkpoint", error))?;
    let write_file = |name: &str, bytes: &[u8]| {
        let path = new.join(name);
        std::fs::write(&path, bytes).map_err(|error| Error::io(&path, "writing a checkpoint", error))
    };
    write_file(CONFIG, text(config)?.as_bytes())?;
    let weights = pack(weights)?;
    let hash = manifest::hash(&weights);
    write_file(WEIGHTS, &weights)?;
    manifest.hashes.insert("weights".to_owned(), hash.clone());
    additional.iter().try_for_each(|(name, bytes)| write_file(name, bytes))?;
    write_file(MANIFEST, text(manifest)?.as_bytes())?;
    replace(run, &new)?;
    Ok(hash)
}

/// Renames the folder `new` to the name of the checkpoint folder and deletes the old checkpoint. Files of other names in
/// the old checkpoint's folder move to the new one.
fn replace(run: &Path, new: &Path) -> Result<()> {
    let (current, old) = (run.join(FOLDER), run.join(format!("{FOLDER}.old")));
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

/// Deletes the checkpoint in the folder `old`, moves the remaining entries to the folder `current`, and removes `old`
/// if it is empty then. An entry whose name exists in `current` stays.
fn move_other_files(old: &Path, current: &Path) -> Result<()> {
    let remaining = files::delete(old, CHECKPOINT_FILES)?;
    for path in &remaining {
        let target = current.join(path.file_name().unwrap_or_default());
        if !target.exists() {
            std::fs::rename(path, &target).map_err(|error| Error::io(&target, "moving a file", error))?;
        }
    }
    if old.exists() { files::remove_empty_folder(old) } else { Ok(()) }
}

/// Loads the weights file of a checkpoint into a model, after checking the hash of the file if `hash` is given.
///
/// # Errors
/// When the file is damaged, or the names or shapes of the weights differ from the model's.
pub(crate) fn load_weights<M: burn::module::Module>(model: M, path: &Path, hash: Option<&String>) -> Result<M> {
    let weights = unpack(path, hash)?;
    match weights::mismatch(&parameters::shapes(&model), &weights, CONFIG) {
        Some(problem) => Err(broken(path, problem)),
        None => Ok(parameters::load(model, &weights)),
    }
}

fn broken(path: &Path, problem: String) -> Error {
    Error::corrupt(path, problem, "train again, or copy the checkpoint again from its source")
}

/// Returns the folder of a run's checkpoint: `run`, the folder `checkpoint` in `run`, or the old checkpoint, which
/// remains if a process was killed between the two renamings.
fn locate(run: &Path) -> Option<PathBuf> {
    [run.to_owned(), run.join(FOLDER), run.join(format!("{FOLDER}.old"))]
        .into_iter()
        .find(|folder| folder.join(CONFIG).is_file())
}

fn read(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(|error| Error::io(path, "reading a checkpoint", error))
}

fn json<T: Serialize>(value: &T) -> Result<serde_json::Value> {
    serde_json::to_value(value).map_err(|error| Error::external("writing JSON", error))
}

fn text<T: Serialize>(value: &T) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|error| Error::external("writing JSON", error))
}

/// Encodes tensors as a safetensors file.
fn pack(tensors: &Named<HostTensor>) -> Result<Vec<u8>> {
    let failed = |error| Error::external("writing safetensors", error);
    let bytes: Vec<(&String, Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, t)| (name, t.shape.clone(), t.values.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let views: Result<Vec<(&String, TensorView<'_>)>> = bytes
        .iter()
        .map(|(name, shape, bytes)| Ok((*name, TensorView::new(Dtype::F32, shape.clone(), bytes).map_err(failed)?)))
        .collect();
    safetensors::serialize(views?, None).map_err(failed)
}

/// Reads the tensors of a safetensors file, after checking the hash of the file if `hash` is given.
fn unpack(path: &Path, hash: Option<&String>) -> Result<Named<HostTensor>> {
    let bytes = read(path)?;
    let broken = |problem: String| broken(path, problem);
    let tensors = SafeTensors::deserialize(&bytes).map_err(|error| broken(format!("is damaged ({error})")))?;
    if hash.is_some_and(|hash| *hash != manifest::hash(&bytes)) {
        return Err(broken(format!("is not the file that {MANIFEST} describes: the hash differs")));
    }
    tensors
        .iter()
        .map(|(name, view)| {
            if view.dtype() != Dtype::F32 {
                return Err(broken(format!(
                    "'{name}' holds {:?} elements instead of single precision (F32)",
                    view.dtype()
                )));
            }
            let values = view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            Ok((name.to_owned(), HostTensor { shape: view.shape().to_vec(), values }))
        })
        .collect()
}
