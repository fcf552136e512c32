//! Checkpoints of the reference implementation: a state dict (`weights.pt`) and a `config.json`, which is a tree of
//! classes (`_target_`) and their arguments.

use super::keys::Keys;
use super::{BATCHES_TRACKED, names, read, torch};
use crate::nn::parameters::{HostTensor, Named};
use crate::nn::{DinoConfig, VitConfig};
use crate::train::limits;
use serde::Serialize;
use serde_json::Value;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};

/// A checkpoint of the reference implementation.
pub(crate) struct Reference {
    /// The file of weights.
    pub path: PathBuf,
    /// The tree of classes, whose root is the model.
    pub config: Value,
    /// The keys of the tree, in the order of the file.
    pub keys: Keys,
    /// The state dict, without the counters of batch normalisations.
    pub weights: Named<HostTensor>,
}

const CONFIG: &str = "config.json";
/// The weights of a checkpoint that [`write`] writes.
const EXPORTED_WEIGHTS: &str = "weights.pt";
const TARGET: &str = "_target_";

impl Reference {
    /// Reads a checkpoint of the class `class`: a folder with a `config.json` and one file of weights, or the path of
    /// the file of weights.
    ///
    /// # Errors
    /// When a file is missing or damaged, there are several files of weights, or the checkpoint is of another class.
    pub fn open(from: &Path, class: &str) -> Result<Self> {
        if !from.exists() {
            let fix = "give the folder of a checkpoint, or its file of weights";
            return Err(Error::corrupt(from, "does not exist", fix));
        }
        let folder = if from.is_dir() { from } else { from.parent().unwrap_or(Path::new("")) };
        let path = if from.is_dir() { only_weights(folder)? } else { from.to_owned() };
        let config_path = folder.join(CONFIG);
        let text = files::read(&config_path, limits::JSON_BYTES)?;
        let invalid = |problem: String| {
            Error::corrupt(&config_path, problem, format!("give a checkpoint of the reference's class {class}"))
        };
        let mut config: Value = serde_json::from_slice(&text).map_err(|error| invalid(error.to_string()))?;
        let mut keys: Keys = serde_json::from_slice(&text).map_err(|error| invalid(error.to_string()))?;
        // Early versions stored the configuration of the whole run.
        if config.get(TARGET).is_none() && config["model"].get(TARGET).is_some() {
            config = config["model"].take();
            keys = keys.0.into_iter().find_map(|(name, keys)| (name == "model").then_some(keys)).unwrap_or_default();
        }
        let found = config[TARGET].as_str().unwrap_or("an object without _target_").to_owned();
        if found.rsplit('.').next() != Some(class) {
            return Err(invalid(format!("the file describes {found} instead of {class}")));
        }
        let mut weights = read(&path)?;
        weights.retain(|name, _| !name.ends_with(BATCHES_TRACKED));
        Ok(Self { path, config, keys, weights })
    }

    /// Returns the size at a dotted path, such as `predictor.depth`.
    ///
    /// # Errors
    /// When there is no size at the path.
    pub fn size(&self, at: &str) -> Result<usize> {
        self.size_or(at, None)
    }

    /// Returns the size at a dotted path, or `default` if there is no size at the path.
    ///
    /// # Errors
    /// When there is neither a size at the path nor a default.
    pub fn size_or(&self, at: &str, default: Option<usize>) -> Result<usize> {
        let found = self.at(at).and_then(Value::as_u64).and_then(|size| usize::try_from(size).ok());
        found.or(default).ok_or_else(|| self.wrong(format!("{CONFIG} has no size at {at}")))
    }

    /// Returns the rate at a dotted path, or 0 if there is no rate at the path.
    pub fn rate(&self, at: &str) -> f32 {
        self.at(at).and_then(Value::as_f64).unwrap_or(0.0) as f32
    }

    /// Returns the value at a dotted path.
    pub fn at(&self, path: &str) -> Option<&Value> {
        path.split('.').try_fold(&self.config, |value, key| value.get(key)).filter(|value| !value.is_null())
    }

    /// Returns the class at a dotted path, without its module.
    pub fn class(&self, at: &str) -> &str {
        let target = self.at(at).and_then(|value| value[TARGET].as_str()).unwrap_or("");
        target.rsplit('.').next().unwrap_or_default()
    }

    /// Returns the error for a checkpoint that this program cannot use.
    pub fn wrong(&self, problem: String) -> Error {
        Error::corrupt(&self.path, problem, "give a checkpoint that the reference's own training wrote")
    }

    /// Returns the shape of a weight.
    ///
    /// # Errors
    /// When the weight is missing.
    pub fn shape(&self, name: &str) -> Result<&[usize]> {
        let found = self.weights.get(name).map(|weight| weight.shape.as_slice());
        found.ok_or_else(|| self.wrong(format!("'{name}' is missing")))
    }

