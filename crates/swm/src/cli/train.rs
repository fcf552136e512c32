//! `swm train`: train a model on a dataset.

use super::{Context, Progress, emit, emit_json, models::MODELS};
use clap::Args;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm::home;
use swm_core::{Error, Result};
use swm_data::Reader;
use swm_models::inverse::InverseConfig;
use swm_models::{Checkpoint, Device, Observer, TrainConfig, TrainOptions, TrainSummary};

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
    /// The checkpoint whose frozen encoder is used: a path or a name (inverse only)
    #[arg(long, value_name = "CHECKPOINT")]
    encoder: Option<String>,
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
    if args.model == "inverse" {
        return inverse(args, context);
    }
    if args.encoder.is_some() {
        anyhow::bail!(Error::config(
            "--encoder",
            "lewm trains an encoder of its own",
            "leave it out, or train inverse"
        ));
    }
    let config = TrainConfig::load(&args.preset, &args.settings)?;
    if args.print_config {
        if context.json {
            return emit_json(&config);
        }
        emit(&config.to_toml()?);
        return Ok(());
    }
    let (reader, out) = args.places()?;
    let summary = run(&config, reader, &out, args.resume, context)?;
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
            return Err(Error::config("--data", "no dataset is given", "name one (`swm datasets` lists them)"));
        };
        let name = self.output.clone().unwrap_or_else(|| {
            let stem = Path::new(data).file_stem().unwrap_or_default().to_string_lossy();
            format!("{}-{stem}", self.model)
        });
        Ok((home::open_dataset(data)?, home::checkpoint(&name)))
    }
}

/// Trains an inverse-dynamics policy on the encoder of a checkpoint.
fn inverse(args: &TrainArgs, context: &Context) -> anyhow::Result<()> {
    let config = InverseConfig::load(&args.settings)?;
    if args.print_config {
        if context.json {
            return emit_json(&config);
        }
        emit(&config.to_toml()?);
        return Ok(());
    }
    let Some(encoder) = &args.encoder else {
        let fix = "name a checkpoint with --encoder (`swm checkpoints` lists them)";
        anyhow::bail!(Error::config(
            "--encoder",
            "an inverse-dynamics policy sees through another model's encoder",
            fix
        ));
    };
    if args.resume {
        let fix = "leave out --resume and choose another --output";
        anyhow::bail!(Error::config(
            "--resume",
            "training an inverse-dynamics policy takes seconds and begins anew",
            fix
        ));
    }
    let world = Checkpoint::load(&home::find_checkpoint(encoder)?, &Device::flex())?;
    let (reader, out) = args.places()?;
    let mut bar = Progress::new("train", config.schedule.steps);
    let watched = &mut bar;
    // Borrowed for itself alone: the bar may move to the thread that trains, but not be shared with it.
    let mut watch = |at: swm_models::inverse::InverseProgress| {
        let bar: &mut Progress = &mut *watched;
        bar.at(at.step, format!("loss {:.3}", at.loss));
    };
    let summary =
        swm_models::inverse::train(&config, &world, reader, &out, context.threads, &mut watch, &context.stop)?;
    bar.done(&format!("{} steps in {:.0} s, {}", summary.steps, summary.seconds, out.display()));
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
