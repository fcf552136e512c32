//! `swm bench`: how fast it is, beside the reference where it is installed.

use super::{Context, emit, emit_json, table};
use clap::{Args, Subcommand};
use swm::ENVS;
use swm_core::EnvChoice;
use swm_eval::{BenchConfig, PlanBenchConfig, bench_envs, bench_plan};

/// Arguments of `swm bench`.
#[derive(Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Steps a second of worlds: stepping with rendering, and collecting into Lance. The reference runs in turn
    /// with ours where SWM_REFERENCE_PYTHON names a Python that has it
    Envs(EnvsArgs),
    /// Iterations a second of CEM with a model that costs nothing, beside the reference's, and the planner's share of the
    /// time beside a model that costs what a LeWM does
    Plan(PlanArgs),
}

#[derive(Args)]
struct PlanArgs {
    /// Environments planned in one call
    #[arg(long, value_delimiter = ',', default_value = "1,16")]
    envs: Vec<usize>,
    /// Pairs of turns, ours and the reference's
    #[arg(long, default_value_t = 5)]
    pairs: usize,
    /// Seconds of a turn
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
}

/// Measures planners.
fn plan(args: &PlanArgs, context: &Context) -> anyhow::Result<()> {
    let report = bench_plan(&PlanBenchConfig {
        envs: args.envs.clone(),
        pairs: args.pairs,
        seconds: args.seconds,
        threads: context.threads,
        ..PlanBenchConfig::default()
    })?;
    if context.json {
        return emit_json(&report);
    }
    emit(&report.to_string());
    Ok(())
}

#[derive(Args)]
struct EnvsArgs {
    /// Which environments (default: all)
    envs: Vec<String>,
    /// Environments of a world
    #[arg(long, default_value_t = 8)]
    num_envs: usize,
    /// Picture sizes
    #[arg(long, value_delimiter = ',', default_value = "224,64")]
    sizes: Vec<usize>,
    /// Leave out stepping without pictures
    #[arg(long)]
    pictures_only: bool,
    /// Pairs of turns, ours and the reference's
    #[arg(long, default_value_t = 5)]
    pairs: usize,
    /// Seconds of a turn
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
    /// Episodes the reference collects in a turn; 0 leaves collecting out
    #[arg(long, default_value_t = 8)]
    episodes: usize,
}

/// Measures.
pub fn bench(args: &BenchArgs, context: &Context) -> anyhow::Result<()> {
    let args = match &args.what {
        What::Envs(args) => args,
        What::Plan(args) => return plan(args, context),
    };
    let entries: Vec<EnvChoice> = match &args.envs[..] {
        [] => ENVS.rows.iter().map(EnvChoice::from).collect(),
        ids => ids.iter().map(|id| ENVS.choose(id)).collect::<swm_core::Result<_>>()?,
    };
    let report = bench_envs(
        &entries,
        &BenchConfig {
            envs: args.num_envs,
            sizes: args.sizes.clone(),
            bare: !args.pictures_only,
            threads: context.threads,
            pairs: args.pairs,
            seconds: args.seconds,
            episodes: args.episodes,
            ..BenchConfig::default()
        },
    )?;
    if context.json {
        return emit_json(&report);
    }
    let median = |values: &[f64]| swm_core::results::Summary::of(values).map(|s| s.median);
    let rows = report.rows.iter().map(|row| {
        vec![
            row.env.clone(),
            row.what.to_owned(),
            row.size.map_or("–".to_owned(), |size| format!("{size} px")),
            format!("{:.0}", row.steps_per_second),
            median(&row.reference).map_or("–".to_owned(), |steps| format!("{steps:.0}")),
            row.ratio.map_or("–".to_owned(), |ratio| format!("{ratio:.1} ×")),
        ]
    });
    emit(&table(&["environment", "work", "pictures", "steps/s", "reference", "ratio"], rows));
    emit(&format!(
        "{} environments, {} threads, medians of {} turns; reference: {}\n",
        report.envs, report.threads, args.pairs, report.reference
    ));
    Ok(())
}