    /// Returns the sizes and the image size of the vision transformer at a dotted path, and renames the weights to
    /// their published names.
    ///
    /// # Errors
    /// When the encoder is not a vision transformer, or its size is unknown.
    pub fn vit(&mut self, at: &str) -> Result<(VitConfig, usize)> {
        if self.class(at) != "vit_hf" {
            return Err(self.wrong(format!("the encoder is '{}', not the vision transformer 'vit_hf'", self.class(at))));
        }
        let patch = self.size_or(&format!("{at}.patch_size"), Some(16))?;
        let image = self.size_or(&format!("{at}.image_size"), Some(224))?;
        let named = self.at(&format!("{at}.size")).and_then(Value::as_str).unwrap_or("tiny").to_owned();
        let size = match named.as_str() {
            "tiny" => VitConfig::tiny(patch),
            "small" => VitConfig::small(patch),
            "base" => VitConfig::base(patch),
            "large" => VitConfig::large(patch),
            "huge" => VitConfig::huge(patch),
            _ => return Err(self.wrong(format!("there is no vision transformer of the size '{named}'"))),
        };
        let config = VitConfig {
            patch,
            dim: self.size_or(&format!("{at}.hidden_size"), Some(size.dim))?,
            depth: self.size_or(&format!("{at}.num_hidden_layers"), Some(size.depth))?,
            heads: self.size_or(&format!("{at}.num_attention_heads"), Some(size.heads))?,
            mlp: self.size_or(&format!("{at}.intermediate_size"), Some(size.mlp))?,
        };
        let prefix = format!("{at}.");
        let weights = std::mem::take(&mut self.weights);
        self.weights = names::to_published(weights, &prefix, &self.path)?;
        // The mask token is used in pretraining with masked images only.
        self.weights.remove(&format!("{prefix}embeddings.mask_token"));
        Ok((config, image))
    }

    /// Returns the sizes of the DINOv2 below `prefix`, and renames the weights to their published names.
    ///
    /// # Errors
    /// When a weight is missing.
    pub fn dinov2(&mut self, prefix: &str) -> Result<DinoConfig> {
        let weights = std::mem::take(&mut self.weights);
        self.weights = names::to_published(weights, prefix, &self.path)?;
        let of = |name: &str| self.shape(&format!("{prefix}{name}"));
        let projection = of("embeddings.patch_embeddings.projection.weight")?;
        let [dim, _, patch, _] = *projection else {
            return Err(self.wrong("the encoder does not begin with a convolution".to_owned()));
        };
        let mlp = of("encoder.layer.0.mlp.fc1.weight")?.first().copied().unwrap_or(0);
        let grid = of("embeddings.position_embeddings")?.get(1).map_or(0, |tokens| tokens.saturating_sub(1).isqrt());
        let registers = of("embeddings.register_tokens").map_or(0, |shape| shape.get(1).copied().unwrap_or(0));
        let layer = |name: &String| name.strip_prefix(prefix).is_some_and(|name| name.ends_with(".norm1.weight"));
        let depth = self.weights.keys().filter(|name| layer(name)).count();
        // All published sizes have heads of 64 features.
        Ok(DinoConfig { patch, dim, depth, heads: (dim / 64).max(1), mlp, grid, registers })
    }
}

/// Returns the only file of weights in a folder.
fn only_weights(folder: &Path) -> Result<PathBuf> {
    let entries = std::fs::read_dir(folder).map_err(|error| Error::io(folder, "listing weights", error))?;
    let weights = |path: &PathBuf| path.extension().is_some_and(|end| end == "pt" || end == "safetensors");
    let mut files: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).filter(weights).collect();
    files.sort();
    match files.as_slice() {
        [file] => Ok(file.clone()),
        [] => Err(Error::corrupt(
            folder,
            "there is no .pt or .safetensors file",
            "give the folder of a checkpoint, or the path of its weights",
        )),
        _ => Err(Error::corrupt(folder, "there are several files of weights", "give the path of one file")),
    }
}

/// Writes a checkpoint that the reference's `load_pretrained` reads: `weights.pt` and `config.json`. Existing files are not
/// replaced, because nothing in them shows which program wrote them. What a killed export left unfinished is deleted.
pub(crate) fn write(folder: &Path, config: &impl Serialize, weights: &Named<HostTensor>) -> Result<()> {
    let _lock = Lock::folder(folder)?;
    let (path, weights_path) = (folder.join(CONFIG), folder.join(EXPORTED_WEIGHTS));
    [&path, &weights_path].into_iter().try_for_each(|path| files::check_free(path))?;
    files::delete_temporary(folder, |name| name == CONFIG || name == EXPORTED_WEIGHTS)?;
    torch::write(&weights_path, weights)?;
    let text = serde_json::to_string_pretty(config).map_err(|error| Error::external("writing JSON", error))?;
    files::write(&path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exports_replace_no_file_but_what_a_killed_one_left_unfinished() {
        let folder = tempfile::tempdir().expect("a folder");
        let [unfinished, weights] = [".weights.pt.7.tmp", "weights.pt"].map(|name| folder.path().join(name));
        std::fs::write(&unfinished, "PK").expect("what a kill leaves");
        let tensors = Named::from([("a".to_owned(), HostTensor { shape: vec![1], values: vec![0.5] })]);
        let held = Lock::folder(folder.path()).expect("locking the folder as another export does");
        let error = write(folder.path(), &serde_json::json!({}), &tensors).expect_err("another export").to_string();
        assert!(error.contains("another process writes to it"), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).expect("listing the folder").count(), 1, "nothing is written");
        drop(held);
        write(folder.path(), &serde_json::json!({}), &tensors).expect("an export");
        assert!(!unfinished.exists() && weights.is_file());
        let error = write(folder.path(), &serde_json::json!({}), &tensors).expect_err("existing files").to_string();
        assert!(error.contains("config.json") && error.contains("not replaced"), "{error}");
    }
}
