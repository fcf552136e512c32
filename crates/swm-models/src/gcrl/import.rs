//! Import and export of goal-conditioned checkpoints of the reference implementation (class `GCRL`).
//!
//! The published training scripts store the script's settings as `config.json`, while `load_pretrained` requires a tree
//! of classes. So sizes are read from the weights, and only the number of attention heads is read from `config.json`.

use super::config::GcrlConfig;
use super::loss::LOG_STD;
use super::model::{Gcbc, Gciql, Gcivl};
use super::train::{GoalConditioned, METRIC_FAMILIES};
use super::transformer::TransformerConfig;
use crate::checkpoint::Checkpoint;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::nn::{BackboneConfig, DinoConfig, Init, VitConfig};
use crate::pixels::ImageNormalization;
use crate::train::{DatasetInfo, TrainConfig, limits};
use crate::weights::reference::write;
use crate::weights::{self, Naming, names};
use burn::tensor::Device;
use serde_json::{Value, json};
use std::path::Path;
use swm_core::{Error, Manifest, Result, files};

const CLASS: &str = "stable_worldmodel.wm.gcrl.GCRL";
const MODULE: &str = "stable_worldmodel.wm.gcrl.module";

/// Converts a model of the reference implementation: a folder with `weights.pt` and `config.json`, or a weights file
/// beside a `config.json`. The files do not store how actions were normalised, so `dataset_info` must describe the
/// model's training dataset.
///
/// A published checkpoint has no target networks; the target networks are initialised with the weights of the value
/// networks and critics.
///
/// # Errors
/// When a network of the family is missing (policies of GCIQL are stored without the critic: import them as `gcivl`),
/// the model has inputs other than images, a file is damaged, or the action dimension does not fit `dataset_info`.
pub fn import<M>(from: &Path, dataset_info: DatasetInfo) -> Result<Checkpoint<M>>
where
    M: GoalConditioned<Config = GcrlConfig>,
{
    let path = if from.is_dir() { from.join("weights.pt") } else { from.to_owned() };
    let mut found = StoredWeights { weights: without_wrappers(weights::read(&path)?, &path)?, path: &path };
    let settings = path.with_file_name("config.json");
    let text = files::read(&settings, limits::JSON_BYTES)?;
    let settings: Value = serde_json::from_slice(&text).map_err(|error| found.wrong(error.to_string()))?;
    if found.weights.keys().any(|name| name.starts_with("extra_encoders.")) {
        return Err(found.wrong("it has inputs other than images".to_owned()));
    }
    let sizes = found.sizes(&settings)?;
    let action_dim = found.shape("log_stds")?[0];
    let mut config = TrainConfig::<M>::load("paper", &[])?;
    let dim = dataset_info.action.dim();
    if dim == 0 || !action_dim.is_multiple_of(dim) {
        return Err(Error::mismatch(
            "importing a policy",
            format!("{dim} action elements in the dataset"),
            format!("a divisor of {action_dim}, the action elements of a model step"),
        ));
    }
    config.data.frameskip = action_dim / dim;
    config.data.num_steps = config.data.num_steps - config.model.history + sizes.history;
    let metric = if METRIC_FAMILIES.contains(&M::FAMILY) { sizes.metric } else { 0 };
    config.model = GcrlConfig { weights: path.display().to_string(), metric, ..sizes };
    config.check()?;
    let init = Init::for_weights(&found.weights, &Device::flex());
    let initial = M::new(&config, &dataset_info, &init)?;
    init.check()?;
    let expected = parameters::shapes(&initial);
    found.weights.retain(|name, _| expected.contains_key(name) || !is_optional(name));
    let model = weights::fill(initial, &found.weights, &path, &format!("a {}", M::FAMILY))?;
    let manifest = Manifest::new("import", 0, json!({ "from": from.display().to_string() }));
    Ok(Checkpoint { model, config, dataset_info, manifest })
}

/// Returns whether a weight belongs to a network that only some families have.
fn is_optional(name: &str) -> bool {
    ["value_predictor.", "critic_predictor."].iter().any(|part| name.starts_with(part))
}

/// Removes wrapper prefixes and attention masks, and copies the weights of value networks and critics to the
/// target networks.
///
/// # Errors
/// When the file `path` has a weight with its wrapper and without.
fn without_wrappers(weights: Named<HostTensor>, path: &Path) -> Result<Named<HostTensor>> {
    let mut plain = Named::new();
    for (stored, weight) in weights {
        let name = stored.replacen(".backbone.", ".", 1);
        if name.ends_with(".causal_mask") || name == "encoder.embeddings.mask_token" && weight.shape.len() == 3 {
            continue;
        }
        let found =
            ["value_predictor", "critic_predictor"].into_iter().find_map(|part| Some((part, name.strip_prefix(part)?)));
        let of = (&*stored, path);
        match found {
            Some((part, rest)) if !rest.starts_with(".student.") && !rest.starts_with(".teacher.") => {
                names::insert(&mut plain, format!("{part}.student{rest}"), weight.clone(), of)?;
                names::insert(&mut plain, format!("{part}.teacher{rest}"), weight, of)?;
            }
            _ => names::insert(&mut plain, name, weight, of)?,
        }
    }
    names::to_published(plain, "encoder.", path)
}

