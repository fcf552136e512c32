//! `swm pull`: downloads pretrained weights from the Hugging Face hub.

use super::{emit, emit_json};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::Path;
use swm_core::Error;
use swm_models::weights::{fetch, locate};

/// Arguments of `swm pull`.
#[derive(Args)]
pub struct PullArgs {
    /// The repository: OWNER/NAME or OWNER/NAME@REVISION
    repository: String,
    /// Files of the repository (default: its weights)
    files: Vec<String>,
}

/// Downloads files that are not in the cache, and prints their paths.
pub fn pull(args: &PullArgs, as_json: bool) -> anyhow::Result<()> {
    if Path::new(&args.repository).is_file() {
        let problem = format!("'{}' is a file on this machine", args.repository);
        let fix = "give its path where weights are asked for, or name a repository: OWNER/NAME";
        return Err(Error::config("repository", problem, fix).into());
    }
    let cache = home::weights()?;
    let paths = if args.files.is_empty() {
        vec![locate(&args.repository, &cache)?]
    } else {
        args.files.iter().map(|file| fetch(&args.repository, file, &cache)).collect::<swm_core::Result<_>>()?
    };
    if as_json {
        return emit_json(&json!({"repository": args.repository, "paths": paths}));
    }
    for path in paths {
        emit(&format!("{}\n", path.display()));
    }
    Ok(())
}
