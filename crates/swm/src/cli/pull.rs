//! `swm pull`: downloads datasets, checkpoints and pretrained weights from the Hugging Face hub; `swm push`: uploads them.

use super::progress::control;
use super::{Context, as_texts, emit, emit_json};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result};
use swm_data::hub::{Hub, HubUri, PushOptions, RepoKind};
use swm_models::weights::{fetch, locate};

/// Arguments of `swm pull`.
#[derive(Args)]
pub struct PullArgs {
    /// hf://[datasets/]OWNER/NAME[@REVISION][/PATH], or a repository OWNER/NAME
    ///
    /// A URI is downloaded into the cache, and can be given wherever a dataset or a checkpoint is asked for. A repository
    /// without hf:// is one of pretrained weights. Private and gated repositories require a token in HF_TOKEN.
    #[arg(value_name = "URI")]
    repository: String,
    /// Files of the repository of weights (default: its weights)
    #[arg(value_name = "FILE")]
    files: Vec<String>,
}

/// Arguments of `swm push`.
#[derive(Args)]
pub struct PushArgs {
    /// The dataset, checkpoint, file or folder: a path or a name
    path: String,
    /// hf://datasets/OWNER/NAME[/PATH] for a dataset, hf://OWNER/NAME[/PATH]
    ///
    /// The repository is made if it does not exist. PATH is by default the name of the file or folder; `.` stands for
    /// the repository itself. HF_TOKEN must have a token with permission to write.
    #[arg(value_name = "URI")]
    uri: String,
    /// Make the repository private, if it does not exist
    #[arg(long)]
    private: bool,
    /// Title of the commit
    #[arg(long, value_name = "TEXT", default_value = "")]
    message: String,
}

/// Downloads files that are not in the cache, and prints their paths.
pub fn pull(args: &PullArgs, context: &Context) -> anyhow::Result<()> {
    if HubUri::is_uri(&args.repository) {
        return pull_uri(args, context);
    }
    if Path::new(&args.repository).is_file() {
        let problem = format!("'{}' is a file on this machine", args.repository);
        let fix = "give its path where weights are asked for, or name a repository: OWNER/NAME";
        return Err(Error::config("repository", problem, fix).into());
    }
    let cache = home::weights()?;
    let paths = if args.files.is_empty() {
        vec![locate(&args.repository, &cache)?]
    } else {
        args.files.iter().map(|file| fetch(&args.repository, file, &cache)).collect::<Result<_>>()?
    };
    if context.json {
        return emit_json(&json!({"repository": args.repository, "paths": as_texts(&paths)}));
    }
    for path in paths {
        emit(&format!("{}\n", path.display()));
    }
    Ok(())
}

/// Downloads what a URI names.
fn pull_uri(args: &PullArgs, context: &Context) -> anyhow::Result<()> {
    if let Some(file) = args.files.first() {
        let fix = format!("name it in the URI: {}/{file}", args.repository.trim_end_matches('/'));
        return Err(Error::config("swm pull", "files are given beside a URI", fix).into());
    }
    let uri = HubUri::parse(&args.repository, RepoKind::Model)?;
    let pulled = Hub::new(&home::hub_cache()?)?.pull(&uri, &mut control(context))?;
    if context.json {
        return emit_json(&pulled);
    }
    emit(&format!(
        "{}\n{}: {} files, {}, {} downloaded\n",
        pulled.path.display(),
        pulled.pinned,
        pulled.files,
        megabytes(pulled.bytes),
        megabytes(pulled.downloaded)
    ));
    Ok(())
}

/// Uploads a file or a folder, and prints the page of its commit.
pub fn push(args: &PushArgs, context: &Context) -> anyhow::Result<()> {
    let path = found(&args.path)?;
    let kind = if swm_data::open(path.clone()).is_ok() { RepoKind::Dataset } else { RepoKind::Model };
    let (given, is_root) = match args.uri.strip_suffix("/.") {
        Some(repository) => (repository, true),
        None => (args.uri.as_str(), false),
    };
    let mut uri = HubUri::parse(given, kind)?;
    if uri.path.is_empty() && !is_root {
        uri.path = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    }
    let options = PushOptions { private: args.private, message: args.message.clone() };
    let pushed = Hub::new(&home::hub_cache()?)?.push(&path, &uri, &options, &mut control(context))?;
    if context.json {
        return emit_json(&pushed);
    }
    emit(&format!(
        "{}\n{}: {} files, {}, {} uploaded\n",
        pushed.page,
        pushed.pinned,
        pushed.files,
        megabytes(pushed.bytes),
        megabytes(pushed.uploaded)
    ));
    Ok(())
}

/// The path of a file, or of a dataset or checkpoint by its name.
fn found(given: &str) -> Result<PathBuf> {
    if Path::new(given).exists() {
        return Ok(PathBuf::from(given));
    }
    match home::find_checkpoint(given) {
        Ok(path) => Ok(path),
        Err(_) => Ok(home::find_dataset(given)?.local("of files")?.to_owned()),
    }
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}
