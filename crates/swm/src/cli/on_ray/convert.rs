//! `swm convert`: its episodes here, or in shards on a Ray cluster.

use super::collect::{SHARD_EPISODES, shared_target};
use super::{OnRayArgs, Request};
use crate::cli::convert::{self, ConvertArgs, Mode};
use crate::cli::progress::control;
use crate::cli::{Context, collect, emit, emit_json};
use crate::home;
use clap::Args;
use serde_json::json;
use swm_core::{Error, limits};
use swm_data::lance::Shard;
use swm_data::{ConvertMode, convert_shard};

/// Arguments of `swm convert`.
#[derive(Args)]
pub struct ConvertCommand {
    #[command(flatten)]
    args: ConvertArgs,
    #[command(flatten)]
    on: OnRayArgs,
    /// Number of shards with --on (default: one for every 50 episodes)
    #[arg(long, value_name = "N", requires = "on")]
    shards: Option<usize>,
    /// Convert shard I of N, counted from 0, to a Lance dataset
    ///
    /// `swm datasets commit` commits the shards of all machines. A shard that was interrupted continues. Nothing is verified: the
    /// same command without --shard compares the committed dataset with the source.
    #[arg(long, value_name = "I/N", value_parser = collect::shard, conflicts_with = "on")]
    shard: Option<Shard>,
}

/// Runs `swm convert`.
pub fn run(command: &ConvertCommand, context: &Context) -> anyhow::Result<()> {
    let ConvertCommand { args, on, shards, shard } = command;
    if let Some(shard) = shard {
        return one_shard(args, *shard, context);
    }
    if !on.is_given() {
        return convert::convert(args, context);
    }
    let fix = "remove it: on a cluster, the target is a new dataset";
    on.refuse(&[("--mode", args.mode != Mode::Resume)], fix)?;
    let episodes = swm_data::open(home::find_dataset(&args.source)?)?.episodes().len();
    if episodes == 0 {
        return Err(Error::config(&args.source, "has no episodes", "convert it without --on").into());
    }
    let target = shared_target(&args.target, args.target_args.format.as_deref(), on)?;
    let shards = shards.unwrap_or_else(|| episodes.div_ceil(SHARD_EPISODES)).max(1);
    limits::SHARDS.check(shards)?;
    let cells = json!({"shards": shards, "episodes": episodes, "verify": !args.no_verify});
    on.submit(&Request { kind: "convert", output: &target, replaced: &["--shards"], cells }, context)
}

/// Converts the episodes of a shard.
fn one_shard(args: &ConvertArgs, shard: Shard, context: &Context) -> anyhow::Result<()> {
    limits::SHARDS.check(shard.count)?;
    let reader = swm_data::open(home::find_dataset(&args.source)?)?;
    let target = home::target(&args.target, args.target_args.format.as_deref())?;
    args.target_args.codec.check_format(&target, args.target_args.format.as_deref())?;
    let options = args.target_args.options(ConvertMode::Resume)?;
    let report = convert_shard(&reader, &target, &options, shard, &mut control(context))?;
    if context.json {
        return emit_json(&report);
    }
    let Shard { index, count } = shard;
    emit(&format!("{} episodes in shard {index} of {count} of {target}\n", report.episodes));
    Ok(())
}
