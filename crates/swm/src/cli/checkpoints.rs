//! `swm checkpoints`: which models were trained here, and where one came from.

use super::{emit, emit_json, table};
use clap::Args;
use serde_json::{Value, json};
use swm::home::{self, names_in};
use swm_core::{Manifest, Result};
use swm_models::inverse::InverseCheckpoint;
use swm_models::{Checkpoint, Device, checkpoint};
use swm_plan::ActionScale;

/// Arguments of `swm checkpoints`.
#[derive(Args)]
pub struct CheckpointsArgs {
    /// Show and verify this one: a path or a name
    checkpoint: Option<String>,
}

/// Lists the checkpoints at home, or shows one.
pub fn checkpoints(args: &CheckpointsArgs, as_json: bool) -> anyhow::Result<()> {
    if let Some(name) = &args.checkpoint {
        let path = home::find_checkpoint(name)?;
        let card = Card::load(name)?;
        if as_json {
            return emit_json(&json!({
                "path": path,
                "family": card.family,
                "weights": card.weights,
                "env": card.env,
                "config": card.config,
                "action": card.action,
                "manifest": card.manifest,
            }));
        }
        emit(&format!("{}\n{}, weights {}\n", path.display(), card.family, card.weights));
        emit(&format!("trained on {}\n", card.env.as_deref().unwrap_or("an unknown environment")));
        emit(&card.toml);
        return Ok(());
    }
    let folder = home::checkpoints();
    let found: Vec<Value> = names_in(&folder)
        .into_iter()
        .map(|name| match Card::load(&name) {
            Ok(Card { family, env, weights, image, .. }) => {
                json!({"name": name, "family": family, "env": env, "weights": weights, "image": image})
            }
            Err(error) => json!({"name": name, "error": error.to_string()}),
        })
        .collect();
    if as_json {
        return emit_json(&found);
    }
    if found.is_empty() {
        emit(&format!("no checkpoints in {}; `swm train lewm --data DATASET` makes one\n", folder.display()));
        return Ok(());
    }
    let text = |value: &Value| value.as_str().unwrap_or("?").to_owned();
    let rows = found.iter().map(|found| match found.get("error") {
        Some(error) => vec![text(&found["name"]), text(error)],
        None => vec![
            text(&found["name"]),
            text(&found["family"]),
            text(&found["env"]),
            format!("{} px", found["image"]),
            text(&found["weights"]).chars().take(12).collect(),
        ],
    });
    emit(&table(&["checkpoint", "model", "environment", "pictures", "weights"], rows));
    Ok(())
}

/// What there is to say about a checkpoint of any family.
struct Card {
    family: &'static str,
    env: Option<String>,
    weights: String,
    /// The side of the pictures it sees.
    image: usize,
    config: Value,
    toml: String,
    action: ActionScale,
    manifest: Manifest,
}

impl Card {
    /// Loads a checkpoint by path or name, which verifies it.
    fn load(given: &str) -> Result<Self> {
        let path = home::find_checkpoint(given)?;
        if checkpoint::family(&path).as_deref() == Some("inverse") {
            let found = InverseCheckpoint::load(&path, &Device::flex())?;
            return Ok(Self {
                family: "inverse",
                weights: found.hash().to_owned(),
                image: found.world.config.model.image,
                config: json!(found.config),
                toml: found.config.to_toml()?,
                env: found.world.env,
                action: found.world.action,
                manifest: found.manifest,
            });
        }
        let found = Checkpoint::load(&path, &Device::flex())?;
        Ok(Self {
            family: "lewm",
            weights: found.hash().to_owned(),
            image: found.config.model.image,
            config: json!(found.config),
            toml: found.config.to_toml()?,
            env: found.env,
            action: found.action,
            manifest: found.manifest,
        })
    }
}
