//! [`Checkpoint`]: a folder that holds a trained model and all that is needed to use it or to train on.
//!
//! | file | what |
//! | --- | --- |
//! | `config.json` | family, configuration, dataset info |
//! | `weights.safetensors` | weights under their published names |
//! | `optimizer.safetensors`, `state.json` | what training needs to continue exactly |
//! | `raw.safetensors` | the weights that are trained, where those to use are their average |
//! | `manifest.json` | where it came from, and the hashes of the files above |
//!
//! A new checkpoint is written beside the old one and takes its place by renaming, so a killed process leaves one
//! of the two.

use crate::nn::parameters::{self, HostTensor, Named};
use crate::train::run::RunState;
use crate::train::{DatasetInfo, TrainConfig, Trainable};
use burn::tensor::Device;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use swm_core::{Error, Key, Manifest, Result, manifest};

/// A trained model and all that is needed to use it.
#[derive(Clone, Debug)]
pub struct Checkpoint<M: Trainable> {
    /// The model.
    pub model: M,
    /// How it was trained.
    pub config: TrainConfig<M>,
    /// What it knows of the data it was trained on.
    pub dataset_info: DatasetInfo,
    /// Where it came from; `hashes["weights"]` names the checkpoint.
    pub manifest: Manifest,
}

/// What training needs to continue exactly.
pub(crate) struct TrainState<M> {
    /// How far it is.
    pub position: RunState,
    /// The state of the optimizer.
    pub moments: Named<HostTensor>,
    /// The weights that are trained, where those of the checkpoint are their average.
    pub raw: Option<M>,
}

/// The content of `config.json`.
#[derive(Serialize, Deserialize)]
struct Card {
    family: String,
    env: Option<String>,
    /// The side of the pictures it sees.
    image: Option<usize>,
    action_block: usize,
    #[serde(rename = "facts")]
    dataset_info: DatasetInfo,
    config: serde_json::Value,
}

const FOLDER: &str = "checkpoint";
const CONFIG: &str = "config.json";
const MANIFEST: &str = "manifest.json";
const WEIGHTS: &str = "weights.safetensors";
const RAW: &str = "raw.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const STATE: &str = "state.json";

impl<M: Trainable> Checkpoint<M> {
    /// Whether a folder holds a checkpoint.
    pub fn exists(run: &Path) -> bool {
        locate(run).is_some()
    }

    /// The hash of the weights.
    pub fn hash(&self) -> &str {
        self.manifest.hashes.get("weights").map_or("", String::as_str)
    }

    /// Numbers of one model step's actions: those of an environment's action, times the frameskip.
    pub fn actions(&self) -> usize {
        self.config.data.frameskip * self.dataset_info.action.dim()
    }

    /// Saves it into the run folder `run`, which keeps the last checkpoint only. Returns the hash of the weights.
    ///
    /// # Errors
    /// When the disk refuses; the checkpoint that was there is kept.
    pub fn save_to(&mut self, run: &Path) -> Result<String> {
        std::fs::create_dir_all(run).map_err(|error| Error::io(run, "creating a folder", error))?;
        self.save(run, None)
    }

    /// As [`Checkpoint::save_to`], with what training needs to continue.
    pub(crate) fn save(&mut self, run: &Path, state: Option<&TrainState<M>>) -> Result<String> {
        let card = Card {
            family: M::FAMILY.to_owned(),
            env: self.dataset_info.env.clone(),
            image: M::image_size(&self.config.model),
            action_block: self.config.data.frameskip,
            dataset_info: self.dataset_info.clone(),
            config: json(&self.config)?,
        };
        let mut more = vec![];
        if let Some(state) = state {
            let optimizer = pack(&state.moments)?;
            self.manifest.hashes.insert("optimizer".to_owned(), manifest::hash(&optimizer));
            more.push((OPTIMIZER, optimizer));
            more.push((STATE, text(&state.position)?.into_bytes()));
            if let Some(raw) = &state.raw {
                let raw = pack(&parameters::values(raw))?;
                self.manifest.hashes.insert("raw".to_owned(), manifest::hash(&raw));
                more.push((RAW, raw));
            }
        }
        install(run, &card, &mut self.manifest, &parameters::values(&self.model), &more)
    }

