//! `swm checkpoints pack`, and the parts of `show`, `verify` and `export` that concern capsules.

use super::eval::run_options;
use super::progress::control;
use super::results_tables::percent;
use super::{Context, emit, emit_json, output_folder};
use crate::capsule::{self, EvaluationRecord, PackRequest, Verification};
use crate::home;
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};
use swm_models::capsule::{Capsule, export};
use swm_models::{Device, StoredCheckpoint};

/// Arguments of `swm checkpoints pack`.
#[derive(Args)]
pub struct PackArgs {
    /// The checkpoint, or a capsule to pack again: a path or a name
    checkpoint: String,
    /// The capsule to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Results of `swm eval` with this checkpoint: a results.json or its folder
    ///
    /// The capsule records the success rate, and three episodes that `verify` plays again.
    #[arg(long, value_name = "RESULTS")]
    eval: Option<PathBuf>,
    /// Licence of the weights, such as MIT
    #[arg(long, value_name = "TEXT")]
    licence: Option<String>,
    /// Who trained the model
    #[arg(long, value_name = "TEXT")]
    author: Option<String>,
    /// Allow the checkpoint and the results to choose any environment
    #[arg(long)]
    trust: bool,
}

/// The environments of the episodes that are played again.
const ENVS: usize = 3;

/// Runs `swm checkpoints pack`.
pub fn pack(args: &PackArgs, context: &Context) -> anyhow::Result<()> {
    if args.output.extension().is_none_or(|end| end != "safetensors") {
        let fix = "end its name with .safetensors";
        return Err(Error::config(args.output.display().to_string(), "a capsule is a safetensors file", fix).into());
    }
    output_folder::check_file(&args.output)?;
    files::check_own(&args.output, |path| Capsule::read(path).is_ok())?;
    let eval = args.eval.as_deref();
    let request = PackRequest {
        run: home::find_checkpoint(&args.checkpoint)?,
        results: eval.map(|path| if path.is_dir() { path.join("results.json") } else { path.to_owned() }),
        licence: args.licence.clone(),
        author: args.author.clone(),
        trust: args.trust,
    };
    let packed = capsule::pack(&request, &run_options(ENVS, None, context), &mut control(context))?;
    let hash = packed.write(&args.output)?;
    if context.json {
        return emit_json(&json!({"path": args.output, "hash": hash, "weights": packed.weights_hash()}));
    }
    emit(&format!("{}\n", args.output.display()));
    Ok(())
}

/// Verifies the behaviour of a capsule.
pub fn verify(path: &Path, trust: bool, context: &Context) -> Result<Verification> {
    capsule::verify(path, trust, &run_options(ENVS, None, context), &mut control(context))
}

/// Describes a capsule as JSON: hashes, licence, author, size, and the success rates.
///
/// # Errors
/// When the capsule is damaged.
pub fn describe(path: &Path) -> Result<Value> {
    let capsule = Capsule::read(path)?;
    let record = capsule.evaluation.as_ref().map(EvaluationRecord::read).transpose()?;
    let bytes = std::fs::metadata(path).map_err(|error| Error::io(path, "reading the size", error))?.len();
    let evaluation = record.map(|record| {
        json!({
            "protocol": record.request.protocol(),
            "condition": record.request.conditions[0].name,
            "success": record.success(),
            "floor": record.floor(),
            "weights": record.weights,
            "episodes": record.episodes,
        })
    });
    Ok(json!({
        "hash": capsule.hash()?,
        "weights": capsule.weights_hash(),
        "family": StoredCheckpoint::of(path, &capsule).family(),
        "env": capsule.env(),
        "bytes": bytes,
        "licence": capsule.description.licence,
        "author": capsule.description.author,
        "packed_on": capsule.description.cpu_level,
        "evaluation": evaluation,
    }))
}

/// Describes a capsule in lines for people.
///
/// # Errors
/// When the capsule is damaged.
pub fn describe_lines(path: &Path) -> Result<String> {
    let found = describe(path)?;
    let text = |key: &str| found[key].as_str().unwrap_or("not stated").to_owned();
    let kilobytes = found["bytes"].as_u64().unwrap_or_default() / 1000;
    let mut lines = format!(
        "capsule {}, {kilobytes} kB, packed on {}\nlicence {}, author {}\n",
        text("hash"),
        text("packed_on"),
        text("licence"),
        text("author")
    );
    if let Some(success) = success(&found["evaluation"]) {
        lines.push_str(&format!("success {success}\n"));
    }
    Ok(lines)
}

/// Formats the success rate of a described evaluation, with the random-policy floor.
pub fn success(evaluation: &Value) -> Option<String> {
    let rate = |key: &str| serde_json::from_value(evaluation[key].clone()).ok().map(|rate| percent(&rate));
    let floor = rate("floor").map_or(String::new(), |floor| format!(", floor {floor}"));
    Some(format!("{} of {} episodes{floor}", rate("success")?, evaluation["success"]["n"]))
}

/// The format of an exported checkpoint.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExportFormat {
    /// A checkpoint folder of this program
    Checkpoint,
    /// weights.pt and config.json for `load_pretrained` of the reference
    Reference,
}

/// Writes a checkpoint in a format; by default, a capsule becomes a checkpoint folder, and a checkpoint folder becomes
/// the files of the reference.
///
/// # Errors
/// When the checkpoint is damaged, the folder holds one already, or the reference has no such model.
pub fn export_as(given: &str, folder: &Path, format: Option<ExportFormat>) -> Result<()> {
    let path = home::find_checkpoint(given)?;
    let default = if path.is_file() { ExportFormat::Checkpoint } else { ExportFormat::Reference };
    let loaded = swm_models::load(&path, &Device::flex())?;
    match format.unwrap_or(default) {
        ExportFormat::Checkpoint if path.is_file() => export(&Capsule::read(&path)?, folder).map(drop),
        ExportFormat::Checkpoint => {
            let fix = "copy it, or export --format reference";
            Err(Error::config(path.display().to_string(), "it is a checkpoint folder already", fix))
        }
        ExportFormat::Reference => loaded.export(folder).unwrap_or_else(|| {
            let problem = format!("the reference implementation has no {}", loaded.info()?.family);
            let fix = "its weights are in weights.safetensors";
            Err(Error::config(format!("checkpoint {given}"), problem, fix))
        }),
    }
}
