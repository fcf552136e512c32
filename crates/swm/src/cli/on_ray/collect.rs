//! `swm collect`: its episodes here, or in shards on a Ray cluster.

use super::{OnRayArgs, Request};
use crate::cli::Context;
use crate::cli::collect::{self, CollectArgs};
use crate::{collect_target, home};
use clap::Args;
use serde_json::json;
use swm_core::{Error, limits};
use swm_data::Location;

/// Arguments of `swm collect`.
#[derive(Args)]
pub struct CollectCommand {
    #[command(flatten)]
    args: CollectArgs,
    /// With --resume: allow the dataset to choose any name
    ///
    /// A dataset records its environment, policies and wrappers. Those that run code, read files or open connections are
    /// continued only if you name them, or trust the dataset (docs/security.md).
    #[arg(long, requires = "resume", conflicts_with = "env")]
    trust: bool,
    #[command(flatten)]
    on: OnRayArgs,
    /// Number of shards with --on (default: one for every 50 episodes)
    #[arg(long, value_name = "N", requires = "on")]
    shards: Option<usize>,
}

/// The number of episodes of a shard, unless the command line says otherwise.
pub(super) const SHARD_EPISODES: usize = 50;

/// Runs `swm collect`.
pub fn run(command: &CollectCommand, context: &Context) -> anyhow::Result<()> {
    let CollectCommand { args, trust, on, shards } = command;
    if !on.is_given() {
        return collect::collect(args, *trust, context);
    }
    let refused = [("--shard", args.shard.is_some()), ("--resume", args.resume), ("--overwrite", args.overwrite)];
    let fix = "remove it: the same command continues an interrupted run, and --shards says how many shards there are";
    on.refuse(&refused, fix)?;
    collect::check(args)?;
    let target = shared_target(&args.output, args.format.as_deref(), on)?;
    let shards = shards.unwrap_or_else(|| args.episodes().div_ceil(SHARD_EPISODES)).max(1);
    limits::SHARDS.check(shards)?;
    let cells = json!({"shards": shards, "episodes": args.episodes()});
    let replaced = &["-o", "--output", "--shards", "--format"];
    on.submit(&Request { kind: "collect", output: &target, replaced, cells }, context)
}

/// The dataset that several machines write: a new one in the format Lance, unless the run has begun.
pub(super) fn shared_target(given: &str, format: Option<&str>, on: &OnRayArgs) -> anyhow::Result<String> {
    let location = home::target(given, format)?;
    let target = location.to_string();
    if !location.has_suffix("lance") {
        let fix = "name a dataset with the suffix .lance, and convert it afterwards";
        return Err(Error::config(target, "several machines write Lance datasets only", fix).into());
    }
    if !on.has_begun(&target)? {
        collect_target::check_new(&Location::parse(&target)?, "give another name")?;
    }
    Ok(target)
}
