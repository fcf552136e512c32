//! `swm checkpoints`: lists, shows, verifies, imports, exports and removes checkpoints.

use super::{emit, emit_json, eprint, table};
use crate::home::{self, names_in};
use clap::{Args, Subcommand};
use serde_json::{Value, json};
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result};
use swm_models::{CheckpointInfo, Device, FAMILIES, checkpoint, run_folder};

/// Arguments of `swm checkpoints`.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct CheckpointsArgs {
    #[command(subcommand)]
    command: Option<CheckpointsCommand>,
    /// The checkpoint to show: a path or a name
    checkpoint: Option<String>,
}

#[derive(Subcommand)]
enum CheckpointsCommand {
    /// List the checkpoints in the home folder
    #[command(after_help = "Example: swm checkpoints list")]
    List,
    /// Show the provenance and the config of a checkpoint
    #[command(after_help = "Example: swm checkpoints show lewm-rooms")]
    Show {
        /// A path or a name
        checkpoint: String,
    },
    /// Load checkpoints and compare their hashes
    #[command(after_help = "Example: swm checkpoints verify lewm-rooms")]
    Verify {
        /// Paths or names (default: all checkpoints in the home folder)
        checkpoints: Vec<String>,
    },
    /// Import a checkpoint of the reference implementation
    #[command(after_help = "Example: swm checkpoints import run --model lewm --data rooms --output lewm-rooms")]
    Import {
        /// The folder with weights.pt and config.json
        folder: PathBuf,
        /// The model: `swm models` lists them
        #[arg(long)]
        model: String,
        /// The training dataset, for the scaling of actions and columns
        #[arg(long, value_name = "DATASET")]
        data: String,
        /// The checkpoint to write: a path or a name
        #[arg(short, long, value_name = "CHECKPOINT")]
        output: String,
    },
    /// Write the files that `load_pretrained` of the reference reads
    #[command(after_help = "Example: swm checkpoints export lewm-rooms exported")]
    Export {
        /// A path or a name
        checkpoint: String,
        /// The folder to write weights.pt and config.json to
        folder: PathBuf,
    },
    /// Remove a checkpoint and its logs; other files in its folder stay
    #[command(after_help = "Example: swm checkpoints remove lewm-rooms")]
    Remove {
        /// A path or a name
        checkpoint: String,
        /// Remove without asking
        #[arg(short, long)]
        yes: bool,
    },
}

/// Runs `swm checkpoints`.
pub fn checkpoints(args: &CheckpointsArgs, as_json: bool) -> anyhow::Result<()> {
    match (&args.command, &args.checkpoint) {
        (Some(CheckpointsCommand::Show { checkpoint }), _) | (None, Some(checkpoint)) => show(checkpoint, as_json),
        (Some(CheckpointsCommand::List) | None, None | Some(_)) => list(as_json),
        (Some(CheckpointsCommand::Verify { checkpoints }), _) => verify(checkpoints, as_json),
        (Some(CheckpointsCommand::Import { folder, model, data, output }), _) => {
            import(folder, model, data, output, as_json)
        }
        (Some(CheckpointsCommand::Export { checkpoint, folder }), _) => export(checkpoint, folder, as_json),
        (Some(CheckpointsCommand::Remove { checkpoint, yes }), _) => remove(checkpoint, *yes, as_json),
    }
}

/// Loads a checkpoint by path or name; loading verifies the hash of the weights.
fn load(given: &str) -> Result<(PathBuf, CheckpointInfo)> {
    let path = home::find_checkpoint(given)?;
    let info = swm_models::load(&path, &Device::flex())?.info()?;
    Ok((path, info))
}

fn show(given: &str, as_json: bool) -> anyhow::Result<()> {
    let (path, info) = load(given)?;
    if as_json {
        return emit_json(&json!({
            "path": path,
            "family": info.family,
            "weights": info.weights,
            "env": info.dataset_info.env,
            "config": info.config,
            "facts": info.dataset_info,
            "manifest": info.manifest,
        }));
    }
    emit(&format!("{}\n{}, weights {}\n", path.display(), info.family, info.weights));
    emit(&format!("trained on {}\n", info.dataset_info.env.as_deref().unwrap_or("an unknown environment")));
    emit(&info.toml);
    Ok(())
}

fn list(as_json: bool) -> anyhow::Result<()> {
    let folder = home::checkpoints()?;
    let summaries: Vec<Value> = names_in(&folder)
        .into_iter()
        .map(|name| match load(&name) {
            Ok((_, info)) => json!({
                "name": name,
                "family": info.family,
                "env": info.dataset_info.env,
                "weights": info.weights,
                "image": info.image_size,
            }),
            Err(error) => json!({"name": name, "error": error.to_string()}),
        })
        .collect();
    if as_json {
        return emit_json(&summaries);
    }
    if summaries.is_empty() {
        emit(&format!("no checkpoints in {}; `swm train lewm --data DATASET` trains one\n", folder.display()));
        return Ok(());
    }
    let text = |value: &Value| value.as_str().unwrap_or("?").to_owned();
    let rows = summaries.iter().map(|found| match found.get("error") {
        Some(error) => vec![text(&found["name"]), text(error)],
        None => vec![
            text(&found["name"]),
            text(&found["family"]),
            text(&found["env"]),
            found["image"].as_u64().map_or("–".to_owned(), |side| format!("{side} px")),
            text(&found["weights"]).chars().take(12).collect(),
        ],
    });
    emit(&table(&["checkpoint", "model", "environment", "image", "weights"], rows));
    Ok(())
}

