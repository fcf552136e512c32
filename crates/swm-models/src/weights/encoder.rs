//! [`fill`]: the weights of an encoder from a file of an encoder, or of a model with one.

use super::{locate, names, read};
use crate::capsule::Capsule;
use crate::nn::parameters::{self, HostTensor, Named};
use crate::nn::{Backbone, BackboneConfig, KeypointsConfig};
use crate::pixels::ImageNormalization;
use crate::run_folder;
use crate::stored::StoredCheckpoint;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::path::Path;
use swm_core::{Error, Result};

/// The names under which models hold their encoder, after that of an encoder alone.
const PREFIXES: [&str; 4] = ["", "encoder.", "model.encoder.", "backbone."];

/// Replaces the weights of an encoder with this configuration by those in the file or repository `from`; without `from`, returns
/// the encoder as it is.
///
/// # Errors
/// When the file cannot be read, holds no encoder of this size, is part of a damaged checkpoint or capsule, or is that of a model
/// here with another part that is not trained (filters, colours) or other images.
pub(crate) fn fill(
    encoder: Backbone,
    (config, images): (&BackboneConfig, &ImageNormalization),
    from: &str,
    cache: &Path,
) -> Result<Backbone> {
    if from.is_empty() {
        return Ok(encoder);
    }
    let path = locate(from, cache)?;
    let found = match stored(&path)? {
        Some(stored) => {
            stored.check_config()?;
            if let Some(model) = stored.content().get("config").and_then(|config| config.get("model")) {
                check_same_inputs(model, config, images, &path)?;
            }
            stored.weights()?
        }
        None => read(&path)?,
    };
    let found = names::to_published(found, "", &path)?;
    let shapes = parameters::shapes(&encoder);
    let count = |prefix: &&&str| shapes.keys().filter(|name| found.contains_key(&format!("{prefix}{name}"))).count();
    // The first of those that hold the most weights.
    let prefix = PREFIXES.iter().rev().max_by_key(count).copied().unwrap_or_default();
    let without_prefix = |(name, weight): (String, HostTensor)| Some((name.strip_prefix(prefix)?.to_owned(), weight));
    let found: Named<HostTensor> = found.into_iter().filter_map(without_prefix).collect();
    super::fill(encoder, &found, &path, "model.encoder")
}

/// Returns the checkpoint whose weights are in this file: that of its folder, or a capsule; `None` for other files.
fn stored(path: &Path) -> Result<Option<StoredCheckpoint>> {
    let folder = path.parent().filter(|_| path.file_name().is_some_and(|name| name == run_folder::WEIGHTS));
    match folder.filter(|folder| folder.join(run_folder::MANIFEST).exists()) {
        Some(folder) => StoredCheckpoint::read(folder).map(Some),
        None if Capsule::is_capsule_file(path) => StoredCheckpoint::read(path).map(Some),
        None => Ok(None),
    }
}

/// Checks that a model computes the inputs of its trained layers as this configuration does.
fn check_same_inputs(model: &Value, config: &BackboneConfig, images: &ImageNormalization, path: &Path) -> Result<()> {
    let differs = |what: &str, stored: String, given: String| {
        let problem = format!("its encoder was trained with {what} {stored}, and this model has {given}");
        Err(Error::corrupt(path, problem, format!("set model.{what}={stored}")))
    };
    fn value<T: DeserializeOwned>(model: &Value, name: &str) -> Option<T> {
        serde_json::from_value(model.get(name)?.clone()).ok()
    }
    if let Some(side) = value::<usize>(model, "image").filter(|side| *side != images.side) {
        return differs("image", side.to_string(), images.side.to_string());
    }
    for (name, given) in [("pixel_mean", images.mean), ("pixel_std", images.std)] {
        if let Some(found) = value::<[f32; 3]>(model, name).filter(|found| *found != given) {
            return differs(name, format!("{found:?}"), format!("{given:?}"));
        }
    }
    let keypoints = model.get("encoder").and_then(|encoder| value::<KeypointsConfig>(encoder, "keypoints"));
    let (Some(found), BackboneConfig::Keypoints(given)) = (keypoints, config) else { return Ok(()) };
    let setting = |name: &str| format!("encoder.keypoints.{name}");
    if found.colours != given.colours {
        return differs(&setting("colours"), format!("{:?}", found.colours), format!("{:?}", given.colours));
    }
    if found.filters != given.filters {
        return differs(&setting("filters"), format!("{:?}", found.filters), format!("{:?}", given.filters));
    }
    if !given.filters.is_empty() && (found.seed, found.sharpness) != (given.seed, given.sharpness) {
        let of = |config: &KeypointsConfig| format!("{} and sharpness {}", config.seed, config.sharpness);
        return differs(&setting("seed"), of(&found), of(given));
    }
    Ok(())
}
