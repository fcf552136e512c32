//! `swm probe`: what a checkpoint's latents say about the world.

use super::{Context, emit, emit_json, table};
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm::home;
use swm_core::Error;
use swm_data::write_png;
use swm_models::Device;
use swm_models::probe::{self, ReconstructionConfig, Score, StateConfig};

/// Arguments of `swm probe`. Read-outs are fitted on episodes that models are trained on, and judged on those held out for
/// validation.
#[derive(Args)]
pub struct ProbeArgs {
    /// The checkpoint: a run folder or a name
    checkpoint: String,
    /// The dataset: a path, a URI or a name
    #[arg(long, value_name = "DATASET")]
    data: String,
    /// Columns to read from latents, such as state,goal_state
    #[arg(long, value_name = "COLUMN,…", value_delimiter = ',')]
    columns: Vec<String>,
    /// Draw pictures again from latents, and write some beside the originals to a PNG file
    #[arg(long, value_name = "FILE")]
    pictures: Option<PathBuf>,
    /// Frames to fit on, at most
    #[arg(long)]
    frames: Option<usize>,
    /// Steps to fit each network
    #[arg(long)]
    steps: Option<usize>,
    /// What decides frames, initial weights and batches
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Probes a checkpoint.
pub fn probe(args: &ProbeArgs, context: &Context) -> anyhow::Result<()> {
    let run = home::find_checkpoint(&args.checkpoint)?;
    let loaded = swm_models::load(&run, &Device::flex())?;
    let Some(encoder) = loaded.encoder() else {
        let problem = format!("a {} has no encoder of pictures", loaded.info()?.family);
        return Err(Error::config(&args.checkpoint, problem, "probe a model that sees").into());
    };
    if args.columns.is_empty() && args.pictures.is_none() {
        let fix = "name columns with --columns (`swm inspect` lists them), or a file with --pictures";
        return Err(Error::config("swm probe", "nothing to read", fix).into());
    }
    let reader = home::open_dataset(&args.data)?;
    let threads = swm_core::pool::threads(context.threads)?;
    let state = if args.columns.is_empty() {
        None
    } else {
        let mut config = StateConfig { seed: args.seed, ..StateConfig::new(args.columns.clone()) };
        config.frames = args.frames.unwrap_or(config.frames);
        config.fit.steps = args.steps.unwrap_or(config.fit.steps);
        Some(threads.install(|| probe::read_state(&*encoder, &*reader, &config))?)
    };
    let picture = match &args.pictures {
        None => None,
        Some(file) => {
            let mut config = ReconstructionConfig { seed: args.seed, ..ReconstructionConfig::default() };
            config.frames = args.frames.unwrap_or(config.frames);
            config.fit.steps = args.steps.unwrap_or(config.fit.steps);
            let (report, sheet) = threads.install(|| probe::reconstruct_images(&*encoder, &*reader, &config))?;
            write_png(file, sheet.width, sheet.height, &sheet.rgb)?;
            Some(report)
        }
    };
    if context.json {
        return emit_json(&json!({ "state": state, "pictures": picture }));
    }
    if let Some(report) = state {
        let share = |r2: Option<f64>| r2.map_or("–".to_owned(), |r2| format!("{r2:.3}"));
        let row = |(linear, network): (&Score, &Score)| {
            vec![
                format!("{}[{}]", linear.column, linear.index),
                format!("{:.3}", linear.spread),
                share(linear.r2),
                format!("{:.3}", linear.rmse),
                share(network.r2),
                format!("{:.3}", network.rmse),
            ]
        };
        let header = ["number", "spread", "linear R²", "error", "network R²", "error"];
        emit(&table(&header, report.linear.iter().zip(&report.network).map(row)));
        emit(&format!(
            "latents of {} numbers; fitted on {} frames, judged on {} of other episodes; errors are root mean squares, in the \
             column's units\n",
            report.latent, report.frames, report.held_out
        ));
    }
    if let (Some(report), Some(file)) = (picture, &args.pictures) {
        emit(&format!(
            "pictures drawn again: {:.2} of 255 a pixel (their mean: {:.2}), {:.1} % of the variance; {}\n",
            report.rmse,
            report.rmse_of_mean,
            100.0 * report.explained,
            file.display()
        ));
    }
    Ok(())
}
