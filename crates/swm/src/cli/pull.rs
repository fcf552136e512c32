//! `swm pull`: downloads pretrained weights from the Hugging Face hub.

use super::{emit, emit_json};
use crate::home;
use clap::Args;
use serde_json::json;
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
