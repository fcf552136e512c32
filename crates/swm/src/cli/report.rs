//! `swm report`: writes one self-contained HTML page of results.

use super::output_folder;
use super::train::log_of;
use super::{emit, emit_json};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm_core::{Error, Results};
use swm_report::ReportOptions;

/// Arguments of `swm report`.
#[derive(Args)]
pub struct ReportArgs {
    /// Results files, or folders with a results.json
    #[arg(required = true)]
    results: Vec<PathBuf>,
    /// Folder of the page
    #[arg(short, long, default_value = "report", value_name = "DIR")]
    output: PathBuf,
    /// Title (default: the environments)
    #[arg(long)]
    title: Option<String>,
    /// Checkpoint whose training curves are shown: a path or a name
    #[arg(long, value_name = "CHECKPOINT")]
    training: Option<String>,
}

/// Runs `swm report`.
pub fn report(args: &ReportArgs, as_json: bool) -> anyhow::Result<()> {
    let read: swm_core::Result<Vec<(PathBuf, Results)>> = args
        .results
        .iter()
        .map(|path| {
            let file = if path.is_dir() { path.join("results.json") } else { path.clone() };
            let results = swm_report::read_results(&file)?;
            if results.sequential {
                let problem = "its study ran with --until, so the intervals for a fixed number of episodes do not hold";
                let fix = "show the study: `swm study report`";
                return Err(Error::config(file.display().to_string(), problem, fix));
            }
            Ok((file, results))
        })
        .collect();
    let read = read?;
    let options = ReportOptions {
        title: args.title.clone(),
        metrics: args.training.as_deref().map(home::find_checkpoint).transpose()?.as_deref().map(log_of),
        command: None,
    };
    let _lock = output_folder::claim(&args.output, &["index.html"])?;
    let page = swm_report::write_report_with(&read, &options, &args.output)?;
    if as_json {
        return emit_json(&json!({"report": page}));
    }
    emit(&format!("{}\n", page.display()));
    Ok(())
}