/// Weights and the path of the weights file.
struct StoredWeights<'a> {
    weights: Named<HostTensor>,
    path: &'a Path,
}

impl StoredWeights<'_> {
    fn wrong(&self, problem: String) -> Error {
        Error::corrupt(self.path, problem, "give a checkpoint of the reference implementation's class GCRL")
    }

    fn shape(&self, name: &str) -> Result<&[usize]> {
        let shape = self.weights.get(name).map(|weight| weight.shape.as_slice());
        shape.filter(|shape| !shape.is_empty()).ok_or_else(|| self.wrong(format!("'{name}' is missing")))
    }

    /// Returns the size of an axis of a weight.
    fn axis_size(&self, name: &str, axis: usize) -> Result<usize> {
        self.shape(name)?.get(axis).copied().ok_or_else(|| self.wrong(format!("'{name}' has no axis {axis}")))
    }

    /// Counts the weights whose names start with `prefix` and end with `suffix`.
    fn count(&self, prefix: &str, suffix: &str) -> usize {
        self.weights.keys().filter(|name| name.starts_with(prefix) && name.ends_with(suffix)).count()
    }

    fn sizes(&self, settings: &Value) -> Result<GcrlConfig> {
        let setting = |path: [&str; 2]| settings[path[0]][path[1]].as_u64().and_then(|n| usize::try_from(n).ok());
        let encoder = |name: &str| format!("encoder.{name}");
        let (dim, patch) = {
            let name = encoder("embeddings.patch_embeddings.projection.weight");
            (self.axis_size(&name, 0)?, self.axis_size(&name, 2)?)
        };
        // The attention heads of all published models have 64 features.
        let heads = setting(["encoder", "num_attention_heads"]).unwrap_or((dim / 64).max(1));
        let encoder = if self.weights.contains_key("encoder.encoder.layer.0.layer_scale1.lambda1") {
            BackboneConfig::Dinov2(DinoConfig {
                patch,
                dim,
                depth: self.count("encoder.encoder.layer.", ".norm1.weight"),
                heads,
                mlp: self.axis_size(&encoder("encoder.layer.0.mlp.fc1.weight"), 0)?,
                grid: self.axis_size(&encoder("embeddings.position_embeddings"), 1)?.saturating_sub(1).isqrt(),
                registers: self.axis_size(&encoder("embeddings.register_tokens"), 1).unwrap_or(0),
            })
        } else {
            BackboneConfig::Vit(VitConfig {
                patch,
                dim,
                depth: self.count("encoder.encoder.layer.", ".layernorm_before.weight"),
                heads,
                mlp: self.axis_size(&encoder("encoder.layer.0.intermediate.dense.weight"), 0)?,
            })
        };
        let policy = |name: &str| format!("action_predictor.{name}");
        let patches = self.axis_size(&policy("pos_embedding_goal"), 1)?;
        let inner = self.axis_size(&policy("transformer.layers.0.0.to_q.weight"), 0)?;
        let heads = setting(["action_predictor", "heads"]).or(setting(["predictor", "heads"])).unwrap_or(inner / 64);
        if heads == 0 || !inner.is_multiple_of(heads) {
            return Err(self.wrong(format!("{inner} features do not split into {heads} attention heads")));
        }
        let (pixel_mean, pixel_std) = ImageNormalization::IMAGENET;
        let critic = self.axis_size("critic_predictor.student.q_head.0.bias", 0).unwrap_or(256);
        Ok(GcrlConfig {
            image: patches.isqrt().saturating_mul(patch),
            pixel_mean,
            pixel_std,
            history: self.axis_size(&policy("pos_embedding"), 1)? / patches.max(1),
            frozen: true,
            weights: String::new(),
            encoder,
            head: TransformerConfig {
                depth: self.count(&policy("transformer.layers."), ".0.norm.weight"),
                heads,
                dim_head: inner / heads,
                mlp: self.axis_size(&policy("transformer.layers.0.1.net.1.weight"), 0)?,
                dropout: 0.0,
                emb_dropout: 0.0,
            },
            critic,
            metric: self.axis_size("value_predictor.student.embed_proj.bias", 0).unwrap_or(0),
        })
    }
}

/// A model for which the reference implementation has a class.
pub trait Exportable: GoalConditioned {
    /// The names of the networks besides encoder and policy, and the reference implementation's class of each network.
    const PARTS: &'static [(&'static str, &'static str)];
}

impl Exportable for Gcbc {
    const PARTS: &'static [(&'static str, &'static str)] = &[];
}

