//! [`Capsule`]: a trained model in one small file, with what is needed to check it on another machine.
//!
//! A capsule is a safetensors file of at most [`MAX_BYTES`]. Its metadata has one entry, `swm_capsule`, a JSON document:
//!
//! | field | content |
//! | --- | --- |
//! | `version` | the layout: [`VERSION`]; fields may be added without a new number |
//! | `hash` | the BLAKE3 hash of the other fields and of all tensors |
//! | `checkpoint` | `config.json` of the checkpoint: family, environment, image size, action block, statistics of the dataset (the scales of actions and columns), configuration (with the normalisation of pixels) |
//! | `manifest` | `manifest.json` of the checkpoint: seed, hashes of the dataset and of the weights, versions, device |
//! | `description` | licence, author, and the processor's level of vector instructions |
//! | `evaluation` | the request and the success rate of an evaluation, and the outcomes of some of its episodes |
//!
//! | tensors | content |
//! | --- | --- |
//! | names without `/` | the weights, under the names of the checkpoint: half precision for two or more axes, else single |
//! | `reference/input/…`, `reference/output/…` | the [reference batch](mod@reference), and the outputs of the model |
//! | `starts/…`, `rows/…` | the columns after the reset of the recorded episodes, and the dataset rows they start from |
//!
//! The hash of the weights is that of the `weights.safetensors` that [`export`] writes: single precision, rounded to half
//! where the capsule stores half.

mod file;
pub mod reference;

use crate::checkpoint;
use crate::nn::parameters::{HostTensor, Named};
use crate::stored::{self, StoredCheckpoint};
use crate::tensor_file;
use half::f16;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::path::Path;
use swm_core::text::one_line;
use swm_core::{Batch, Error, Manifest, Result, files, manifest};

/// The largest capsule, in bytes.
pub const MAX_BYTES: u64 = 6_000_000;

/// The layout that this version writes and reads.
pub const VERSION: u64 = 1;

/// A trained model, its provenance, and records of its behaviour.
#[derive(Clone, Debug)]
pub struct Capsule {
    /// Family, configuration and statistics of the dataset: the content of `config.json`.
    pub checkpoint: Value,
    /// The provenance of the checkpoint; `hashes["weights"]` is the hash of the weights, `hashes["packed"]` that of the
    /// weights before they were rounded.
    pub manifest: Manifest,
    /// Licence, author and processor.
    pub description: Description,
    /// The weights.
    pub weights: Named<HostTensor>,
    /// A batch of inputs and the outputs of the model.
    pub reference: Reference,
    /// An evaluation of the model, if it was packed with one.
    pub evaluation: Option<Evaluation>,
}

/// Who made a capsule, on what processor, and under which licence it may be used.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Description {
    /// The licence of the weights, such as `MIT`.
    pub licence: Option<String>,
    /// Who trained the model.
    pub author: Option<String>,
    /// The level of vector instructions of the processor that computed the reference outputs and played the episodes.
    pub cpu_level: String,
}

/// A batch of inputs, and the outputs of a model.
#[derive(Clone, Debug)]
pub struct Reference {
    /// The inputs: observations, and the column [`reference::ACTIONS`] for models that predict.
    pub inputs: Batch,
    /// The outputs by name; the first axis has the rows of the inputs.
    pub outputs: Named<HostTensor>,
}

/// An evaluation of a model. The record is opaque here, because evaluations are above this crate.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// The request, the success rate, and the outcomes of the recorded episodes.
    pub record: Value,
    /// The columns of the environment after the reset, a row for each recorded episode.
    pub starts: Batch,
    /// The start row and the goal row of each recorded episode, alternating, if the starts come from a dataset.
    pub rows: Option<Batch>,
}

/// A checkpoint whose weights are rounded as a capsule stores them, and its hashes.
pub struct Rounded {
    /// The checkpoint.
    pub stored: StoredCheckpoint,
    weights: Named<HostTensor>,
}

/// Rounds the weights of a checkpoint to half precision, except those that have fewer than two axes or exceed its range:
/// biases, scales and statistics of normalisations.
///
/// # Errors
/// When the checkpoint is damaged, or holds two models.
pub fn round(stored: &StoredCheckpoint) -> Result<Rounded> {
    if stored.has_world_model() {
        let (problem, fix) = ("it holds two models, and a capsule holds one", "pack the world model");
        return Err(Error::config(stored.run().display().to_string(), problem, fix));
    }
    let weights: Named<HostTensor> =
        stored.weights()?.into_iter().map(|(name, tensor)| (name, rounded(tensor))).collect();
    let hash = manifest::hash(&tensor_file::encode(&weights)?);
    let mut manifest = stored.manifest().clone();
    if let Some(packed) = manifest.hashes.insert("weights".to_owned(), hash.clone())
        && packed != hash
    {
        manifest.hashes.insert("packed".to_owned(), packed);
    }
    // The state of training does not go into a capsule.
    manifest.hashes.retain(|name, _| !["optimizer", "raw"].contains(&name.as_str()));
    let stored = stored.with(manifest, weights.clone());
    Ok(Rounded { stored, weights })
}

impl Rounded {
    /// Returns the capsule of the checkpoint.
    pub fn capsule(self, description: Description, reference: Reference, evaluation: Option<Evaluation>) -> Capsule {
        Capsule {
            checkpoint: self.stored.content().clone(),
            manifest: self.stored.manifest().clone(),
            description,
            weights: self.weights,
            reference,
            evaluation,
        }
    }
}

