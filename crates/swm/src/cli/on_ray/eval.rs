//! `swm eval`: its conditions here, or each as a cell on a Ray cluster.

use super::eval_parts::{copy_videos, joined_traces, results_in};
use super::{OnRayArgs, Request, without};
use crate::cli::eval::{self, CapsuleStarts, EvalArgs, TRACES, write_json, write_traces};
use crate::cli::output_folder::RESULTS;
use crate::cli::progress::control;
use crate::cli::results_tables::summary;
use crate::cli::{Context, emit, emit_json, output_folder, run_record};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::{Origin, Result, Results};
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
    /// The number of episodes of a stage of --until
    #[arg(long, hide = true, value_name = "EPISODES", requires = "until", conflicts_with = "on")]
    stage: Option<usize>,
    /// Results of the stage before
    #[arg(long, hide = true, value_name = "FILE", requires = "stage")]
    after: Option<PathBuf>,
}

/// Runs `swm eval`.
pub fn run(command: &EvalCommand, context: &Context) -> anyhow::Result<()> {
    let EvalCommand { args, on, part, join, .. } = command;
    if !on.is_given() && part.is_none() && join.is_none() {
        return eval::eval(args, context);
    }
    on.refuse(&[("--resume", args.resume)], "remove it: the same command continues an interrupted run")?;
    let resolver = HomeResolver::new(Origin::User).on(args.device.open()?);
    let resolver = if args.trace { resolver.tracing() } else { resolver };
    let request = args.request(&resolver, CapsuleStarts::Use)?;
    args.check_effects(&request)?;
    let results = match (part, join) {
        (Some(index), _) => command.evaluate_part(&request.part(*index)?, &resolver, context)?,
        (None, Some(parts)) => command.join_parts(parts, &request, &resolver, context)?,
        (None, None) => return command.submit(&request, context),
    };
    if context.json {
        // Whether a stage of `--until` is the last one.
        let ends = results.stopping.is_none_or(|stopping| stopping.met) || results.episodes() >= request.episodes;
        return emit_json(&json!({"env": results.env, "runs": results.runs.len(), "ends": ends}));
    }
    emit(&summary(&results));
    emit(&format!("{}\n", args.output.join(RESULTS).display()));
    Ok(())
}

impl EvalCommand {
    /// Hands the conditions over to a cluster.
    fn submit(&self, request: &EvalRequest, context: &Context) -> anyhow::Result<()> {
        let (args, output) = (&self.args, self.args.output.to_string_lossy());
        let names: Vec<&str> = request.conditions.iter().map(|condition| condition.name.as_str()).collect();
        let mut cells = json!({"conditions": names});
        let videos = args.video_count();
        if let Some(until) = args.until {
            let recorded = (videos > 0).then(|| (args.output.clone(), videos));
            request.check_rule(until, &eval::run_options(args.envs, recorded, context))?;
            cells["stages"] = json!(request.stages());
        }
        let files = [(RESULTS, true), (run_record::FILE, true), ("videos", videos > 0), (TRACES, args.trace)];
        let written: Vec<&str> =
            files.into_iter().filter(|(_, is_written)| *is_written).map(|(name, _)| name).collect();
        self.on.check_new(&output, &written)?;
        self.on.submit(&Request { kind: "eval", output: &output, replaced: &["-o", "--output"], cells }, context)
    }

    /// Evaluates one condition: all episodes, or those of a stage that the stage before lacks.
    fn evaluate_part(&self, part: &EvalRequest, resolver: &HomeResolver, context: &Context) -> Result<Results> {
        let (args, videos) = (&self.args, self.args.video_count());
        let Some(episodes) = self.stage else {
            let (results, _) = eval::run(part, resolver, args.envs, (&args.output, videos), context)?;
            if args.trace {
                write_traces(&args.output, resolver, &results)?;
            }
            return Ok(results);
        };
        let _lock = output_folder::claim(&args.output, &[RESULTS])?;
        let earlier = self.after.as_deref().map(swm_report::read_results).transpose()?;
        let options = eval::run_options(args.envs, (videos > 0).then(|| (args.output.clone(), videos)), context);
        let results = part.run_stage(episodes, earlier.as_ref(), resolver, &options, &mut control(context))?;
        write_json(&args.output.join(RESULTS), &results)?;
        Ok(results)
    }

    /// Joins the results of all conditions, their videos and their traces.
    fn join_parts(
        &self,
        parts: &Path,
        request: &EvalRequest,
        resolver: &HomeResolver,
        context: &Context,
    ) -> Result<Results> {
        let (args, conditions) = (&self.args, request.conditions.len());
        let stage = EvalRequest { episodes: self.stage.unwrap_or(request.episodes), ..request.clone() };
        let options = eval::run_options(args.envs, None, context);
        let results = stage.join(results_in(parts, &stage)?, resolver, &options)?;
        let results = match args.until {
            Some(until) => results.stopped(until, request.episodes),
            None => results,
        };
        let _lock = output_folder::claim(&args.output, &[RESULTS, TRACES])?;
        copy_videos(parts, conditions, &args.output)?;
        output_folder::delete_traces(&args.output)?;
        if args.trace {
            write_json(&args.output.join(TRACES), &joined_traces(parts, conditions)?)?;
        }
        write_json(&args.output.join(RESULTS), &results)?;
        run_record::write_command(&args.output, command_of_one_process(&run_record::arguments(), &args.output))?;
        Ok(results)
    }
}

/// The command line of an evaluation on one machine, from that of the cell that joins its results.
fn command_of_one_process(arguments: &[String], output: &Path) -> Vec<String> {
    let own = ["--join", "--stage", "--threads", "-o", "--output"];
    let output = ["--output".to_owned(), output.display().to_string()];
    std::iter::once("swm".to_owned()).chain(without(arguments, &own, &["--json"])).chain(output).collect()
}
