//! `swm train`: train a model on a dataset.

use super::{Context, Progress, datasets, emit, emit_json, models::MODELS};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm::home;
use swm_core::{Error, Result};
use swm_data::Reader;
use swm_models::{Observer, TrainConfig, TrainOptions, TrainSummary};

/// Arguments of `swm train`.
#[derive(Args)]
pub struct TrainArgs {
    /// The model: `swm models` lists them
    model: String,
    /// The dataset: a path or a name
    #[arg(long, value_name = "DATASET")]
    data: Option<String>,
    /// The size and schedule: a preset's name or a TOML file
    #[arg(long, default_value = "tiny")]
    preset: String,
    /// Where to write the checkpoint and the logs: a path or a name (default: the model's and dataset's names)
    #[arg(short, long, value_name = "CHECKPOINT")]
    output: Option<String>,
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
    let known = MODELS.iter().map(|(id, _)| *id);
    if !known.clone().any(|id| id == args.model) {
        anyhow::bail!(Error::unknown("model", &args.model, known, "`swm models` lists them"));
    }
    let config = TrainConfig::load(&args.preset, &args.settings)?;
    if args.print_config {
        if context.json {
            return emit_json(&config);
        }
        emit(&config.to_toml()?);
        return Ok(());
    }
    let Some(data) = &args.data else {
        anyhow::bail!(Error::config("--data", "no dataset is given", "name one (`swm datasets` lists them)"));
    };
    let reader = datasets::open(data)?;
    let name = args.output.clone().unwrap_or_else(|| {
        let stem = Path::new(data).file_stem().unwrap_or_default().to_string_lossy();
        format!("{}-{stem}", args.model)
    });
    let summary = run(&config, reader, &home::checkpoint(&name), args.resume, context)?;
    if context.json {
        return emit_json(&summary);
    }
    emit(&format!("{}\n", summary.checkpoint.display()));
    Ok(())
}

/// Trains with a progress bar.
pub fn run(
    config: &TrainConfig,
    reader: Arc<dyn Reader>,
    out: &Path,
    resume: bool,
    context: &Context,
) -> Result<TrainSummary> {
    let mut bar = Bar(Progress::new("train", config.schedule.steps));
    let options = TrainOptions { resume, threads: context.threads, ..TrainOptions::default() };
    let summary = swm_models::train(config, reader, out, &options, &mut bar, &context.stop)?;
    bar.0.done(&format!(
        "{} steps in {:.0} s ({} parameters, {:.0} clips/s, {:.0} % of it waiting for data), {}",
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

struct Bar(Progress);

impl Observer for Bar {
    fn progress(&mut self, at: &swm_models::Progress) {
        self.0.at(
            at.step,
            format!(
                "loss {:.3} (prediction {:.4}, SIGReg {:.2}), {:.0} clips/s, waits {:.0} %",
                at.losses.total,
                at.losses.prediction,
                at.losses.sigreg,
                at.clips_per_second,
                100.0 * at.data_wait
            ),
        );
    }
}
