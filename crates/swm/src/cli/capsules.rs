//! `swm checkpoints pack`, and the parts of `show`, `verify` and `export` that concern capsules.

use super::eval::run_options;
use super::progress::control;
use super::report::results_file;
use super::results_tables::percent;
use super::{Context, emit, emit_json, output_folder};
use crate::capsule::{self, EvaluationRecord, PackRequest, RecordedEpisode, Returns, Verification};
use crate::home;
use clap::{Args, ValueEnum};
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::files;
use swm_core::results::Proportion;
use swm_core::text::one_line;
use swm_core::{Error, Result};
use swm_eval::StartsRequest;
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
    /// Results of `swm eval --protocol compat`, for the mean return
    ///
    /// With strict counting, an episode ends when its goal is reached, which is not what a task with rewards measures.
    #[arg(long, value_name = "RESULTS")]
    returns: Option<PathBuf>,
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
    let request = PackRequest {
        run: home::find_checkpoint(&args.checkpoint)?,
        results: args.eval.as_deref().map(results_file).transpose()?,
        returns: args.returns.as_deref().map(results_file).transpose()?,
        licence: args.licence.clone(),
        author: args.author.clone(),
        trust: args.trust,
    };
    let packed = capsule::pack(&request, &run_options(ENVS, None, context), &mut control(context))?;
    let _lock = output_folder::claim_file(&args.output)?;
    let hash = packed.write_own(&args.output)?;
    if context.json {
        let path = args.output.to_string_lossy();
        return emit_json(&json!({"path": path, "hash": hash, "weights": packed.weights_hash()}));
    }
    emit(&format!("{}\n", args.output.display()));
    Ok(())
}

/// Verifies the behaviour of a capsule.
pub fn verify(path: &Path, trust: bool, context: &Context) -> Result<Verification> {
    capsule::verify(path, trust, &run_options(ENVS, None, context), &mut control(context))
}

/// A description of a capsule.
#[derive(Serialize)]
pub struct CapsuleInfo {
    /// The hash of the capsule.
    pub hash: String,
    /// The hash of the weights.
    pub weights: String,
    /// The id of the model's family.
    pub family: String,
    /// The id of the training environment.
    pub env: Option<String>,
    /// The size of the file.
    pub bytes: u64,
    /// The licence of the weights.
    pub licence: Option<String>,
    /// Who trained the model.
    pub author: Option<String>,
    /// The processor that packed the capsule.
    pub packed_on: String,
    /// The evaluation of the model.
    pub evaluation: Option<EvaluationInfo>,
}

/// A description of the evaluation in a capsule.
#[derive(Serialize)]
pub struct EvaluationInfo {
    /// The origin of the starts: `episodic` or `dataset`.
    pub protocol: &'static str,
    /// Steps from a start to its goal in a dataset.
    pub goal_offset: Option<usize>,
    /// The time limit of an episode, in steps; `None` for the environment's.
    pub budget: Option<usize>,
    /// The name of the condition.
    pub condition: String,
    /// The success rate of the model.
    pub success: Proportion,
    /// The success rate of the random-policy floor.
    pub floor: Option<Proportion>,
    /// The returns of the model and of the floor in episodes that were played to their end, if they were measured.
    pub returns: Vec<Returns>,
    /// The hash of the evaluated weights.
    pub weights: String,
    /// The recorded episodes.
    pub episodes: Vec<RecordedEpisode>,
}

impl CapsuleInfo {
    /// Describes the capsule in a file.
    ///
    /// # Errors
    /// When the capsule is damaged.
    pub fn read(path: &Path) -> Result<Self> {
        let capsule = Capsule::read(path)?;
        let record = capsule.evaluation.as_ref().map(EvaluationRecord::read).transpose()?;
        let evaluation = record.map(|record| EvaluationInfo {
            protocol: record.request.protocol(),
            goal_offset: match record.request.starts {
                StartsRequest::Dataset { goal_offset, .. } => Some(goal_offset),
                StartsRequest::Episodic => None,
            },
            budget: record.request.budget,
            condition: record.request.conditions[0].name.clone(),
            success: record.success(),
            floor: record.floor(),
            weights: record.weights,
            returns: record.returns,
            episodes: record.episodes,
        });
        Ok(Self {
            hash: capsule.hash()?,
            weights: capsule.weights_hash().to_owned(),
            family: StoredCheckpoint::of(path, &capsule).family().to_owned(),
            env: capsule.env().map(one_line),
            bytes: std::fs::metadata(path).map_err(|error| Error::io(path, "reading the size", error))?.len(),
            licence: capsule.description.licence,
            author: capsule.description.author,
            packed_on: capsule.description.cpu_level,
            evaluation,
        })
    }

    /// Describes the capsule in lines for people.
    pub fn lines(&self) -> String {
        let or_none = |text: &Option<String>| text.as_deref().map_or("not stated".to_owned(), one_line);
        let (licence, author) = (or_none(&self.licence), or_none(&self.author));
        let mut lines = format!(
            "capsule {}, {} kB, packed on {}\nlicence {licence}, author {author}\n",
            self.hash,
            self.bytes / 1000,
            self.packed_on
        );
        if let Some(evaluation) = &self.evaluation {
            let measure = if evaluation.returns.is_empty() { "success " } else { "" };
            lines.push_str(&format!("{measure}{}; starts {}\n", evaluation.measured(), evaluation.starts()));
        }
        lines
    }
}

impl EvaluationInfo {
    /// Formats the origin of the starts and the time limit.
    pub fn starts(&self) -> String {
        let budget = self.budget.map_or(String::new(), |budget| format!(", {budget} steps"));
        match self.goal_offset {
            Some(offset) => format!("recorded, goal after {offset} steps{budget}"),
            None => format!("drawn{budget}"),
        }
    }

    /// Formats the success rate, or the mean return with its standard deviation, beside that of the random-policy floor.
    pub fn measured(&self) -> String {
        if let [model, floor @ ..] = &self.returns[..] {
            let floor = floor.first().map_or(String::new(), |floor| format!(", floor {:.0}", floor.mean));
            return format!("return {:.0} ± {:.0}{floor}", model.mean, model.std);
        }
        let floor = self.floor.map_or(String::new(), |floor| format!(", floor {}", percent(&floor)));
        format!("{} of {} episodes{floor}", percent(&self.success), self.success.n)
    }
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
            let weights = path.join("weights.safetensors");
            let fix = match path.is_file() {
                true => "export it with --format checkpoint".to_owned(),
                false => format!("its weights are in {}", weights.display()),
            };
            Err(Error::config(format!("checkpoint {given}"), problem, fix))
        }),
    }
}
