//! `swm checkpoints`: lists, shows, verifies, packs, imports, exports and removes checkpoints.

use super::capsules::{self, CapsuleInfo, ExportFormat, PackArgs};
use super::{Context, as_texts, emit, emit_json, eprint, table};
use crate::capsule::Verification;
use crate::home::{self, names_in};
use crate::zoo;
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
    /// Load checkpoints and compare their hashes; replay capsules
    ///
    /// The model of a capsule computes its reference batch and plays its recorded episodes again.
    #[command(after_help = "Example: swm checkpoints verify lewm-rooms")]
    Verify {
        /// Paths or names (default: all checkpoints in the home folder)
        checkpoints: Vec<String>,
        /// Allow a capsule to choose any environment
        #[arg(long)]
        trust: bool,
    },
    /// Write a checkpoint as one small file that others can verify
    #[command(after_help = "Example: swm checkpoints pack lewm-rooms --output lewm.safetensors --eval results")]
    Pack(PackArgs),
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
    /// Write a capsule as a checkpoint folder, or the reference's files
    #[command(after_help = "Example: swm checkpoints export lewm-rooms exported")]
    Export {
        /// A path or a name
        checkpoint: String,
        /// The folder to write to
        folder: PathBuf,
        /// The format (default: checkpoint for a capsule, else reference)
        #[arg(long, value_enum)]
        format: Option<ExportFormat>,
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
pub fn checkpoints(args: &CheckpointsArgs, context: &Context) -> anyhow::Result<()> {
    let as_json = context.json;
    match (&args.command, &args.checkpoint) {
        (Some(CheckpointsCommand::Show { checkpoint }), _) | (None, Some(checkpoint)) => show(checkpoint, as_json),
        (Some(CheckpointsCommand::List) | None, None | Some(_)) => list(as_json),
        (Some(CheckpointsCommand::Verify { checkpoints, trust }), _) => verify(checkpoints, *trust, context),
        (Some(CheckpointsCommand::Pack(args)), _) => capsules::pack(args, context),
        (Some(CheckpointsCommand::Import { folder, model, data, output }), _) => {
            import(folder, model, data, output, as_json)
        }
        (Some(CheckpointsCommand::Export { checkpoint, folder, format }), _) => {
            export(checkpoint, folder, *format, as_json)
        }
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
            "path": path.to_string_lossy(),
            "family": info.family,
            "weights": info.weights,
            "env": info.dataset_info.env,
            "config": info.config,
            "facts": info.dataset_info,
            "manifest": info.manifest,
            "capsule": path.is_file().then(|| CapsuleInfo::read(&path)).transpose()?,
        }));
    }
    emit(&format!("{}\n{}, weights {}\n", path.display(), info.family, info.weights));
    if path.is_file() {
        emit(&CapsuleInfo::read(&path)?.lines());
    }
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
    /// The behaviour of a capsule.
    replayed: Option<Verification>,
}

/// Loads a checkpoint and looks for faults that loading does not find. A capsule is replayed.
///
/// # Errors
/// When the user interrupts.
fn examine(given: &str, trust: bool, context: &Context) -> Result<Findings> {
    let examined = home::find_checkpoint(given).and_then(|path| match path.is_file() {
        true => {
            let replayed = capsules::verify(&path, trust, context)?;
            let (weights, faults) = (replayed.weights.clone(), replayed.faults.clone());
            Ok(Findings { weights, faults, replayed: Some(replayed) })
        }
        false => {
            let (path, info) = load(given)?;
            Ok(Findings { weights: info.weights, faults: checkpoint::faults(&path)?, replayed: None })
        }
    });
    match examined {
        Err(Error::Interrupted) => Err(Error::Interrupted),
        Err(error) => Ok(Findings { weights: String::new(), faults: vec![error.to_string()], replayed: None }),
        Ok(found) => Ok(found),
    }
}

