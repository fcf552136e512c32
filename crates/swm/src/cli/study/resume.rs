//! `swm study resume`: evaluates what the folder of a study lacks.

use super::show;
use crate::cli::config::count;
use crate::cli::eval::run_options;
use crate::cli::progress::control;
use crate::cli::{Context, emit, emit_json};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm_core::{Origin, limits};
use swm_eval::StudyFolder;

/// Arguments of `swm study resume`.
#[derive(Args)]
pub struct ResumeArgs {
    /// The folder of the study
    folder: PathBuf,
    /// Evaluate only the cell with this id
    #[arg(long, value_name = "ID")]
    cell: Option<String>,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16, value_parser = count::<1, { limits::ENVS.max }>)]
    envs: usize,
    /// Allow the folder to name what loads code or opens connections
    ///
    /// docs/security.md says what files may do without it.
    #[arg(long)]
    trust: bool,
}

/// Runs `swm study resume`.
pub fn run(args: &ResumeArgs, context: &Context) -> anyhow::Result<()> {
    let folder = StudyFolder::new(&args.folder);
    let study = folder.study()?;
    let resolver = HomeResolver::new(Origin::file(args.folder.join("study.json"), args.trust));
    let _lock = folder.create(&study)?;
    let (options, control) = (run_options(args.envs, None, context), &mut control(context));
    if let Some(id) = &args.cell {
        study.run_cell(id, &folder, &resolver, &options, control)?;
        if context.json {
            return emit_json(&json!({"cell": id}));
        }
        emit(&format!("{id}\n"));
        return Ok(());
    }
    study.run(&folder, &resolver, &options, control)?;
    show(&study.results(&folder)?, context.json)
}