fn rounded(tensor: HostTensor) -> HostTensor {
    let values: Vec<f32> = tensor.values.iter().map(|&value| f16::from_f32(value).to_f32()).collect();
    if tensor.shape.len() < 2 || values.iter().any(|value| !value.is_finite()) {
        tensor
    } else {
        HostTensor { values, ..tensor }
    }
}

impl Capsule {
    /// Whether a file is a capsule, damaged or not.
    pub fn is_capsule_file(path: &Path) -> bool {
        files::read(path, MAX_BYTES).is_ok_and(|bytes| file::is_capsule(&bytes))
    }

    /// Reads a capsule and checks its hashes.
    ///
    /// # Errors
    /// When the file is no capsule, has another version, is larger than [`MAX_BYTES`], or is damaged.
    pub fn read(path: &Path) -> Result<Self> {
        let capsule = file::decode(path, &files::read(path, MAX_BYTES)?)?;
        let expected = capsule.manifest.hashes.get("weights");
        if expected != Some(&manifest::hash(&tensor_file::encode(&capsule.weights)?)) {
            return Err(damaged(path, "the hash of its weights differs from its manifest".to_owned()));
        }
        let stated = capsule.checkpoint.get("env").and_then(Value::as_str);
        if stated.is_some() && stated != capsule.env() {
            let [stated, of_data] = [stated, capsule.env()].map(|env| one_line(env.unwrap_or("none")));
            return Err(damaged(path, format!("it states the environment {stated}, and was trained on {of_data}")));
        }
        Ok(capsule)
    }

    /// Writes the capsule to a file and returns its hash. Replaces a capsule of the same model only.
    ///
    /// # Errors
    /// When it is larger than [`MAX_BYTES`], the file holds another model or is no capsule, or it cannot be written.
    pub fn write_own(&self, path: &Path) -> Result<String> {
        let (bytes, hash) = self.bytes(path)?;
        if write_new(path, &bytes)? {
            return Ok(hash);
        }
        let old = Self::read(path)?;
        if !old.is_same_model(self) {
            let problem = format!("it holds another model, with the weights {}", old.weights_hash());
            let fix = "give another --output, or delete the file by hand";
            return Err(Error::config(path.display().to_string(), problem, fix));
        }
        files::write(path, &bytes)?;
        Ok(hash)
    }

    /// Writes the capsule to a file and returns its hash.
    ///
    /// # Errors
    /// When it is larger than [`MAX_BYTES`], or the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<String> {
        let (bytes, hash) = self.bytes(path)?;
        files::write(path, &bytes)?;
        Ok(hash)
    }

    /// The bytes of the capsule, for the file `path`, and its hash.
    fn bytes(&self, path: &Path) -> Result<(Vec<u8>, String)> {
        let (bytes, hash) = file::encode(self)?;
        if bytes.len() as u64 > MAX_BYTES {
            let problem = format!("the capsule has {} bytes, more than {MAX_BYTES}", bytes.len());
            return Err(Error::config(path.display().to_string(), problem, "train a smaller model, or smaller images"));
        }
        Ok((bytes, hash))
    }

    /// Returns the hash of the capsule.
    ///
    /// # Errors
    /// Never for a capsule that was read.
    pub fn hash(&self) -> Result<String> {
        Ok(file::encode(self)?.1)
    }

    /// Returns the hash of the weights.
    pub fn weights_hash(&self) -> &str {
        self.manifest.hashes.get("weights").map_or("", String::as_str)
    }

    /// Returns whether both capsules hold the same model: equal weights, or weights of the same training, that is of
    /// the same family, environment, configuration, seed and data.
    pub fn is_same_model(&self, other: &Self) -> bool {
        let training = |capsule: &Self| {
            let Manifest { kind, seed, config, hashes, .. } = &capsule.manifest;
            let origin = (capsule.checkpoint.get("family").cloned(), capsule.env().map(str::to_owned));
            (kind == "train").then(|| (origin, *seed, config.clone(), hashes.get("dataset").cloned()))
        };
        let same_training = training(self).is_some_and(|own| training(other).is_some_and(|other| own == other));
        same_training || self.weights_hash() == other.weights_hash()
    }

    /// Returns the id of the environment that the model was trained on.
    pub fn env(&self) -> Option<&str> {
        self.checkpoint.pointer("/facts/env").and_then(Value::as_str)
    }
}

/// Writes a file where none exists, and returns whether it did: nothing that another process writes there meanwhile is replaced.
fn write_new(path: &Path, bytes: &[u8]) -> Result<bool> {
    let io = |error| Error::io(path, "writing the file", error);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    // What a kill leaves has the name of a temporary file of `files::write`, which the next command deletes.
    let staged = path.with_file_name(format!(".{name}.{}.tmp", std::process::id()));
    files::delete_file(&staged)?;
    let written = File::create_new(&staged).and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_data()));
    let linked = written.map(|()| std::fs::hard_link(&staged, path));
    files::delete_file(&staged)?;
    match linked.map_err(io)? {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(false),
        // A file system without hard links.
        Err(_) => files::write(path, bytes).map(|()| true),
    }
}

/// Writes the checkpoint of a capsule to a run folder, and returns the hash of its weights. Replaces nothing. If a file
/// cannot be written, nothing remains of the others.
///
/// # Errors
/// As [`checkpoint::check_unused`], when another process writes to `run`, or a file cannot be written.
pub fn export(capsule: &Capsule, run: &Path) -> Result<String> {
    let mut manifest = capsule.manifest.clone();
    stored::write_unused(run, || checkpoint::write(run, &capsule.checkpoint, &mut manifest, &capsule.weights, &[]))
}

/// Returns the error for a damaged capsule.
fn damaged(path: &Path, problem: String) -> Error {
    Error::corrupt(path, problem, "copy the capsule again from its source, or pack it again")
}
