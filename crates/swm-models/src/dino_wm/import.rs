//! Import and export of DINO-WM checkpoints of the reference implementation (class `PreJEPA`).

use super::config::{ACTION, ColumnConfig, DinoWmConfig};
use super::model::DinoWm;
use super::predictor::FramePredictorConfig;
use crate::checkpoint::Checkpoint;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::nn::{BackboneConfig, Init};
use crate::pixels::ImageNormalization;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::keys::InOrder;
use crate::weights::reference::{Reference, write};
use crate::weights::{self, Naming, names};
use burn::tensor::Device;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::Path;
use swm_core::{Error, Manifest, Result};

const MODULES: &str = "stable_worldmodel.wm.prejepa.module";
const CLASS: &str = "stable_worldmodel.wm.PreJEPA";

/// Converts a DINO-WM of the reference implementation: a folder with `weights.pt` and `config.json`, or the path of the
/// weights. The files do not store how columns were normalised, so `dataset_info` must describe the model's training
/// dataset.
///
/// # Errors
/// When a file is damaged or holds another model, the encoder is not DINOv2, or a column is missing from
/// `dataset_info` or has another number of elements.
pub fn import(from: &Path, dataset_info: DatasetInfo) -> Result<Checkpoint<DinoWm>> {
    let mut reference = Reference::open(from, "PreJEPA")?;
    // The reference implementation's wrapper of the frozen encoder adds the prefix `backbone.` to parameter names.
    let weights = std::mem::take(&mut reference.weights);
    let without_wrapper = |name: String| match name.strip_prefix("backbone.backbone.") {
        Some(rest) => format!("backbone.{rest}"),
        None => name,
    };
    reference.weights = weights.into_iter().map(|(name, tensor)| (without_wrapper(name), tensor)).collect();
    // Attention masks are computed, not loaded.
    reference.weights.retain(|name, weight| !is_mask(name, &weight.shape));
    let dino = reference.dinov2("backbone.")?;

    let size = |path: &str| reference.size(path);
    let Columns { columns, widths, frameskip } = columns(&reference, &dataset_info)?;
    let (mean, std) = ImageNormalization::IMAGENET;
    let sizes = DinoWmConfig {
        image: size("predictor.num_patches")?.isqrt().saturating_mul(dino.patch),
        pixel_mean: mean,
        pixel_std: std,
        weights: String::new(),
        encoder: BackboneConfig::Dinov2(dino),
        columns,
        predictor: FramePredictorConfig {
            history: size("predictor.num_frames")?,
            depth: size("predictor.depth")?,
            heads: size("predictor.heads")?,
            dim_head: reference.size_or("predictor.dim_head", Some(64))?,
            mlp: size("predictor.mlp_dim")?,
            dropout: reference.rate("predictor.dropout"),
            emb_dropout: reference.rate("predictor.emb_dropout"),
        },
        decoder: 0,
    };
    sizes.check()?;
    let init = Init::for_weights(&reference.weights, &Device::flex());
    let model = DinoWm::init(&sizes, &widths, &init);
    init.check()?;
    let model = weights::fill(model, &reference.weights, &reference.path, "config.json")?;
    let mut config = TrainConfig::<DinoWm>::load("paper", &[])?;
    config.data.num_steps = sizes.predictor.history + 1;
    config.data.frameskip = frameskip;
    config.model = sizes;
    config.check()?;
    let manifest = Manifest::new("import", 0, json!({ "from": from.display().to_string() }));
    Ok(Checkpoint { model, config, dataset_info, manifest })
}

/// The columns of a checkpoint, their element counts, and the number of environment steps in a model step.
struct Columns {
    columns: Vec<ColumnConfig>,
    widths: Vec<usize>,
    frameskip: usize,
}

/// Reads the columns in the order of the checkpoint, and compares them with the dataset.
fn columns(reference: &Reference, dataset_info: &DatasetInfo) -> Result<Columns> {
    let (mut columns, mut widths, mut frameskip) = (vec![], vec![], 1);
    let listed = reference.keys.at("extra_encoders.modules").map_or(&[][..], |keys| &keys.0);
    for name in listed.iter().map(|(name, _)| name.clone()) {
        let weight = reference.shape(&format!("extra_encoders.{name}.patch_embed.weight"))?;
        let [dim, given, _] = *weight else {
            return Err(reference.wrong(format!("the encoder of '{name}' is not a convolution over time")));
        };
        let expected = if name == ACTION { dataset_info.action.dim() } else { dataset_info.column(&name)?.dim() };
        let fits = if name == ACTION { given.is_multiple_of(expected.max(1)) } else { given == expected };
        if !fits {
            return Err(Error::mismatch(
                format!("importing the column '{name}'"),
                format!("{expected} elements in the dataset"),
                format!("{given}, as the model was trained"),
            ));
        }
        if name == ACTION {
            frameskip = given / expected.max(1);
        }
        columns.push(ColumnConfig { name, dim });
        widths.push(given);
    }
    Ok(Columns { columns, widths, frameskip })
}

