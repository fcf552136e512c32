//! `swm pull`: weights of others, from the Hugging Face hub.

use super::{emit, emit_json};
use clap::Args;
use serde_json::json;
use swm::home;
use swm_models::weights::{fetch, locate};

/// Arguments of `swm pull`.
#[derive(Args)]
pub struct PullArgs {
    /// The repository, such as facebook/dinov2-small; OWNER/NAME@REVISION for a revision
    repository: String,
    /// Its files (default: its weights)
    files: Vec<String>,
}

/// Fetches files, unless they are here, and prints where they are.
pub fn pull(args: &PullArgs, as_json: bool) -> anyhow::Result<()> {
    let kept = home::weights();
    let paths = if args.files.is_empty() {
        vec![locate(&args.repository, &kept)?]
    } else {
        args.files.iter().map(|file| fetch(&args.repository, file, &kept)).collect::<swm_core::Result<_>>()?
    };
    if as_json {
        return emit_json(&json!({"repository": args.repository, "paths": paths}));
    }
    for path in paths {
        emit(&format!("{}\n", path.display()));
    }
    Ok(())
}
