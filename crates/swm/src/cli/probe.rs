//! `swm probe`: predicts columns and reconstructs images from a checkpoint's latents, or predicts columns from images with an
//! encoder that is trained with labels.

use super::progress::control;
use super::{Context, devices, emit, emit_json, output_folder, table};
use crate::home;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm_core::Error;
use swm_core::columns::POS_AGENT;
use swm_data::{Reader, check_png, write_png};
use swm_models::TrainConfig;
use swm_models::lewm::{Lewm, LewmConfig};
use swm_models::pixels::ImageNormalization;
use swm_models::probe::{
    self, AnglePart, FitConfig, Reconstruction, ReconstructionConfig, Score, StateConfig, StateReport,
};

/// Arguments of `swm probe`. Probes are fitted on the training episodes of the dataset, and evaluated on its validation
/// episodes.
#[derive(Args)]
pub struct ProbeArgs {
    /// The checkpoint: a run folder or a name
    #[arg(required_unless_present = "supervised", conflicts_with = "supervised")]
    checkpoint: Option<String>,
    /// Train the encoder of this LeWM preset with labels: what its latents can hold
    #[arg(long, value_name = "PRESET", requires = "columns", conflicts_with_all = ["baseline", "images"])]
    supervised: Option<String>,
    /// The dataset: a path, a URI or a name
    #[arg(long, value_name = "DATASET")]
    data: String,
    /// Columns to predict from latents, such as state,goal_state
    #[arg(long, value_name = "COLUMN,…", value_delimiter = ',')]
    columns: Vec<String>,
    /// Columns that predict without an image (default: pos_agent, if present)
    #[arg(long, value_name = "COLUMN,…", value_delimiter = ',', requires = "columns")]
    baseline: Vec<String>,
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
    /// Device of the checkpoint's encoder: cpu, vulkan[:I], cuda[:I] or auto
    ///
    /// Probes are fitted on the CPU.
    #[arg(long, default_value = "cpu", conflicts_with = "supervised")]
    device: String,
}

/// Runs `swm probe`.
pub fn probe(args: &ProbeArgs, context: &Context) -> anyhow::Result<()> {
    if let Some(preset) = &args.supervised {
        return supervised(preset, args, context);
    }
    let checkpoint = args.checkpoint.as_deref().unwrap_or_default();
    let run = home::find_checkpoint(checkpoint)?;
    let loaded = swm_models::load(&run, &devices::open(&args.device)?)?;
    let Some(encoder) = loaded.encoder() else {
        let problem = format!("a {} model has no image encoder", loaded.info()?.family);
        return Err(Error::config(checkpoint, problem, "probe a model with an image encoder").into());
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
        let mut config = state_config(args, &*reader, StateConfig::new(args.columns.clone()));
        config.baseline = args.baseline.clone();
        if config.baseline.is_empty() && reader.schema().find(POS_AGENT).is_some() {
            config.baseline.push(POS_AGENT.to_owned());
        }
        Some(threads.install(|| probe::read_state(&*encoder, &*reader, &config, &mut control(context)))?)
    };
    let reconstruction = match &args.images {
        None => None,
        Some(file) => {
            let mut config = ReconstructionConfig { seed: args.seed, ..ReconstructionConfig::default() };
            config.frames = args.frames.unwrap_or(config.frames);
            config.fit.steps = args.steps.unwrap_or(config.fit.steps);
            let fitted = || probe::reconstruct_images(&*encoder, &*reader, &config, &mut control(context));
            let Reconstruction { report, sheet, .. } = threads.install(fitted)?;
            let _lock = output_folder::claim_file(file)?;
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
            "reconstructed images: root mean squared error {:.2} of 255 (of the mean image: {:.2}), {:.1} % of the variance explained; {}\n",
            report.rmse,
            report.rmse_of_mean,
            100.0 * report.explained,
            file.display()
        ));
    }
    Ok(())
}

/// The frames and the optimizer steps of an encoder that is trained with labels.
const SUPERVISED: (usize, FitConfig) = (40_000, FitConfig { steps: 4000, batch_size: 128, lr: 1e-3 });

