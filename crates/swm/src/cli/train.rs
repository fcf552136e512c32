//! `swm train`: train a model on a dataset.

use super::{Context, Progress, emit, emit_json};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm::home;
use swm_core::run::{Control, Event};
use swm_core::{EnvPool, Error, Result};
use swm_data::Reader;
use swm_models::{FAMILIES, OnlineRun, TrainOptions, TrainRun, TrainSummary, TrainableConfig, device};

/// Arguments of `swm train`.
#[derive(Args)]
pub struct TrainArgs {
    /// The model: `swm models` lists them
    model: String,
    /// The dataset: a path or a name
    #[arg(long, value_name = "DATASET")]
    data: Option<String>,
    /// The size and schedule: a preset's name or a TOML file (default: the model's first preset)
    #[arg(long)]
    preset: Option<String>,
    /// Learn by playing in this environment instead (tdmpc2, sac)
    #[arg(long, value_name = "ENV", conflicts_with = "data")]
    env: Option<String>,
    /// Steps after which an episode is truncated, with --env (default: the environment's own)
    #[arg(long, value_name = "STEPS", requires = "env")]
    max_steps: Option<usize>,
    /// Where to write the checkpoint and the logs: a path or a name (default: the model's and dataset's names)
    #[arg(short, long, value_name = "CHECKPOINT")]
    output: Option<String>,
    /// The checkpoint whose frozen encoder is used: a path or a name (inverse only)
    #[arg(long, value_name = "CHECKPOINT")]
    encoder: Option<String>,
    /// Where it computes: cpu, vulkan[:I], cuda[:I], auto
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Continue the run that is there
    #[arg(long)]
    resume: bool,
    /// Print the complete configuration and stop
    #[arg(long)]
    print_config: bool,
    /// Settings, such as optim.lr=3e-4 seed=1
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// Trains a model.
pub fn train(args: &TrainArgs, context: &Context) -> anyhow::Result<()> {
    let family = FAMILIES.get(&args.model)?;
    let preset = args.preset.as_deref().unwrap_or(family.presets[0].id);
    let config = (family.config)(preset, &args.settings)?;
    if args.print_config {
        if context.json {
            return emit_json(&config.to_json());
        }
        emit(&config.to_toml()?);
        return Ok(());
    }
    if args.encoder.is_some() && !family.borrows_encoder {
        let problem = format!("{} trains an encoder of its own", family.id);
        anyhow::bail!(Error::config("--encoder", problem, "leave it out, or train inverse"));
    }
    let options = TrainOptions {
        resume: args.resume,
        device: device::parse(&args.device)?,
        threads: context.threads,
        cache: home::weights(),
        ..TrainOptions::default()
    };
    if let Some(env) = &args.env {
        return train_online(args, env, &*config, options, context);
    }
    let encoder = args.encoder.as_deref().map(home::find_checkpoint).transpose()?;
    let (reader, out) = args.places()?;
    let on = TrainRun { reader, encoder: encoder.as_deref(), out: &out, options };
    let summary = run(&*config, on, context)?;
    if context.json {
        return emit_json(&summary);
    }
    emit(&format!("{}\n", summary.checkpoint.display()));
    Ok(())
}

/// Trains by playing.
fn train_online(
    args: &TrainArgs,
    env: &str,
    config: &dyn TrainableConfig,
    options: TrainOptions,
    context: &Context,
) -> anyhow::Result<()> {
    let choice = swm::env(env)?;
    let threads = swm_core::pool::threads(context.threads)?;
    let environments = |count: usize| {
        let envs = (0..count).map(|_| choice.env()).collect::<Result<Vec<_>>>()?;
        EnvPool::new(envs, config.image_size().map(|side| (side, side)), args.max_steps, Arc::clone(&threads))
    };
    let name = args.output.clone().unwrap_or_else(|| {
        let world = env.rsplit('/').next().unwrap_or(env).split(',').next().unwrap_or(env);
        format!("{}-{world}", args.model)
    });
    let out = home::checkpoint(&name);
    let mut bar = Progress::new("train", config.steps());
    let Some(summary) = config
        .train_online(OnlineRun { environments: &environments, out: &out, options }, &mut control(context, &mut bar))
    else {
        let problem = format!("{} learns from datasets only", args.model);
        anyhow::bail!(Error::config("--env", problem, "give a dataset with --data, or train tdmpc2 or sac"));
    };
    let summary = summary?;
    let evaluated = summary.evaluated.map_or(String::new(), |mean| format!(", mean return {mean:.1}"));
    let best = summary.best.map_or(String::new(), |(step, mean)| format!(", best {mean:.1} after step {step}"));
    bar.done(&format!(
        "{} gradient steps and {} environment steps in {:.0} s{evaluated}{best}, {}",
        summary.steps,
        summary.env_steps,
        summary.seconds,
        out.display()
    ));
    if summary.interrupted {
        anyhow::bail!(Error::Interrupted);
    }
    if context.json {
        return emit_json(&summary);
    }
    emit(&format!("{}\n", summary.checkpoint.display()));
    Ok(())
}

impl TrainArgs {
    /// The dataset, and where the checkpoint goes.
    fn places(&self) -> Result<(Arc<dyn Reader>, PathBuf)> {
        let Some(data) = &self.data else {
            let fix =
                "name one (`swm datasets` lists them), or an environment with --env for a model that learns by playing";
            return Err(Error::config("--data", "no dataset is given", fix));
        };
        let name = self.output.clone().unwrap_or_else(|| {
            let stem = Path::new(data).file_stem().unwrap_or_default().to_string_lossy();
            format!("{}-{stem}", self.model)
        });
        Ok((home::open_dataset(data)?, home::checkpoint(&name)))
    }
}

/// Trains with a progress bar.
pub fn run(config: &dyn TrainableConfig, on: TrainRun<'_>, context: &Context) -> Result<TrainSummary> {
    let out = on.out.to_owned();
    let mut bar = Progress::new("train", config.steps());
    let summary = config.train(on, &mut control(context, &mut bar))?;
    let early = if summary.stopped_early { ", stopped early" } else { "" };
    let best = summary.best.map_or(String::new(), |(step, loss)| format!(", best {loss:.4} after step {step}"));
    bar.done(&format!(
        "{} steps in {:.0} s{early}{best} ({} parameters, {:.0} clips/s, {:.0} % of it waiting for data), {}",
        summary.steps,
        summary.seconds,
        summary.parameters,
        summary.clips_per_second,
        100.0 * summary.data_wait,
        out.display()
    ));
    if summary.interrupted {
        return Err(Error::Interrupted);
    }
    Ok(summary)
}

/// Where a run keeps its training log.
pub fn log_of(checkpoint: &Path) -> PathBuf {
    checkpoint.join("train.jsonl")
}

/// Metrics of the model that the progress bar has room for.
const SHOWN: usize = 4;

/// The control of a training run that is shown by a progress bar.
fn control<'a>(context: &Context, bar: &'a mut Progress) -> Control<'a> {
    Control::new().with_interrupt(Arc::clone(&context.stop)).with_events(move |event| {
        let Event::Progress(at) = event else { return };
        // The loop's own metrics follow the model's.
        let is_loops = |name: &str| ["validation_loss", "evaluation_return", "lr"].contains(&name);
        let shown = at.metrics.iter().take_while(|(name, _)| !is_loops(name)).take(SHOWN);
        let shown: Vec<String> = shown.map(|(name, value)| format!("{name} {value:.4}")).collect();
        let validation = at.metric("validation_loss").or(at.metric("evaluation_return"));
        let validation = validation.map_or(String::new(), |value| format!(", held out {value:.4}"));
        let clips_per_second = at.metric("clips_per_second").unwrap_or_default();
        let wait = 100.0 * at.metric("data_wait").unwrap_or_default();
        bar.at(at.done, format!("{}{validation}, {clips_per_second:.0} clips/s, waits {wait:.0} %", shown.join(" ")));
    })
}
