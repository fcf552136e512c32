//! `swm report`: writes one self-contained HTML page of results.

use super::output_folder::{self, RESULTS};
use super::training_curves::{log_of, of_results};
use super::{emit, emit_json};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::{Error, Results};
use swm_report::{ReportOptions, Training};

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
    /// Checkpoint whose training curves are shown (default: those of the results)
    ///
    /// The policies of the results are found by path or name, and by the hash of their weights.
    #[arg(long, value_name = "CHECKPOINT")]
    training: Option<String>,
}

/// Returns the `results.json` that a command names, by its path or by its folder.
///
/// # Errors
/// When it does not exist.
pub(super) fn results_file(given: &Path) -> swm_core::Result<PathBuf> {
    let (file, problem) = match given.is_dir() {
        true => (given.join(RESULTS), "has no results.json"),
        false => (given.to_owned(), "does not exist"),
    };
    if !file.exists() {
        let fix = "give a results.json, or the folder that `swm eval --output` wrote";
        return Err(Error::config(given.display().to_string(), problem, fix));
    }
    Ok(file)
}

/// Runs `swm report`.
pub fn report(args: &ReportArgs, as_json: bool) -> anyhow::Result<()> {
    let read: swm_core::Result<Vec<(PathBuf, Results)>> = args
        .results
        .iter()
        .map(|path| {
            let file = results_file(path)?;
            let results = swm_report::read_results(&file)?;
            if results.sequential {
                let problem = "its study ran with --until, so the intervals for a fixed number of episodes do not hold";
                let fix = "show the whole study: `swm study report FOLDER`";
                return Err(Error::config(file.display().to_string(), problem, fix));
            }
            Ok((file, results))
        })
        .collect();
    let read = read?;
    let training = match &args.training {
        Some(given) => {
            let metrics = swm_report::read_metrics(&log_of(&home::find_checkpoint(given)?))?;
            vec![Training { policy: String::new(), metrics: Ok(metrics) }]
        }
        None => of_results(&read),
    };
    let options = ReportOptions { title: args.title.clone(), training, command: None };
    let _lock = output_folder::claim(&args.output, &["index.html"])?;
    let page = swm_report::write_report_with(&read, &options, &args.output)?;
    if as_json {
        return emit_json(&json!({"report": page.to_string_lossy()}));
    }
    emit(&format!("{}\n", page.display()));
    Ok(())
}