/// Trains the encoder of a LeWM preset with labels and shows the scores.
fn supervised(preset: &str, args: &ProbeArgs, context: &Context) -> anyhow::Result<()> {
    let LewmConfig { image, pixel_mean, pixel_std, encoder, .. } = TrainConfig::<Lewm>::load(preset, &[])?.model;
    let images = ImageNormalization { side: image, mean: pixel_mean, std: pixel_std };
    let reader = home::open_dataset(&args.data)?;
    let (frames, fit) = SUPERVISED;
    let defaults = StateConfig { frames, fit, ..StateConfig::new(args.columns.clone()) };
    let config = state_config(args, &*reader, defaults);
    let threads = swm_core::pool::threads(context.threads)?;
    let report =
        threads.install(|| probe::train_encoder(&encoder, &images, &*reader, &config, &mut control(context)))?;
    if context.json {
        return emit_json(&json!({ "supervised": report }));
    }
    let rows = report
        .scores
        .iter()
        .map(|score| vec![element(score), format!("{:.3}", score.spread), r2(score.r2), format!("{:.3}", score.rmse)]);
    emit(&table(&["element", "spread", "R²", "RMSE"], rows));
    emit(&format!(
        "trained with labels on {} frames of {} px, evaluated on {} frames of other episodes; last loss {:.4}\n",
        report.frames, report.image, report.held_out, report.loss
    ));
    Ok(())
}

/// Returns the settings of a probe of columns: those of the command line, else the defaults.
fn state_config(args: &ProbeArgs, reader: &dyn Reader, mut defaults: StateConfig) -> StateConfig {
    defaults.frames = args.frames.unwrap_or(defaults.frames);
    defaults.fit.steps = args.steps.unwrap_or(defaults.fit.steps);
    StateConfig { seed: args.seed, angles: angles(reader), ..defaults }
}

/// Returns the elements of a dataset's columns that are angles, as its environment declares them; none for an environment
/// that is not built in or not available.
fn angles(reader: &dyn Reader) -> Vec<(String, usize)> {
    let manifest = reader.manifest();
    let id = manifest.as_ref().and_then(|manifest| manifest.config["env"].as_str());
    let env = id.and_then(|id| crate::ENVS.choose(id).and_then(|choice| choice.env()).ok());
    let angles = env.map(|env| env.spec().angles.clone()).unwrap_or_default();
    angles.into_iter().map(|(column, index)| (column.to_owned(), index)).collect()
}

/// Returns the name of a predicted element.
pub fn element(score: &Score) -> String {
    let element = format!("{}[{}]", score.column, score.index);
    match score.part {
        None => element,
        Some(AnglePart::Sin) => format!("sin {element}"),
        Some(AnglePart::Cos) => format!("cos {element}"),
    }
}

/// Formats a coefficient of determination.
fn r2(r2: Option<f64>) -> String {
    r2.map_or("–".to_owned(), |r2| format!("{r2:.3}"))
}

/// Returns a table of the predicted columns, element by element.
fn state_table(report: &StateReport) -> String {
    let baseline = report.baseline.as_ref();
    let row = |(i, (linear, network)): (usize, (&Score, &Score))| {
        let mut row = vec![
            element(linear),
            format!("{:.3}", linear.spread),
            r2(linear.r2),
            format!("{:.3}", linear.rmse),
            r2(network.r2),
            format!("{:.3}", network.rmse),
        ];
        row.extend(baseline.map(|baseline| r2(baseline.network[i].r2)));
        row
    };
    let mut header = vec!["element", "spread", "linear R²", "linear RMSE", "network R²", "network RMSE"];
    let from = baseline.map(|baseline| baseline.columns.join(","));
    let from_baseline = from.as_ref().map(|from| format!("R² from {from}"));
    header.extend(from_baseline.as_deref());
    let rows = report.linear.iter().zip(&report.network).enumerate().map(row);
    let latents = baseline.zip(from).map_or(String::new(), |(baseline, from)| {
        let share = baseline.latent_variance.map_or("–".to_owned(), |share| format!("{:.1} %", 100.0 * share));
        format!("a network from {from} explains {share} of the variance of the latents\n")
    });
    format!(
        "{}{latents}latent dimension {}; fitted on {} frames, evaluated on {} frames of other episodes; errors are in the \
         column's units\n",
        table(&header, rows),
        report.latent,
        report.frames,
        report.held_out
    )
}
