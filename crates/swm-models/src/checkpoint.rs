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
use crate::run_folder::{CHECKPOINT_FILES, CONFIG, FOLDER, MANIFEST, OPTIMIZER, RAW, STATE, WEIGHTS, WORLD_MODEL};
use crate::train::run_state::RunState;
use crate::train::{DatasetInfo, TrainConfig, Trainable, limits};
use crate::weights;
use burn::module::Module;
use burn::tensor::Device;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use swm_core::{Error, Manifest, Result, files, manifest};

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
        let path = folder.join(CONFIG);
        let invalid = |error: Error| broken(&path, error.to_string());
        let ConfigFile { dataset_info, image, action_block, .. } =
            serde_json::from_value(file).map_err(|error| broken(&path, error.to_string()))?;
        config.check().and_then(|()| dataset_info.check()).map_err(invalid)?;
        let expected = (M::image_size(&config.model), config.data.frameskip);
        if (image, action_block) != expected {
            let given =
                format!("image and action_block are {:?}, its config gives {expected:?}", (image, action_block));
            return Err(broken(&path, given));
        }
        let create = |init: &Init| M::new(&config, &dataset_info, init).map_err(invalid);
        let model = load_weights(create, &folder.join(WEIGHTS), manifest.hashes.get("weights"), device)?;
        Ok((Self { model, config, dataset_info, manifest }, folder))
    }

    /// Loads the checkpoint and the state from which training continues.
    ///
    /// # Errors
    /// As [`Checkpoint::load`], and when the checkpoint was saved without the state of training.
    pub(crate) fn load_to_resume(run: &Path, device: &Device) -> Result<(Self, TrainState<M>)> {
        let (checkpoint, folder) = Self::read(run, device)?;
        let path = folder.join(STATE);
        let unusable = |problem: String| Error::corrupt(&path, problem, "train again from the beginning");
        let state: RunState =
            serde_json::from_slice(&read_text(&path)?).map_err(|error| unusable(error.to_string()))?;
        if state.step > checkpoint.config.schedule.steps {
            return Err(unusable(format!("it is at step {} of {}", state.step, checkpoint.config.schedule.steps)));
        }
        let hashes = &checkpoint.manifest.hashes;
        let path = folder.join(OPTIMIZER);
        let moments = unpack(&path, hashes.get("optimizer"))?;
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
                Some(with_weights(checkpoint.model.clone(), &unpack(&path, hashes.get("raw"))?, &path)?)
            }
            false => None,
        };
        Ok((checkpoint, TrainState { state, moments, raw }))
    }
}

/// Returns the family of the model in a run folder; `None` if the folder holds no checkpoint.
pub fn family(run: &Path) -> Option<String> {
    let file: serde_json::Value = serde_json::from_slice(&read_text(&locate(run)?.join(CONFIG)).ok()?).ok()?;
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
        let folder = locate(run).ok_or_else(|| missing(run))?;
        let path = folder.join(CONFIG);
        let invalid = |error: serde_json::Error| broken(&path, error.to_string());
        let file: serde_json::Value = serde_json::from_slice(&read_text(&path)?).map_err(invalid)?;
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
        let manifest = serde_json::from_slice(&read_text(&path)?).map_err(|error| broken(&path, error.to_string()))?;
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
    let write_file = |name: &str, bytes: &[u8]| files::write(&new.join(name), bytes);
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

/// Creates a model, which may be little larger than the weights of a checkpoint, and loads the weights into it, after
/// checking the hash of their file if `hash` is given.
///
/// # Errors
/// When the file is damaged, or the names or shapes of the weights differ from the model's.
pub(crate) fn load_weights<M: Module>(
    create: impl FnOnce(&Init) -> Result<M>,
    path: &Path,
    hash: Option<&String>,
    device: &Device,
) -> Result<M> {
    let weights = unpack(path, hash)?;
    let init = Init::for_weights(&weights, device);
    let model = create(&init)?;
    init.check().map_err(|_| broken(path, format!("{CONFIG} describes a larger model than these weights")))?;
    with_weights(model, &weights, path)
}

/// Replaces the weights of a model by those of the file `path`.
fn with_weights<M: Module>(model: M, weights: &Named<HostTensor>, path: &Path) -> Result<M> {
    match weights::mismatch(&parameters::shapes(&model), weights, CONFIG) {
        Some(problem) => Err(broken(path, problem)),
        None => Ok(parameters::load(model, weights)),
    }
}

/// Returns the faults of a checkpoint that loading does not find: files of tensors without a hash in the manifest, and
/// a training state whose hash differs.
///
/// # Errors
/// When the folder holds no checkpoint, or a file cannot be read.
pub fn faults(run: &Path) -> Result<Vec<String>> {
    let folder = locate(run).ok_or_else(|| missing(run))?;
    let path = folder.join(MANIFEST);
    let manifest: Manifest =
        serde_json::from_slice(&read_text(&path)?).map_err(|error| broken(&path, error.to_string()))?;
    let mut faults = vec![];
    for (name, file) in [("weights", WEIGHTS), ("optimizer", OPTIMIZER), ("raw", RAW)] {
        let path = folder.join(file);
        match manifest.hashes.get(name) {
            Some(hash) if *hash != manifest::hash(&files::read(&path, u64::MAX)?) => {
                faults.push(format!("{file} is not the file that {MANIFEST} describes: its hash differs"));
            }
            None if path.exists() => faults.push(format!("{MANIFEST} holds no hash of {file}")),
            _ => {}
        }
    }
    let world_model = run.join(WORLD_MODEL);
    if locate(&world_model).is_some() {
        faults.extend(self::faults(&world_model)?.into_iter().map(|fault| format!("{WORLD_MODEL}: {fault}")));
    }
    Ok(faults)
}

fn missing(run: &Path) -> Error {
    Error::corrupt(run, "there is no checkpoint", "give the folder that `swm train` wrote to")
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

/// Reads a JSON file.
fn read_text(path: &Path) -> Result<Vec<u8>> {
    files::read(path, limits::JSON_BYTES)
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
    let bytes = files::read(path, u64::MAX)?;
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
            let values: Vec<f32> =
                view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            if let Some(value) = values.iter().find(|value| !value.is_finite()) {
                return Err(broken(format!("'{name}' holds the value {value}, which is not finite")));
            }
            Ok((name.to_owned(), HostTensor { shape: view.shape().to_vec(), values }))
        })
        .collect()
}
