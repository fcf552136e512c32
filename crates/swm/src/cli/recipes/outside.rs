//! What the steps of a recipe read that no step makes: datasets, checkpoints and the files of presets.

use super::file::{Kind, REFERENCES, Recipe, Step, is_preset_name, parse, texts};
use crate::cli::train::TrainArgs;
use crate::home;
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::manifest;
use swm_models::StoredCheckpoint;

/// Hashes of contents, by names such as `the dataset 'rooms'`.
pub type Hashes = BTreeMap<String, String>;

/// Returns the hashes of what a step reads from outside the recipe. What is not there, or is no dataset, checkpoint or preset, has none.
pub fn of(recipe: &Recipe, (kind, step): (Kind, &Step), folder: &Path) -> Hashes {
    let mut hashes = Hashes::new();
    for (key, value) in step.options.iter().filter(|(key, _)| REFERENCES.contains(&key.as_str())) {
        let is_outside = |name: &String| !name.contains("://") && recipe.steps().all(|(_, other)| other.name != *name);
        for name in texts(value).into_iter().filter(is_outside) {
            let (what, hash) = match key.as_str() {
                "data" | "dataset" => ("dataset", dataset(&name)),
                _ => ("checkpoint", weights(&name)),
            };
            hashes.extend(hash.map(|hash| (format!("the {what} '{name}'"), hash)));
        }
    }
    let preset = step.options.get("preset").and_then(toml::Value::as_str).filter(|preset| !is_preset_name(preset));
    if let (Kind::Train, Some(preset)) = (kind, preset) {
        let arguments = recipe.arguments(kind, step, folder);
        let config = parse::<TrainArgs>(kind, step, &arguments).and_then(|args| args.config()).ok();
        let hash = config.map(|config| manifest::hash(config.to_json().to_string().as_bytes()));
        hashes.extend(hash.map(|hash| (format!("the preset '{preset}'"), hash)));
    }
    hashes
}

/// Returns the name of what has another content than recorded. What is gone has none.
pub fn changed<'a>(recorded: &'a Hashes, found: &Hashes) -> Option<&'a str> {
    let differs = |(name, hash): &(&String, &String)| found.get(*name).is_some_and(|found| found != *hash);
    recorded.iter().find(differs).map(|(name, _)| name.as_str())
}

fn dataset(name: &str) -> Option<String> {
    home::open_dataset(name).and_then(|reader| reader.content_hash()).ok()
}

fn weights(name: &str) -> Option<String> {
    let stored = home::find_checkpoint(name).and_then(|path| StoredCheckpoint::read(&path)).ok()?;
    stored.manifest().hashes.get("weights").cloned()
}