    /// Loads the checkpoint of a run folder (or the checkpoint folder itself).
    ///
    /// # Errors
    /// When there is none, it is of another family, it is damaged, or its weights do not fit its configuration.
    pub fn load(run: &Path, device: &Device) -> Result<Self> {
        Ok(Self::read(run, device)?.0)
    }

    /// The checkpoint and its folder.
    fn read(run: &Path, device: &Device) -> Result<(Self, PathBuf)> {
        let Stored { folder, card, manifest, config } = Stored::<TrainConfig<M>>::read(run, M::FAMILY)?;
        config.check()?;
        let card: Card =
            serde_json::from_value(card).map_err(|error| broken(&folder.join(CONFIG), error.to_string()))?;
        let model = M::new(&config, &card.dataset_info, Key::new(0), device)?;
        let model = fill(model, &folder.join(WEIGHTS), manifest.hashes.get("weights"))?;
        Ok((Self { model, config, dataset_info: card.dataset_info, manifest }, folder))
    }

    /// Loads the checkpoint and what training needs to continue.
    ///
    /// # Errors
    /// As [`Checkpoint::load`], and when the checkpoint was saved without that.
    pub(crate) fn load_to_resume(run: &Path, device: &Device) -> Result<(Self, TrainState<M>)> {
        let (checkpoint, folder) = Self::read(run, device)?;
        let path = folder.join(STATE);
        let position = serde_json::from_slice(&read(&path)?)
            .map_err(|error| Error::corrupt(&path, error.to_string(), "train again from the beginning"))?;
        let hashes = &checkpoint.manifest.hashes;
        let moments = unpack(&folder.join(OPTIMIZER), hashes.get("optimizer"))?;
        let raw = match checkpoint.config.optim.ema > 0.0 {
            true => Some(fill(checkpoint.model.clone(), &folder.join(RAW), hashes.get("raw"))?),
            false => None,
        };
        Ok((checkpoint, TrainState { position, moments, raw }))
    }
}

/// The family of the model a run folder holds, if it holds one.
pub fn family(run: &Path) -> Option<String> {
    let card: serde_json::Value = serde_json::from_slice(&read(&locate(run)?.join(CONFIG)).ok()?).ok()?;
    Some(card.get("family")?.as_str()?.to_owned())
}

/// What every family stores beside its weights.
pub(crate) struct Stored<C> {
    /// The checkpoint's folder.
    pub folder: PathBuf,
    /// The whole `config.json`.
    pub card: serde_json::Value,
    /// Its part `config`.
    pub config: C,
    /// Where the checkpoint came from.
    pub manifest: Manifest,
}

impl<C: serde::de::DeserializeOwned> Stored<C> {
    /// Reads it.
    ///
    /// # Errors
    /// When there is none, it is of another family, or it is damaged.
    pub fn read(run: &Path, family: &str) -> Result<Self> {
        let folder = locate(run).ok_or_else(|| {
            Error::corrupt(run, "there is no checkpoint", "give the folder that `swm train` wrote to")
        })?;
        let path = folder.join(CONFIG);
        let wrong = |error: serde_json::Error| broken(&path, error.to_string());
        let card: serde_json::Value = serde_json::from_slice(&read(&path)?).map_err(wrong)?;
        let found = card.get("family").and_then(|family| family.as_str()).unwrap_or("unknown");
        if found != family {
            return Err(Error::corrupt(
                &path,
                format!("it holds a model of the family '{found}'"),
                format!("give a checkpoint of the family '{family}'"),
            ));
        }
        let config = serde_json::from_value(card["config"].clone()).map_err(wrong)?;
        let path = folder.join(MANIFEST);
        let manifest = serde_json::from_slice(&read(&path)?).map_err(|error| broken(&path, error.to_string()))?;
        Ok(Self { folder, card, config, manifest })
    }
}

