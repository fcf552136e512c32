//! `swm reproduce`: repeats an evaluation from its results and lists the differences.

use super::eval::{run_options, write_json};
use super::output_folder::{self, RESULTS};
use super::progress::control;
use super::report::results_file;
use super::results_tables::summary;
use super::{Context, emit, emit_json};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::files::Lock;
use swm_core::{Error, Origin, Result};
use swm_eval::EvalRequest;

/// Arguments of `swm reproduce`.
#[derive(Args)]
pub struct ReproduceArgs {
    /// A results.json, or the folder that contains it
    results: PathBuf,
    /// The environment, if the results may not choose it
    ///
    /// A results file may choose built-in environments and those registered with Gymnasium (docs/security.md).
    #[arg(long)]
    env: Option<String>,
    /// Allow the results to choose any environment, wrapper and dataset
    #[arg(long)]
    trust: bool,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16)]
    envs: usize,
    /// Folder of the new results.json (default: none is written)
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

/// Repeats an evaluation; fails if the results differ.
pub fn reproduce(args: &ReproduceArgs, context: &Context) -> anyhow::Result<()> {
    let file = results_file(&args.results)?;
    let old = swm_report::read_results(&file)?;
    let _lock = args.output.as_deref().map(|folder| claim(folder, &file)).transpose()?;
    let options = run_options(args.envs, None, context);
    let mut resolver = HomeResolver::new(Origin::file(&file, args.trust));
    if let Some(env) = &args.env {
        let named = EvalRequest::of(&old.manifest)?.env;
        if *env != named {
            let problem = format!("the results are of {named}");
            return Err(Error::config(format!("--env {env}"), problem, "name the environment of the results").into());
        }
        resolver = resolver.with_env(env);
    }
    let repeated = swm_eval::reproduce::reproduce(&old, &resolver, &options, &mut control(context))?;
    if let Some(output) = &args.output {
        write_json(&output.join(RESULTS), &repeated.results)?;
    }
    let (holds, differences) = (repeated.holds(), &repeated.differences);
    if context.json {
        emit_json(&json!({"holds": holds, "differences": differences, "results": repeated.results}))?;
    } else {
        emit(&summary(&repeated.results));
        differences.iter().for_each(|difference| emit(&format!("{difference}\n")));
    }
    if !holds {
        anyhow::bail!("the results of {} are not reproduced: {} differences", file.display(), differences.len());
    }
    if !context.json {
        let episodes: usize = repeated.results.runs.iter().map(|run| run.episodes.len()).sum();
        emit(&format!("{episodes} episodes have the same results\n"));
    }
    Ok(())
}

/// Claims the folder of the new results.
///
/// # Errors
/// As [`output_folder::claim`], and when the new results would replace the results that they are compared with.
fn claim(folder: &Path, old: &Path) -> Result<Lock> {
    let same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    if same(&folder.join(RESULTS), old) {
        let fix = "give another folder with --output";
        return Err(Error::config(old.display().to_string(), "would be replaced by the new results", fix));
    }
    output_folder::claim(folder, &[RESULTS])
}