/// Writes the `weights.pt` and `config.json` that `load_pretrained` of the reference implementation reads.
///
/// # Errors
/// When the encoder is not a published DINOv2, or a file cannot be written.
pub fn export(checkpoint: &Checkpoint<DinoWm>, folder: &Path, naming: Naming) -> Result<()> {
    let (model, sizes) = (&checkpoint.model, &checkpoint.config.model);
    let name = match &sizes.encoder {
        BackboneConfig::Dinov2(dino) if dino.dim == 384 && dino.registers == 0 => "dinov2_small",
        BackboneConfig::Dinov2(dino) if dino.dim == 768 && dino.registers == 0 => "dinov2_base",
        BackboneConfig::Dinov2(dino) if dino.dim == 1024 && dino.registers == 0 => "dinov2_large",
        _ => {
            return Err(Error::config(
                "exporting a model",
                "the reference implementation requires a published DINOv2, and the model has another encoder",
                "train with DINOv2-small, -base or -large",
            ));
        }
    };
    let predictor = &sizes.predictor;
    let encoders = model.extra_encoders.iter().map(|(name, encoder)| {
        let [dim, elements, _] = encoder.patch_embed.weight.dims();
        let class = format!("{MODULES}.Embedder");
        (name.to_owned(), json!({ "_target_": class, "in_chans": elements, "emb_dim": dim }))
    });
    // The reference implementation applies columns in the order of the file.
    let encoders = ExtraEncoders { _target_: "torch.nn.ModuleDict", modules: InOrder(encoders.collect()) };
    let config = json!({
        "_target_": CLASS,
        "history_size": predictor.history,
        "num_pred": 1,
        "interpolate_pos_encoding": true,
        "encoder": { "_target_": format!("{MODULES}.create_backbone"), "name": name },
        "predictor": {
            "_target_": format!("{MODULES}.CausalPredictor"),
            "num_patches": sizes.patches(), "num_frames": predictor.history, "dim": sizes.dim(),
            "depth": predictor.depth, "heads": predictor.heads, "dim_head": predictor.dim_head,
            "mlp_dim": predictor.mlp, "dropout": predictor.dropout, "emb_dropout": predictor.emb_dropout,
        },
    });
    write(folder, &ReferenceConfig { config, extra_encoders: encoders }, &state(model, naming))
}

/// The content of the reference implementation's `config.json`.
#[derive(Serialize)]
struct ReferenceConfig {
    /// All fields except `extra_encoders`.
    #[serde(flatten)]
    config: Value,
    extra_encoders: ExtraEncoders,
}

/// The encoders of columns, in the order of the model's configuration.
#[derive(Serialize)]
struct ExtraEncoders {
    _target_: &'static str,
    modules: InOrder<Value>,
}

/// Returns the state dict of a model in the layout of the reference implementation: without the decoder, with attention
/// masks.
pub fn state(model: &DinoWm, naming: Naming) -> Named<HostTensor> {
    let mut weights = parameters::values(model);
    weights.retain(|name, _| !name.starts_with("decoder."));
    let patches = model.predictor.patches();
    let tokens = model.predictor.config().history * patches;
    let is_visible = |index: usize| (index % tokens) / patches <= (index / tokens) / patches;
    let values: Vec<f32> = (0..tokens * tokens).map(|index| if is_visible(index) { 1.0 } else { 0.0 }).collect();
    for layer in 0..model.predictor.config().depth {
        let mask = HostTensor { shape: vec![1, 1, tokens, tokens], values: values.clone() };
        weights.insert(format!("predictor.transformer.layers.{layer}.0.bias"), mask);
    }
    names::to_naming(weights, "backbone.", naming)
}

fn is_mask(name: &str, shape: &[usize]) -> bool {
    name.starts_with("predictor.transformer.layers.") && name.ends_with(".0.bias") && shape.len() == 4
}