fn verify(given: &[String], trust: bool, context: &Context) -> anyhow::Result<()> {
    let all = if given.is_empty() { names_in(&home::checkpoints()?) } else { vec![] };
    let given = if given.is_empty() { &all } else { given };
    let examined = given.iter().map(|name| Ok((name, examine(name, trust, context)?)));
    let found: Vec<(&String, Findings)> = examined.collect::<Result<_>>()?;
    let damaged = found.iter().filter(|(_, found)| !found.faults.is_empty()).count();
    if context.json {
        let rows: Vec<Value> = found
            .iter()
            .map(|(name, Findings { weights, faults, replayed })| match faults.is_empty() {
                true => json!({"name": name, "whole": true, "weights": weights, "capsule": replayed}),
                false => json!({"name": name, "whole": false, "error": faults.join("; "), "capsule": replayed}),
            })
            .collect();
        emit_json(&rows)?;
    } else {
        found.iter().for_each(|(name, found)| emit(&found.lines(name)));
    }
    if let Some((name, _)) = found.iter().find(|(_, found)| !found.faults.is_empty()) {
        let problem = format!("{damaged} of {} checkpoints have faults", found.len());
        let fix = "get them again from their source, or train them again";
        anyhow::bail!(Error::corrupt(name, problem, fix));
    }
    Ok(())
}

impl Findings {
    /// Describes the findings in lines that begin with the name of the checkpoint.
    fn lines(&self, name: &str) -> String {
        let mut lines = vec![];
        if self.faults.is_empty() {
            lines.push(format!("valid, weights {}", self.weights));
        }
        if let Some(Verification { difference, episodes, remarks, .. }) = &self.replayed {
            let replayed =
                format!("outputs within {difference:.1e} of the reference, {episodes} episodes played again");
            lines.push(replayed);
            lines.extend(remarks.iter().cloned());
        }
        // Some faults begin with the name.
        let prefix = format!("{name}: ");
        lines.extend(self.faults.iter().map(|fault| fault.strip_prefix(&prefix).unwrap_or(fault).to_owned()));
        lines.iter().map(|line| format!("{name}: {line}\n")).collect()
    }
}

fn import(folder: &Path, model: &str, data: &str, output: &str, as_json: bool) -> anyhow::Result<()> {
    let (family, out) = (FAMILIES.get(model)?, home::new_checkpoint(output)?);
    checkpoint::check_unused(&out)?;
    let reader = home::open_dataset(data)?;
    let Some(weights) = (family.import)(folder, &*reader, &out) else {
        let fix = "import lewm, pldm, dino_wm, tdmpc2, gcbc, gcivl or gciql";
        anyhow::bail!(Error::config("--model", format!("the reference implementation has no {model}"), fix));
    };
    let weights = weights?;
    if as_json {
        return emit_json(&json!({"path": out.to_string_lossy(), "weights": weights}));
    }
    emit(&format!("{}\n", out.display()));
    Ok(())
}

fn export(given: &str, folder: &Path, format: Option<ExportFormat>, as_json: bool) -> anyhow::Result<()> {
    capsules::export_as(given, folder, format)?;
    if as_json {
        return emit_json(&json!({"path": folder.to_string_lossy()}));
    }
    emit(&format!("{}\n", folder.display()));
    Ok(())
}

fn remove(given: &str, yes: bool, as_json: bool) -> anyhow::Result<()> {
    let path = home::own_checkpoint(given)?;
    if given.starts_with(zoo::PREFIX) {
        let problem = format!("it is the capsule {} of the zoo", path.display());
        anyhow::bail!(Error::config(given, problem, "delete the file by hand"));
    }
    if checkpoint::family(&path).is_none() && !checkpoint::is_unfinished(&path) {
        anyhow::bail!(Error::corrupt(&path, "it is not a checkpoint", "give the folder that `swm train` wrote to"));
    }
    if path.is_file() {
        let (problem, fix) = ("it is a capsule, which is a single file", "delete the file yourself");
        anyhow::bail!(Error::config(path.display().to_string(), problem, fix));
    }
    if !yes && !confirm(&format!("remove the checkpoint and the logs in {}?", path.display()))? {
        anyhow::bail!(Error::config("swm checkpoints remove", "not confirmed", "answer y, or give --yes"));
    }
    let remaining = run_folder::remove(&path)?;
    if as_json {
        return emit_json(&json!({"removed": path.to_string_lossy(), "remaining": as_texts(&remaining)}));
    }
    emit(&format!("removed the checkpoint {}\n", path.display()));
    if !remaining.is_empty() {
        let names: Vec<String> = remaining.iter().map(|path| path.display().to_string()).collect();
        emit(&format!("kept {}: not written by `swm train`, or damaged\n", names.join(", ")));
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