/// Writes a checkpoint beside the old one and puts it in its place. Notes the hash of the weights in the manifest and
/// returns it.
pub(crate) fn install(
    run: &Path,
    card: &impl Serialize,
    manifest: &mut Manifest,
    weights: &Named<HostTensor>,
    more: &[(&str, Vec<u8>)],
) -> Result<String> {
    let new = run.join(format!("{FOLDER}.new"));
    if new.exists() {
        std::fs::remove_dir_all(&new).map_err(|error| Error::io(&new, "removing an unfinished checkpoint", error))?;
    }
    std::fs::create_dir_all(&new).map_err(|error| Error::io(&new, "creating a checkpoint", error))?;
    let write = |name: &str, bytes: &[u8]| {
        let path = new.join(name);
        std::fs::write(&path, bytes).map_err(|error| Error::io(&path, "writing a checkpoint", error))
    };
    write(CONFIG, text(card)?.as_bytes())?;
    let weights = pack(weights)?;
    let hash = manifest::hash(&weights);
    write(WEIGHTS, &weights)?;
    manifest.hashes.insert("weights".to_owned(), hash.clone());
    more.iter().try_for_each(|(name, bytes)| write(name, bytes))?;
    write(MANIFEST, text(manifest)?.as_bytes())?;

    let (place, old) = (run.join(FOLDER), run.join(format!("{FOLDER}.old")));
    let rename = |from: &Path, to: &Path| {
        std::fs::rename(from, to).map_err(|error| Error::io(to, "putting a checkpoint in its place", error))
    };
    if old.exists() && place.exists() {
        std::fs::remove_dir_all(&old).map_err(|error| Error::io(&old, "removing an old checkpoint", error))?;
    }
    if place.exists() {
        rename(&place, &old)?;
    }
    rename(&new, &place)?;
    if old.exists() {
        std::fs::remove_dir_all(&old).map_err(|error| Error::io(&old, "removing an old checkpoint", error))?;
    }
    Ok(hash)
}

/// A model with the weights of a file of a checkpoint.
pub(crate) fn fill<M: burn::module::Module>(model: M, path: &Path, hash: Option<&String>) -> Result<M> {
    let weights = unpack(path, hash)?;
    let wanted = parameters::shapes(&model);
    for (name, shape) in &wanted {
        match weights.get(name) {
            Some(tensor) if &tensor.shape == shape => {}
            Some(tensor) => {
                let problem = format!("'{name}' is {:?}, but {CONFIG} makes it {shape:?}", tensor.shape);
                return Err(broken(path, problem));
            }
            None => return Err(broken(path, format!("'{name}' is missing, which {CONFIG} asks for"))),
        }
    }
    if let Some(name) = weights.keys().find(|name| !wanted.contains_key(*name)) {
        return Err(broken(path, format!("'{name}' is no weight of the model that {CONFIG} describes")));
    }
    Ok(parameters::load(model, &weights))
}

fn broken(path: &Path, problem: String) -> Error {
    Error::corrupt(path, problem, "train again, or copy the checkpoint again from where it came")
}

/// Where the checkpoint of a run is: in place, or moved aside by a process that was killed before the new one was
/// in place.
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

/// Tensors as a safetensors file.
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

/// The tensors of a safetensors file.
fn unpack(path: &Path, hash: Option<&String>) -> Result<Named<HostTensor>> {
    let bytes = read(path)?;
    let broken = |problem: String| broken(path, problem);
    let tensors = SafeTensors::deserialize(&bytes).map_err(|error| broken(format!("is damaged ({error})")))?;
    if hash.is_some_and(|hash| *hash != manifest::hash(&bytes)) {
        return Err(broken(format!("is not the file that {MANIFEST} describes: its hash differs")));
    }
    tensors
        .iter()
        .map(|(name, view)| {
            if view.dtype() != Dtype::F32 {
                return Err(broken(format!("'{name}' holds {:?}, not single precision", view.dtype())));
            }
            let values = view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            Ok((name.to_owned(), HostTensor { shape: view.shape().to_vec(), values }))
        })
        .collect()
}