/// The result of examining a checkpoint.
struct Findings {
    /// The hash of the weights; empty if the checkpoint cannot be loaded.
    weights: String,
    faults: Vec<String>,
}

/// Loads a checkpoint and looks for faults that loading does not find.
fn examine(given: &str) -> Findings {
    let loaded = load(given).and_then(|(path, info)| Ok((checkpoint::faults(&path)?, info.weights)));
    match loaded {
        Ok((faults, weights)) => Findings { weights, faults },
        Err(error) => Findings { weights: String::new(), faults: vec![error.to_string()] },
    }
}

fn verify(given: &[String], as_json: bool) -> anyhow::Result<()> {
    let all = if given.is_empty() { names_in(&home::checkpoints()?) } else { vec![] };
    let given = if given.is_empty() { &all } else { given };
    let found: Vec<(&String, Findings)> = given.iter().map(|name| (name, examine(name))).collect();
    let damaged = found.iter().filter(|(_, found)| !found.faults.is_empty()).count();
    if as_json {
        let rows: Vec<Value> = found
            .iter()
            .map(|(name, Findings { weights, faults })| match faults.is_empty() {
                true => json!({"name": name, "whole": true, "weights": weights}),
                false => json!({"name": name, "whole": false, "error": faults.join("; ")}),
            })
            .collect();
        emit_json(&rows)?;
    } else {
        for (name, Findings { weights, faults }) in &found {
            if faults.is_empty() {
                emit(&format!(
                    "{name}: valid, weights {weights}
"
                ));
            }
            faults.iter().for_each(|fault| {
                emit(&format!(
                    "{name}: {fault}
"
                ))
            });
        }
    }
    if damaged > 0 {
        anyhow::bail!(Error::corrupt(
            home::checkpoints()?,
            format!("{damaged} of {} checkpoints have faults", found.len()),
            "train them again, or `swm checkpoints remove` them"
        ));
    }
    Ok(())
}

fn import(folder: &Path, model: &str, data: &str, output: &str, as_json: bool) -> anyhow::Result<()> {
    let (family, out) = (FAMILIES.get(model)?, home::new_checkpoint(output)?);
    if checkpoint::family(&out).is_some() {
        let fix = "choose another --output, or `swm checkpoints remove` it";
        anyhow::bail!(Error::config(out.display().to_string(), "holds a checkpoint already", fix));
    }
    let reader = home::open_dataset(data)?;
    let Some(weights) = (family.import)(folder, &*reader, &out) else {
        let fix = "import lewm, pldm, dino_wm, tdmpc2, gcbc, gcivl or gciql";
        anyhow::bail!(Error::config("--model", format!("the reference implementation has no {model}"), fix));
    };
    let weights = weights?;
    if as_json {
        return emit_json(&json!({"path": out, "weights": weights}));
    }
    emit(&format!("{}\n", out.display()));
    Ok(())
}

fn export(given: &str, folder: &Path, as_json: bool) -> anyhow::Result<()> {
    let loaded = swm_models::load(&home::find_checkpoint(given)?, &Device::flex())?;
    let Some(done) = loaded.export(folder) else {
        let problem = format!("the reference implementation has no {}", loaded.info()?.family);
        anyhow::bail!(Error::config(format!("checkpoint {given}"), problem, "its weights are in weights.safetensors"));
    };
    done?;
    if as_json {
        return emit_json(&json!({"path": folder}));
    }
    emit(&format!("{}\n", folder.display()));
    Ok(())
}

fn remove(given: &str, yes: bool, as_json: bool) -> anyhow::Result<()> {
    let path = home::find_checkpoint(given)?;
    if checkpoint::family(&path).is_none() {
        anyhow::bail!(Error::corrupt(&path, "it is not a checkpoint", "give the folder that `swm train` wrote to"));
    }
    if !yes && !confirm(&format!("remove the checkpoint and the logs in {}?", path.display()))? {
        anyhow::bail!(Error::config("swm checkpoints remove", "not confirmed", "answer y, or give --yes"));
    }
    let remaining = run_folder::remove(&path)?;
    if as_json {
        return emit_json(&json!({"removed": path, "remaining": remaining}));
    }
    emit(&format!("removed the checkpoint {}\n", path.display()));
    if !remaining.is_empty() {
        let names: Vec<String> = remaining.iter().map(|path| path.display().to_string()).collect();
        emit(&format!("kept {}: not written by `swm train`\n", names.join(", ")));
    }
    Ok(())
}

/// Asks a question on the terminal. Returns whether the answer is yes; without a terminal the answer is no.
fn confirm(question: &str) -> Result<bool> {
    if !std::io::stdin().is_terminal() {
        return Ok(false);
    }
    eprint(&format!("{question} [y/N] "));
    let mut answer = String::new();
    std::io::stdin()
        .read_line(&mut answer)
        .map_err(|error| Error::io("standard input", "reading the answer", error))?;
    Ok(matches!(answer.trim(), "y" | "Y" | "yes"))
}
