//! Import and export of LeWM checkpoints of the reference implementation. PLDM checkpoints differ in the class only.

use super::config::{EncoderConfig, LewmConfig};
use super::model::Lewm;
use crate::checkpoint::Checkpoint;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::nn::{Init, PredictorConfig, VitConfig};
use crate::pixels::ImageNormalization;
use crate::train::{DatasetInfo, TrainConfig, check_sizes, limits};
use crate::weights::reference::{Reference, write};
use crate::weights::{self, BATCHES_TRACKED, Naming, names};
use burn::tensor::Device;
use serde_json::{Value, json};
use std::path::Path;
use swm_core::{Error, Manifest, Result};

/// The Python module with the building blocks of the reference implementation's LeWM.
const MODULES: &str = "stable_worldmodel.wm.lewm.module";
const CLASS: &str = "stable_worldmodel.wm.lewm.LeWM";

/// Converts a LeWM of the reference implementation: a folder with `weights.pt` and `config.json`, or the path of the
/// weights. The files do not store how actions were normalised, so `dataset_info` must describe the model's training
/// dataset.
///
/// # Errors
/// When a file is damaged or holds another model or an unsupported variant, or the model's action dimension is not a
/// multiple of the action dimension in `dataset_info`.
pub fn import(from: &Path, dataset_info: DatasetInfo) -> Result<Checkpoint<Lewm>> {
    let (model, sizes, frameskip) = world_model(Reference::open(from, "LeWM")?, &dataset_info)?;
    let mut config = TrainConfig::<Lewm>::load("paper", &[])?;
    config.data.num_steps = sizes.predictor.history + 1;
    config.data.frameskip = frameskip;
    config.model = sizes;
    config.check()?;
    let manifest = Manifest::new("import", 0, json!({ "from": from.display().to_string() }));
    Ok(Checkpoint { model, config, dataset_info, manifest })
}

/// Writes the `weights.pt` and `config.json` that `load_pretrained` of the reference implementation reads.
///
/// # Errors
/// When the encoder is not a vision transformer, or a file cannot be written.
pub fn export(checkpoint: &Checkpoint<Lewm>, folder: &Path, naming: Naming) -> Result<()> {
    let config = tree(&checkpoint.config.model, checkpoint.action_dim(), CLASS, MODULES)?;
    write(folder, &config, &state(&checkpoint.model, naming))
}

/// Returns the world model of a checkpoint, the model configuration, and the number of environment steps in a model
/// step.
///
/// # Errors
/// As [`import`].
pub(crate) fn world_model(mut reference: Reference, dataset_info: &DatasetInfo) -> Result<(Lewm, LewmConfig, usize)> {
    let (vit, image) = reference.vit("encoder")?;
    for part in ["projector", "pred_proj"] {
        let norm = reference.class(&format!("{part}.norm_fn"));
        if norm != "BatchNorm1d" {
            return Err(reference.wrong(format!("the module '{part}' has '{norm}' where BatchNorm1d is expected")));
        }
    }
    let size = |path: &str| reference.size(path);
    let latent = size("projector.output_dim")?;
    let (mean, std) = ImageNormalization::IMAGENET;
    let predictor = PredictorConfig {
        history: size("predictor.num_frames")?,
        dim: size("predictor.hidden_dim")?,
        depth: size("predictor.depth")?,
        heads: size("predictor.heads")?,
        dim_head: reference.size_or("predictor.dim_head", Some(64))?,
        mlp: size("predictor.mlp_dim")?,
        dropout: reference.rate("predictor.dropout"),
        emb_dropout: reference.rate("predictor.emb_dropout"),
    };
    let config = LewmConfig {
        image,
        pixel_mean: mean,
        pixel_std: std,
        latent,
        smoothed: reference.size_or("action_encoder.smoothed_dim", Some(10))?,
        projector: size("projector.hidden_dim")?,
        encoder: EncoderConfig::Vit(vit),
        predictor,
        decoder: None,
    };
    let action_dim = size("action_encoder.input_dim")?;
    let dim = dataset_info.action.dim();
    if dim == 0 || !action_dim.is_multiple_of(dim) {
        return Err(Error::mismatch(
            "importing a checkpoint",
            format!("{dim} action elements in the dataset"),
            format!("a divisor of {action_dim}, the action elements of a model step"),
        ));
    }
    config.check()?;
    let init = Init::for_weights(&reference.weights, &Device::flex());
    check_sizes(&[("action_encoder.input_dim", action_dim, 1, limits::FEATURES)])?;
    let model = Lewm::init(&config, action_dim, &init);
    init.check()?;
    let model = weights::fill(model, &reference.weights, &reference.path, "config.json")?;
    Ok((model, config, action_dim / dim))
}

/// Returns the state dict of a world model in the layout of the reference implementation.
pub(crate) fn state(model: &Lewm, naming: Naming) -> Named<HostTensor> {
    let mut weights = names::to_naming(parameters::values(model), "encoder.", naming);
    for part in ["projector", "pred_proj"] {
        let counter = HostTensor { shape: vec![], values: vec![0.0] };
        weights.insert(format!("{part}.net.1.{BATCHES_TRACKED}"), counter);
    }
    weights
}

/// Returns the tree of classes, as JSON, from which the reference implementation builds a world model.
///
/// # Errors
/// When the encoder is not a vision transformer.
pub(crate) fn tree(config: &LewmConfig, action_dim: usize, class: &str, modules: &str) -> Result<Value> {
    let EncoderConfig::Vit(VitConfig { patch, dim, depth, heads, mlp }) = &config.encoder else {
        return Err(Error::config(
            "exporting a model",
            "the reference implementation builds this model with a vision transformer only",
            "train with model.encoder.vit, as the preset `paper` does",
        ));
    };
    let (predictor, latent) = (&config.predictor, config.latent);
    let project = |inputs: usize| {
        json!({
            "_target_": format!("{modules}.MLP"),
            "input_dim": inputs, "hidden_dim": config.projector, "output_dim": latent,
            "norm_fn": { "_target_": "torch.nn.BatchNorm1d", "_partial_": true },
        })
    };
    Ok(json!({
        "_target_": class,
        "encoder": {
            "_target_": "stable_pretraining.backbone.utils.vit_hf",
            "size": "tiny", "patch_size": patch, "image_size": config.image, "pretrained": false, "use_mask_token": false,
            "hidden_size": dim, "num_hidden_layers": depth, "num_attention_heads": heads, "intermediate_size": mlp,
        },
        "predictor": {
            "_target_": format!("{modules}.Predictor"),
            "num_frames": predictor.history, "input_dim": latent, "hidden_dim": predictor.dim, "output_dim": latent,
            "depth": predictor.depth, "heads": predictor.heads, "dim_head": predictor.dim_head,
            "mlp_dim": predictor.mlp, "dropout": predictor.dropout, "emb_dropout": predictor.emb_dropout,
        },
        "action_encoder": {
            "_target_": format!("{modules}.Embedder"),
            "input_dim": action_dim,
            "smoothed_dim": if config.smoothed == 0 { action_dim } else { config.smoothed },
            "emb_dim": latent,
        },
        "projector": project(*dim),
        "pred_proj": project(latent),
    }))
}
