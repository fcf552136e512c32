//! `swm checkpoints`: which models were trained here, and where one came from.

use super::datasets::names_in;
use super::{emit, emit_json, table};
use clap::Args;
use serde_json::{Value, json};
use std::path::PathBuf;
use swm::home;
use swm_core::{Error, Result};
use swm_models::{Checkpoint, Device};

/// Arguments of `swm checkpoints`.
#[derive(Args)]
pub struct CheckpointsArgs {
    /// Show and verify this one: a path or a name
    checkpoint: Option<String>,
}

/// Loads a checkpoint by path or name; a wrong name gets the nearest right ones.
pub fn load(given: &str) -> Result<(PathBuf, Checkpoint)> {
    let path = home::checkpoint(given);
    if !path.exists() {
        let names = names_in(&home::checkpoints());
        return Err(Error::unknown(
            "checkpoint",
            given,
            names.iter().map(String::as_str),
            format!("there is none at {}; `swm checkpoints` lists those at home", path.display()),
        ));
    }
    let checkpoint = Checkpoint::load(&path, &Device::flex())?;
    Ok((path, checkpoint))
}

/// Lists the checkpoints at home, or shows one.
pub fn checkpoints(args: &CheckpointsArgs, as_json: bool) -> anyhow::Result<()> {
    if let Some(name) = &args.checkpoint {
        let (path, checkpoint) = load(name)?;
        let found = json!({
            "path": path,
            "weights": checkpoint.hash(),
            "env": checkpoint.env,
            "config": checkpoint.config,
            "action": checkpoint.action,
            "manifest": checkpoint.manifest,
        });
        return if as_json {
            emit_json(&found)
        } else {
            emit(&format!("{}\nweights {}\n", path.display(), checkpoint.hash()));
            emit(&format!("trained on {}\n", checkpoint.env.as_deref().unwrap_or("an unknown environment")));
            emit(&checkpoint.config.to_toml()?);
            Ok(())
        };
    }
    let folder = home::checkpoints();
    let found: Vec<Value> = names_in(&folder)
        .into_iter()
        .map(|name| match load(&name) {
            Ok((_, checkpoint)) => {
                json!({"name": name, "env": checkpoint.env, "weights": checkpoint.hash(), "image": checkpoint.config.model.image})
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
            text(&found["env"]),
            format!("{} px", found["image"]),
            text(&found["weights"]).chars().take(12).collect(),
        ],
    });
    emit(&table(&["checkpoint", "environment", "pictures", "weights"], rows));
    Ok(())
}