impl Exportable for Gcivl {
    const PARTS: &'static [(&'static str, &'static str)] = &[("value_predictor", "Predictor")];
}

impl Exportable for Gciql {
    const PARTS: &'static [(&'static str, &'static str)] =
        &[("value_predictor", "Predictor"), ("critic_predictor", "QPredictor")];
}

/// Writes the `weights.pt` and `config.json` that `load_pretrained` of the reference implementation reads, without
/// target networks.
///
/// # Errors
/// When the reference implementation has no class for the encoder, or a file cannot be written.
pub fn export<M>(checkpoint: &Checkpoint<M>, folder: &Path, naming: Naming) -> Result<()>
where
    M: Exportable<Config = GcrlConfig>,
{
    let (sizes, action_dim) = (&checkpoint.config.model, checkpoint.action_dim());
    let encoder = match &sizes.encoder {
        BackboneConfig::Vit(VitConfig { patch, dim, depth, heads, mlp }) => json!({
            "_target_": "stable_pretraining.backbone.utils.vit_hf",
            "size": "tiny", "patch_size": patch, "image_size": sizes.image, "pretrained": false, "use_mask_token": false,
            "hidden_size": dim, "num_hidden_layers": depth, "num_attention_heads": heads, "intermediate_size": mlp,
        }),
        BackboneConfig::Dinov2(dino) if matches!(dino.dim, 384 | 768 | 1024) && dino.registers == 0 => {
            let name = match dino.dim {
                384 => "facebook/dinov2-small",
                768 => "facebook/dinov2-base",
                _ => "facebook/dinov2-large",
            };
            json!({ "_target_": "transformers.AutoModel.from_pretrained", "_args_": [name] })
        }
        _ => {
            return Err(Error::config(
                "exporting a model",
                "the reference implementation has no class for the model's encoder",
                "train with model.encoder.vit or a published DINOv2",
            ));
        }
    };
    let (grid, head) = (sizes.patch_grid(), &sizes.head);
    let class = |class: &str, pool: &str| {
        json!({
            "_target_": format!("{MODULE}.{class}"),
            "num_patches": grid.patches, "num_frames": grid.frames, "dim": grid.dim, "pool_type": pool,
            "depth": head.depth, "heads": head.heads, "dim_head": head.dim_head, "mlp_dim": head.mlp,
            "dropout": head.dropout, "emb_dropout": head.emb_dropout,
        })
    };
    let mut policy = class("Predictor", "attention");
    policy["out_dim"] = json!(action_dim);
    let mut tree = json!({
        "_target_": CLASS, "encoder": encoder, "action_predictor": policy, "history_size": sizes.history,
        "log_std_min": LOG_STD[0], "log_std_max": LOG_STD[1],
    });
    for &(part, kind) in M::PARTS {
        let mut network = class(kind, "mean");
        if kind == "QPredictor" {
            (network["action_dim"], network["q_hidden_dim"]) = (json!(action_dim), json!(sizes.critic));
        } else if sizes.metric > 0 {
            network = class("MetricValuePredictor", "attention");
            network["embed_dim"] = json!(sizes.metric);
            network.as_object_mut().map(|network| network.remove("pool_type"));
        } else {
            network["out_dim"] = json!(1);
        }
        tree[part] = network;
    }
    write(folder, &tree, &state(&checkpoint.model, sizes, naming))
}

/// Returns the state dict of a model in the layout of the reference implementation: with attention masks, without
/// target networks.
fn state<M: GoalConditioned>(model: &M, sizes: &GcrlConfig, naming: Naming) -> Named<HostTensor> {
    let grid = sizes.patch_grid();
    let keys = grid.frames * grid.patches;
    let mask = |queries: usize| {
        let frame = |query: usize| query * grid.frames / queries;
        let is_visible = |index: usize| index % keys / grid.patches <= frame(index / keys);
        let values = (0..queries * keys).map(|index| if is_visible(index) { 1.0 } else { 0.0 }).collect();
        HostTensor { shape: vec![1, 1, queries, keys], values }
    };
    let mut weights = Named::new();
    for (name, weight) in parameters::values(model) {
        if name.contains(".teacher.") {
            continue;
        }
        let name = name.replacen(".student.", ".", 1);
        // Every layer that does not attend to the goal has a mask.
        if let Some(layer) = name.strip_suffix(".0.to_q.weight")
            && let Some(index) = layer.rsplit('.').next().and_then(|index| index.parse::<usize>().ok())
        {
            let is_metric = sizes.metric > 0 && layer.starts_with("value_predictor.");
            let pools = (is_metric || layer.starts_with("action_predictor.")) && index + 1 == sizes.head.depth;
            if pools || is_metric || index.is_multiple_of(2) {
                weights.insert(format!("{layer}.0.causal_mask"), mask(if pools { grid.frames } else { keys }));
            }
        }
        weights.insert(name, weight);
    }
    names::to_naming(weights, "encoder.", naming)
}
