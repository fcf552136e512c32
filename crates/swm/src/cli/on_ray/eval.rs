//! `swm eval`: its conditions here, or each as a cell on a Ray cluster.

use super::{OnRayArgs, Request};
use crate::cli::eval::{self, CapsuleStarts, EvalArgs, write_json};
use crate::cli::results_tables::summary;
use crate::cli::{Context, emit, emit_json, output_folder, run_record};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::{Error, Origin, Result, Results, files};
use swm_eval::EvalRequest;

/// Arguments of `swm eval`.
#[derive(Args)]
pub struct EvalCommand {
    #[command(flatten)]
    args: EvalArgs,
    #[command(flatten)]
    on: OnRayArgs,
    /// Evaluate only the condition with this index: a cell
    #[arg(long, hide = true, value_name = "INDEX", conflicts_with = "on")]
    part: Option<usize>,
    /// Join the results of all conditions in this folder
    #[arg(long, hide = true, value_name = "DIR", conflicts_with_all = ["on", "part"])]
    join: Option<PathBuf>,
}

/// The largest results of a condition, in bytes.
const MAX_BYTES: u64 = 256 << 20;

/// Runs `swm eval`.
pub fn run(command: &EvalCommand, context: &Context) -> anyhow::Result<()> {
    let EvalCommand { args, on, part, join } = command;
    if !on.is_given() && part.is_none() && join.is_none() {
        return eval::eval(args, context);
    }
    let videos = args.videos.is_some_and(|count| count > 0);
    let refused = [("--until", args.until.is_some()), ("--trace", args.trace), ("--videos", videos)];
    on.refuse(&refused, "remove it, or evaluate without --on")?;
    let resolver = HomeResolver::new(Origin::User).on(args.device.open()?);
    let request = args.request(&resolver, CapsuleStarts::Use)?;
    args.check_planning(&request)?;
    let options = eval::run_options(args.envs, None, context);
    let (results, file) = match (part, join) {
        (Some(index), _) => eval::run(&request.part(*index)?, &resolver, args.envs, (&args.output, 0), context)?,
        (None, Some(parts)) => {
            let results = request.join(parts_in(parts, &request)?, &resolver, &options)?;
            let _lock = output_folder::claim(&args.output, &["results.json"])?;
            let file = args.output.join("results.json");
            write_json(&file, &results)?;
            run_record::write(&args.output, false)?;
            (results, file)
        }
        (None, None) => {
            let output = args.output.to_string_lossy();
            let names: Vec<&str> = request.conditions.iter().map(|condition| condition.name.as_str()).collect();
            let replaced = &["-o", "--output", "--videos"];
            let cells = json!({"conditions": names});
            on.check_new(&output, &["results.json", run_record::FILE])?;
            return on.submit(&Request { kind: "eval", output: &output, replaced, cells }, context);
        }
    };
    if context.json {
        return emit_json(&json!({"env": results.env, "runs": results.runs.len()}));
    }
    emit(&summary(&results));
    emit(&format!("{}\n", file.display()));
    Ok(())
}

/// Reads the results of all conditions.
fn parts_in(folder: &Path, request: &EvalRequest) -> Result<Vec<Results>> {
    let read = |index: usize| {
        let path = folder.join(format!("{index:06}.json"));
        let invalid = |problem: String| Error::corrupt(&path, problem, "remove it and run the command again");
        let results: Results = serde_json::from_slice(&files::read(&path, MAX_BYTES)?)
            .map_err(|error| invalid(format!("is not a results file ({error})")))?;
        results.check().map_err(|problem| invalid(format!("is inconsistent: {problem}")))?;
        Ok(results)
    };
    (0..request.conditions.len()).map(read).collect()
}
