//! DINO-WM checkpoints of the reference implementation (its class `PreJEPA`), both ways.

use super::config::{ACTION, ColumnConfig, DinoWmConfig};
use super::model::DinoWm;
use super::predictor::FramePredictorConfig;
use crate::checkpoint::Checkpoint;
use crate::nn::BackboneConfig;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::pixels::ImageNormalization;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::keys::InOrder;
use crate::weights::reference::{Reference, write};
use crate::weights::{self, Naming, names};
use burn::tensor::Device;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::Path;
use swm_core::{Error, Key, Manifest, Result};

const MODULES: &str = "stable_worldmodel.wm.prejepa.module";
const CLASS: &str = "stable_worldmodel.wm.PreJEPA";

/// A DINO-WM that the reference trained: a folder with `weights.pt` and `config.json`, or that file. What it does not
/// store is how columns were normalised, so `dataset_info` must be those of its dataset.
///
/// # Errors
/// When it is another model, its encoder is no DINOv2, it is damaged, or its columns are not those in `dataset_info`.
pub fn import(from: &Path, dataset_info: DatasetInfo) -> Result<Checkpoint<DinoWm>> {
    let mut reference = Reference::open(from, "PreJEPA")?;
    // A wrapper that keeps the encoder from training adds its name.
    let weights = std::mem::take(&mut reference.weights);
    let plain = |name: String| match name.strip_prefix("backbone.backbone.") {
        Some(rest) => format!("backbone.{rest}"),
        None => name,
    };
    reference.weights = weights.into_iter().map(|(name, tensor)| (plain(name), tensor)).collect();
    // The masks of the attention are computed here.
    reference.weights.retain(|name, weight| !is_mask(name, &weight.shape));
    let dino = reference.dinov2("backbone.")?;

    let size = |at: &str| reference.size(at);
    let (mut columns, mut numbers, mut frameskip) = (vec![], vec![], 1);
    let listed = reference.keys.at("extra_encoders.modules").map_or(&[][..], |keys| &keys.0);
    for name in listed.iter().map(|(name, _)| name.clone()) {
        let weight = reference.shape(&format!("extra_encoders.{name}.patch_embed.weight"))?;
        let [dim, given, _] = *weight else {
            return Err(reference.wrong(format!("the encoder of '{name}' is no convolution over time")));
        };
        let wanted = if name == ACTION { dataset_info.action.dim() } else { dataset_info.column(&name)?.dim() };
        let whole = if name == ACTION { given.is_multiple_of(wanted.max(1)) } else { given == wanted };
        if !whole {
            return Err(Error::mismatch(
                format!("importing the column '{name}'"),
                format!("{wanted} numbers in the dataset"),
                format!("{given}, as the model was trained"),
            ));
        }
        if name == ACTION {
            frameskip = given / wanted.max(1);
        }
        columns.push(ColumnConfig { name, dim });
        numbers.push(given);
    }
    let (mean, std) = ImageNormalization::IMAGENET;
    let sizes = DinoWmConfig {
        image: size("predictor.num_patches")?.isqrt() * dino.patch,
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
    let model = DinoWm::init(&sizes, &numbers, Key::new(0), &Device::flex());
    let model = weights::fill(model, &reference.weights, &reference.path, "config.json")?;
    let mut config = TrainConfig::<DinoWm>::load("paper", &[])?;
    config.data.num_steps = sizes.predictor.history + 1;
    config.data.frameskip = frameskip;
    config.model = sizes;
    config.check()?;
    let manifest = Manifest::new("import", 0, json!({ "from": from.display().to_string() }));
    Ok(Checkpoint { model, config, dataset_info, manifest })
}

/// Writes `weights.pt` and `config.json` that the reference's `load_pretrained` reads.
///
/// # Errors
/// When the encoder is no published DINOv2, or the disk refuses.
pub fn export(checkpoint: &Checkpoint<DinoWm>, folder: &Path, naming: Naming) -> Result<()> {
    let (model, sizes) = (&checkpoint.model, &checkpoint.config.model);
    let name = match &sizes.encoder {
        BackboneConfig::Dinov2(dino) if dino.dim == 384 && dino.registers == 0 => "dinov2_small",
        BackboneConfig::Dinov2(dino) if dino.dim == 768 && dino.registers == 0 => "dinov2_base",
        BackboneConfig::Dinov2(dino) if dino.dim == 1024 && dino.registers == 0 => "dinov2_large",
        _ => {
            return Err(Error::config(
                "exporting a model",
                "the reference makes its encoder from a published one, and this is none",
                "train with DINOv2-small, -base or -large",
            ));
        }
    };
    let predictor = &sizes.predictor;
    let encoders = model.extra_encoders.iter().map(|(name, encoder)| {
        let [dim, numbers, _] = encoder.patch_embed.weight.dims();
        let class = format!("{MODULES}.Embedder");
        (name.to_owned(), json!({ "_target_": class, "in_chans": numbers, "emb_dim": dim }))
    });
    // Its columns are applied in the order of the file.
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
    write(folder, &Tree { rest: config, extra_encoders: encoders }, &state(model, naming))
}

/// The content of `config.json`.
#[derive(Serialize)]
struct Tree {
    #[serde(flatten)]
    rest: Value,
    extra_encoders: ExtraEncoders,
}

/// The encoders of columns.
#[derive(Serialize)]
struct ExtraEncoders {
    _target_: &'static str,
    modules: InOrder<Value>,
}

/// The state dict of a model, as the reference's class has it: without the decoder, with the masks of the attention.
pub fn state(model: &DinoWm, naming: Naming) -> Named<HostTensor> {
    let mut weights = parameters::values(model);
    weights.retain(|name, _| !name.starts_with("decoder."));
    let patches = model.predictor.patches();
    let tokens = model.predictor.config().history * patches;
    let seen = |place: usize| (place % tokens) / patches <= (place / tokens) / patches;
    let values: Vec<f32> = (0..tokens * tokens).map(|place| if seen(place) { 1.0 } else { 0.0 }).collect();
    for layer in 0..model.predictor.config().depth {
        let mask = HostTensor { shape: vec![1, 1, tokens, tokens], values: values.clone() };
        weights.insert(format!("predictor.transformer.layers.{layer}.0.bias"), mask);
    }
    names::to_naming(weights, "backbone.", naming)
}

fn is_mask(name: &str, shape: &[usize]) -> bool {
    name.starts_with("predictor.transformer.layers.") && name.ends_with(".0.bias") && shape.len() == 4
}
