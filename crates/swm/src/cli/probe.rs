//! `swm probe`: predicts columns and reconstructs images from a checkpoint's latents.

use super::{Context, emit, emit_json, output_folder, table};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm_core::Error;
use swm_data::{check_png, write_png};
use swm_models::Device;
use swm_models::probe::{self, ReconstructionConfig, Score, StateConfig, StateReport};

/// Arguments of `swm probe`. Probes are fitted on the training episodes of the dataset, and evaluated on its validation
/// episodes.
#[derive(Args)]
pub struct ProbeArgs {
    /// The checkpoint: a run folder or a name
    checkpoint: String,
    /// The dataset: a path, a URI or a name
    #[arg(long, value_name = "DATASET")]
    data: String,
    /// Columns to predict from latents, such as state,goal_state
    #[arg(long, value_name = "COLUMN,…", value_delimiter = ',')]
    columns: Vec<String>,
    /// Reconstruct images from latents; write samples to this PNG file
    #[arg(long, alias = "pictures", value_name = "FILE")]
    images: Option<PathBuf>,
    /// Maximum number of frames to fit on
    #[arg(long)]
    frames: Option<usize>,
    /// Optimizer steps per network
    #[arg(long)]
    steps: Option<usize>,
    /// Seed of frames, initial weights and batches
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Runs `swm probe`.
pub fn probe(args: &ProbeArgs, context: &Context) -> anyhow::Result<()> {
    let run = home::find_checkpoint(&args.checkpoint)?;
    let loaded = swm_models::load(&run, &Device::flex())?;
    let Some(encoder) = loaded.encoder() else {
        let problem = format!("a {} model has no image encoder", loaded.info()?.family);
        return Err(Error::config(&args.checkpoint, problem, "probe a model with an image encoder").into());
    };
    if args.columns.is_empty() && args.images.is_none() {
        let fix = "name columns with --columns (`swm inspect` lists them), or a file with --images";
        return Err(Error::config("swm probe", "no columns and no images are requested", fix).into());
    }
    if let Some(file) = &args.images {
        output_folder::check_file(file)?;
        check_png(file)?;
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
    let reconstruction = match &args.images {
        None => None,
        Some(file) => {
            let mut config = ReconstructionConfig { seed: args.seed, ..ReconstructionConfig::default() };
            config.frames = args.frames.unwrap_or(config.frames);
            config.fit.steps = args.steps.unwrap_or(config.fit.steps);
            let (report, sheet) = threads.install(|| probe::reconstruct_images(&*encoder, &*reader, &config))?;
            write_png(file, sheet.width, sheet.height, &sheet.rgb)?;
            Some((report, file))
        }
    };
    if context.json {
        let reconstruction = reconstruction.map(|(report, _)| report);
        return emit_json(&json!({ "state": state, "pictures": reconstruction }));
    }
    if let Some(report) = state {
        emit(&state_table(&report));
    }
    if let Some((report, file)) = reconstruction {
        emit(&format!(
            "reconstructed images: error {:.2} of 255 (of the mean image: {:.2}), {:.1} % of the variance explained; {}\n",
            report.rmse,
            report.rmse_of_mean,
            100.0 * report.explained,
            file.display()
        ));
    }
    Ok(())
}

/// Returns a table of the predicted columns, element by element.
fn state_table(report: &StateReport) -> String {
    let r2 = |r2: Option<f64>| r2.map_or("–".to_owned(), |r2| format!("{r2:.3}"));
    let row = |(linear, network): (&Score, &Score)| {
        vec![
            format!("{}[{}]", linear.column, linear.index),
            format!("{:.3}", linear.spread),
            r2(linear.r2),
            format!("{:.3}", linear.rmse),
            r2(network.r2),
            format!("{:.3}", network.rmse),
        ]
    };
    let header = ["element", "spread", "linear R²", "linear RMSE", "network R²", "network RMSE"];
    let rows = report.linear.iter().zip(&report.network).map(row);
    format!(
        "{}latent dimension {}; fitted on {} frames, evaluated on {} frames of other episodes; errors are in the column's \
         units\n",
        table(&header, rows),
        report.latent,
        report.frames,
        report.held_out
    )
}
