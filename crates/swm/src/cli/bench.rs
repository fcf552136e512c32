//! `swm bench`: measures speed, compared with the reference implementation where it is installed.

use super::config::{count, seconds};
use super::{Context, devices, emit, emit_json, eprint, table};
use crate::ENVS;
use crate::step_subject::StepSubject;
use crate::subject::{LewmSubject, LewmWork};
use clap::{Args, Subcommand};
use std::sync::Arc;
use swm_bench::{
    BenchConfig, DataBenchConfig, Drawing, ModelBenchConfig, ModelBenchReport, PlanBenchConfig, RenderBenchConfig,
    Subject, Work, bench_data, bench_envs, bench_model, bench_plan, bench_render,
};
use swm_core::limits::{ENVS as PARALLEL, IMAGE_SIDE};
use swm_core::run::Control;
use swm_core::{EnvChoice, Origin};
use swm_data::Location;
use swm_models::sac::Sac;
use swm_models::tdmpc2::Tdmpc2;
use swm_mujoco::render::{Choice as Renderer, name, with};

/// Arguments of `swm bench`.
#[derive(Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Subcommand)]
enum BenchCommand {
    /// Measure steps per second of environments, and collecting into Lance
    ///
    /// The reference implementation is measured in turn where SWM_REFERENCE_PYTHON names a Python with its package.
    #[command(after_help = "Example: swm bench envs swm/PushT-v1")]
    Envs(EnvsArgs),
    /// Measure planning with CEM: the solver alone, then with a LeWM
    ///
    /// First, iterations per second with a model that takes no time, and the solver's fraction of the time of a plan;
    /// then, with a LeWM of the published size, a plan, the costs of one iteration, and the encoding of an image.
    #[command(after_help = "Example: swm bench plan --envs 16")]
    Plan(PlanArgs),
    /// Measure a training step of a LeWM of the published size
    #[command(after_help = "Example: swm bench train --device cpu")]
    Train(TrainArgs),
    /// Measure the encoding of images by a LeWM of the published size
    #[command(after_help = "Example: swm bench encode --frames 256")]
    Encode(EncodeArgs),
    /// Measure training steps of SAC and TD-MPC2 at the published sizes
    ///
    /// SAC is compared with Stable-Baselines3, TD-MPC2 with the reference implementation.
    #[command(after_help = "Example: swm bench online sac")]
    Online(OnlineArgs),
    /// Measure loading from every format, conversions, and memory over epochs
    #[command(after_help = "Example: swm bench data --formats lance,hdf5")]
    Data(DataArgs),
    /// Measure frames per second of every renderer, by environment and size
    ///
    /// Renderers use one thread, or as many as --threads permits.
    #[command(after_help = "Example: swm bench render --sizes 64")]
    Render(RenderArgs),
    /// Measure frames per second and latency of the lab in a browser
    ///
    /// The page is opened in a Chromium without a window. Frames are those of an expert, or of random actions.
    #[command(after_help = "Example: swm bench lab swm/PushT-v1 swm/HumanoidDMControl-v0")]
    Lab(super::lab::LabBenchArgs),
}

#[derive(Args)]
struct RenderArgs {
    /// Ids of environments (default: all 3-D environments)
    envs: Vec<String>,
    /// Frame sizes, in pixels
    #[arg(long, value_delimiter = ',', default_value = "64,224", value_parser = count::<1, { IMAGE_SIDE.max }>)]
    sizes: Vec<usize>,
    /// Measurements per renderer
    #[arg(long, default_value_t = 5, value_parser = count::<1, 1000>)]
    turns: usize,
    /// Seconds per measurement
    #[arg(long, default_value_t = 0.5, value_parser = seconds)]
    seconds: f64,
}

/// Measures renderers.
fn render(args: &RenderArgs, context: &Context) -> anyhow::Result<()> {
    let envs: Vec<EnvChoice> = match &args.envs[..] {
        [] => swm_mujoco::ENVS.rows.iter().map(EnvChoice::from).collect(),
        ids => ids.iter().map(|id| crate::env(id, &Origin::User)).collect::<swm_core::Result<_>>()?,
    };
    let cpu = |work: &mut dyn FnMut() -> swm_core::Result<()>| with(Renderer::Cpu, work);
    let egl = |work: &mut dyn FnMut() -> swm_core::Result<()>| with(Renderer::Egl, work);
    let mut renderers: Vec<(String, &Drawing<'_>)> = vec![(with(Renderer::Cpu, name)?, &cpu)];
    match with(Renderer::Egl, name) {
        Ok(name) => renderers.push((name, &egl)),
        Err(problem) => eprint(&format!("{problem}\n")),
    }
    let threads = context.threads.max(1);
    let config = RenderBenchConfig { sizes: args.sizes.clone(), turns: args.turns, seconds: args.seconds, threads };
    let rows = bench_render(&envs, &renderers, &config, &mut control(context))?;
    if context.json {
        return emit_json(&rows);
    }
    let rows = rows.iter().map(|row| {
        let speed = format!("{:.0}", row.frames_per_second);
        vec![row.env.clone(), format!("{} px", row.size), row.renderer.clone(), speed]
    });
    emit(&table(&["environment", "frame size", "renderer", "frames/s"], rows));
    let on = if threads == 1 { "one thread".to_owned() } else { format!("up to {threads} threads per frame") };
    emit(&format!("{on}, medians of {} measurements\n", args.turns));
    Ok(())
}

#[derive(Args)]
struct DataArgs {
    /// The environment whose frames are loaded
    #[arg(default_value = "swm/PushT-v1")]
    env: String,
    /// Formats to load from (default: all)
    #[arg(long, value_delimiter = ',')]
    formats: Vec<String>,
    /// Episodes per dataset
    #[arg(long, default_value_t = 40, value_parser = count::<0, 1_000_000>)]
    episodes: usize,
    /// Steps per episode
    #[arg(long, default_value_t = 100, value_parser = count::<1, 1_000_000>)]
    steps: usize,
    /// Frame size, in pixels
    #[arg(long, default_value_t = 224, value_parser = count::<1, { IMAGE_SIDE.max }>)]
    size: usize,
    /// Pairs of measurements: this engine and the reference implementation
    #[arg(long, default_value_t = 5, value_parser = count::<0, 1000>)]
    pairs: usize,
    /// Seconds per measurement
    #[arg(long, default_value_t = 2.0, value_parser = seconds)]
    seconds: f64,
    /// Epochs over which memory use is measured
    #[arg(long, default_value_t = 10, value_parser = count::<0, 1_000_000>)]
    epochs: usize,
    /// Also load from a folder of an object store, such as s3://bucket/bench
    ///
    /// Environment variables such as AWS_ENDPOINT_URL configure access.
    #[arg(long, value_name = "URI")]
    remote: Option<String>,
    /// Skip conversions
    #[arg(long)]
    load_only: bool,
}

/// Measures loading and converting.
fn data(args: &DataArgs, context: &Context) -> anyhow::Result<()> {
    let report = bench_data(
        &crate::env(&args.env, &Origin::User)?,
        &DataBenchConfig {
            episodes: args.episodes,
            steps: args.steps,
            size: args.size,
            pairs: args.pairs,
            seconds: args.seconds,
            formats: args.formats.clone(),
            convert: !args.load_only,
            epochs: args.epochs,
            remote: args.remote.as_deref().map(Location::parse).transpose()?,
            threads: if context.threads > 0 { context.threads } else { DataBenchConfig::default().threads },
            ..DataBenchConfig::default()
        },
        &mut control(context),
    )?;
    if context.json {
        return emit_json(&report);
    }
    emit(&report.to_string());
    Ok(())
}

#[derive(Args)]
struct PlanArgs {
    /// Environments per planning call
    #[arg(long, value_delimiter = ',', default_value = "1,16", value_parser = count::<1, { PARALLEL.max }>)]
    envs: Vec<usize>,
    /// Pairs of measurements: this engine and the reference implementation
    #[arg(long, default_value_t = 5, value_parser = count::<0, 1000>)]
    pairs: usize,
    /// Seconds per measurement with a model that takes no time
    #[arg(long, default_value_t = 1.0, value_parser = seconds)]
    seconds: f64,
    /// Iterations per plan with a LeWM; 0 skips the LeWM
    #[arg(long, default_value_t = 30, value_parser = count::<0, 1_000_000>)]
    iterations: usize,
    /// Environments of a plan with the LeWM
    #[arg(long, default_value_t = 1, value_parser = count::<1, { PARALLEL.max }>)]
    model_envs: usize,
    /// Compute the candidates of all environments in one call to a GPU
    #[arg(long)]
    fast: bool,
    #[command(flatten)]
    on: OnArgs,
}

/// What computes a LeWM, here and in PyTorch.
#[derive(Args)]
struct OnArgs {
    /// Device of the LeWM: cpu, vulkan[:I], cuda[:I] or auto
    ///
    /// A GPU's matrix products have the precision after a comma: cuda:0,bf16.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// How PyTorch computes: eager or compile, then -tf32 or -bf16
    #[arg(long, value_delimiter = ',', default_value = "eager",
          value_parser = ["eager", "eager-tf32", "eager-bf16", "compile", "compile-tf32", "compile-bf16"])]
    torch: Vec<String>,
}

/// Measures the solver alone, then planning with a LeWM.
fn plan(args: &PlanArgs, context: &Context) -> anyhow::Result<()> {
    let config = PlanBenchConfig {
        envs: args.envs.clone(),
        pairs: args.pairs,
        seconds: args.seconds,
        threads: context.threads,
        ..PlanBenchConfig::default()
    };
    let planner = bench_plan(&config, &mut control(context))?;
    if args.iterations > 0 {
        let works = vec![(Work::Plan, 1), (Work::Cost, 2), (Work::Encode, 10)];
        let (iterations, envs, together) = (args.iterations, args.model_envs, args.fast);
        let work = LewmWork { preset: "paper", iterations, envs, together, frames: 1, clips: 2 };
        let models = lewm(&work, &works, args.pairs, &args.on, context)?;
        if context.json {
            return emit_json(&serde_json::json!({ "planner": planner, "models": models }));
        }
        emit(&format!("{planner}{envs} environments per plan with a LeWM\n{}", lines(&models)));
    } else if context.json {
        return emit_json(&serde_json::json!({ "planner": planner }));
    } else {
        emit(&planner.to_string());
    }
    Ok(())
}

#[derive(Args)]
struct TrainArgs {
    /// Preset of LeWM: paper or small
    #[arg(long, default_value = "paper")]
    preset: String,
    /// Clips per batch
    #[arg(long, default_value_t = 8, value_parser = count::<1, 4096>)]
    clips: usize,
    /// Pairs of measurements: this engine and the reference implementation
    #[arg(long, default_value_t = 5, value_parser = count::<0, 1000>)]
    pairs: usize,
    #[command(flatten)]
    on: OnArgs,
}

/// Measures training.
fn train(args: &TrainArgs, context: &Context) -> anyhow::Result<()> {
    let clips = args.clips;
    let work = LewmWork { preset: &args.preset, iterations: 1, envs: 1, together: false, frames: 1, clips };
    let reports = lewm(&work, &[(Work::Train, 1)], args.pairs, &args.on, context)?;
    if context.json {
        return emit_json(&reports);
    }
    emit(&format!("{}{clips} clips per step: {:.1} clips/s\n", lines(&reports), rate(&reports, clips)));
    Ok(())
}

#[derive(Args)]
struct EncodeArgs {
    /// Preset of LeWM: paper or small
    #[arg(long, default_value = "paper")]
    preset: String,
    /// Images encoded at once
    #[arg(long, default_value_t = 64, value_parser = count::<1, 4096>)]
    frames: usize,
    /// Pairs of measurements: this engine and the reference implementation
    #[arg(long, default_value_t = 5, value_parser = count::<0, 1000>)]
    pairs: usize,
    #[command(flatten)]
    on: OnArgs,
}

/// Measures the encoding of images.
fn encode(args: &EncodeArgs, context: &Context) -> anyhow::Result<()> {
    let frames = args.frames;
    let work = LewmWork { preset: &args.preset, iterations: 1, envs: 1, together: false, frames, clips: 2 };
    let reports = lewm(&work, &[(Work::Frames, 2), (Work::Encode, 10)], args.pairs, &args.on, context)?;
    if context.json {
        return emit_json(&reports);
    }
    emit(&format!("{}{frames} images at once: {:.0} images/s\n", lines(&reports), rate(&reports, frames)));
    Ok(())
}

#[derive(Args)]
struct OnlineArgs {
    /// The family
    #[arg(value_parser = ["sac", "tdmpc2"])]
    family: String,
    /// Elements of an observation
    #[arg(long, default_value_t = 24, value_parser = count::<1, 10_000>)]
    observation: usize,
    /// Elements of an action
    #[arg(long, default_value_t = 6, value_parser = count::<1, 1000>)]
    action: usize,
    /// Training steps per measurement
    #[arg(long, default_value_t = 50, value_parser = count::<1, 1_000_000>)]
    steps: usize,
    /// Pairs of measurements: this engine and the reference implementation
    #[arg(long, default_value_t = 5, value_parser = count::<0, 1000>)]
    pairs: usize,
    /// Other settings than the preset's, such as model.hidden=128
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// Measures training steps of a family that is trained online.
fn online(args: &OnlineArgs, context: &Context) -> anyhow::Result<()> {
    let OnlineArgs { family, observation, action, steps, pairs, settings } = args;
    let (mut sizes, mut subject): (serde_json::Value, Box<dyn Subject + Send>) = if family == "sac" {
        let subject = StepSubject::<Sac>::new(settings, *observation, *action)?;
        let (model, loss) = (&subject.config.model, &subject.config.loss);
        let sizes = serde_json::json!({ "hidden": model.hidden, "tau": loss.tau, "discount": loss.discount,
            "batch": subject.config.data.batch_size, "lr": subject.config.optim.lr });
        (sizes, Box::new(subject))
    } else {
        let subject = StepSubject::<Tdmpc2>::new(settings, *observation, *action)?;
        let (model, loss) = (&subject.config.model, &subject.config.loss);
        let latent: usize = model.encoding.iter().map(|encoding| encoding.latent).sum();
        let sizes = serde_json::json!({ "hidden": model.hidden, "tau": loss.tau, "discount": loss.discount,
            "batch": subject.config.data.batch_size, "lr": subject.config.optim.lr, "latent": latent, "encoder": model.encoder,
            "simplex": model.simplex, "critics": model.critics, "bins": model.bins.count,
            "horizon": subject.config.data.num_steps - 1 });
        (sizes, Box::new(subject))
    };
    sizes["family"] = serde_json::json!(family);
    (sizes["observation"], sizes["action"]) = (serde_json::json!(observation), serde_json::json!(action));
    let report = swm_core::pool::threads(context.threads)?.install(|| {
        let python = PlanBenchConfig::default().python;
        let config = ModelBenchConfig {
            model: family.clone(),
            works: vec![(Work::Train, *steps)],
            pairs: *pairs,
            sizes,
            python,
        };
        bench_model(&config, None, &mut *subject, &mut control(context))
    })?;
    if context.json {
        return emit_json(&report);
    }
    let rate = report.rows.first().map_or(0.0, |row| 1.0 / row.seconds);
    emit(&format!("{report}{rate:.0} training steps/s\n"));
    Ok(())
}

/// What the first workload processes in a second, if a repetition processes `count`.
fn rate(reports: &[ModelBenchReport], count: usize) -> f64 {
    reports.first().and_then(|report| report.rows.first()).map_or(0.0, |row| count as f64 / row.seconds)
}

/// The reports one below the other.
fn lines(reports: &[ModelBenchReport]) -> String {
    reports.iter().map(ToString::to_string).collect()
}

/// Measures a LeWM with the sizes of a preset; returns a report for each way in which PyTorch computes.
fn lewm(
    work: &LewmWork<'_>,
    works: &[(Work, usize)],
    pairs: usize,
    on: &OnArgs,
    context: &Context,
) -> anyhow::Result<Vec<ModelBenchReport>> {
    let device = devices::open(&on.device)?;
    let weights = tempfile::NamedTempFile::new()?;
    let reports = swm_core::pool::threads(context.threads)?.install(|| {
        let mut subject = LewmSubject::new(work, &device)?;
        subject.write(weights.path())?;
        let mut measure = |torch: &String| {
            let mut sizes = subject.sizes()?;
            sizes["torch"] = serde_json::json!(torch);
            let python = PlanBenchConfig::default().python;
            let config = ModelBenchConfig { model: "LeWM".to_owned(), works: works.to_vec(), pairs, sizes, python };
            bench_model(&config, Some(weights.path()), &mut subject, &mut control(context))
        };
        on.torch.iter().map(&mut measure).collect::<swm_core::Result<_>>()
    })?;
    Ok(reports)
}

#[derive(Args)]
struct EnvsArgs {
    /// Ids of environments (default: all)
    envs: Vec<String>,
    /// Environments stepped at the same time
    #[arg(long, default_value_t = 8, value_parser = count::<1, { PARALLEL.max }>)]
    num_envs: usize,
    /// Frame sizes, in pixels
    #[arg(long, value_delimiter = ',', default_value = "224,64", value_parser = count::<1, { IMAGE_SIDE.max }>)]
    sizes: Vec<usize>,
    /// Skip stepping without rendering
    #[arg(long, alias = "pictures-only")]
    frames_only: bool,
    /// Pairs of measurements: this engine and the reference implementation
    #[arg(long, default_value_t = 5, value_parser = count::<0, 1000>)]
    pairs: usize,
    /// Seconds per measurement
    #[arg(long, default_value_t = 1.0, value_parser = seconds)]
    seconds: f64,
    /// Episodes that the reference collects per measurement; 0 skips collecting
    #[arg(long, default_value_t = 8, value_parser = count::<0, 1_000_000>)]
    episodes: usize,
    /// Steps per collected episode; resets weigh more in shorter episodes
    #[arg(long, default_value_t = 50, value_parser = count::<1, 1_000_000>)]
    episode_steps: usize,
}

/// A control that stops a benchmark at Ctrl-C and shows no progress, which would take time from the measurements.
fn control(context: &Context) -> Control<'static> {
    Control::new().with_interrupt(Arc::clone(&context.interrupt))
}

/// Runs a benchmark and prints its report.
pub fn bench(args: &BenchArgs, context: &Context) -> anyhow::Result<()> {
    match &args.command {
        BenchCommand::Envs(args) => envs(args, context),
        BenchCommand::Plan(args) => plan(args, context),
        BenchCommand::Train(args) => train(args, context),
        BenchCommand::Encode(args) => encode(args, context),
        BenchCommand::Online(args) => online(args, context),
        BenchCommand::Data(args) => data(args, context),
        BenchCommand::Render(args) => render(args, context),
        BenchCommand::Lab(args) => super::lab::bench(args, context),
    }
}

/// Measures environments.
fn envs(args: &EnvsArgs, context: &Context) -> anyhow::Result<()> {
    let entries: Vec<EnvChoice> = match &args.envs[..] {
        [] => ENVS.rows.iter().map(EnvChoice::from).collect(),
        ids => ids.iter().map(|id| crate::env(id, &Origin::User)).collect::<swm_core::Result<_>>()?,
    };
    let report = bench_envs(
        &entries,
        &BenchConfig {
            envs: args.num_envs,
            sizes: args.sizes.clone(),
            bare: !args.frames_only,
            episode_steps: args.episode_steps,
            threads: context.threads,
            pairs: args.pairs,
            seconds: args.seconds,
            episodes: args.episodes,
            ..BenchConfig::default()
        },
        &mut control(context),
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
    emit(&table(&["environment", "work", "frame size", "steps/s", "reference", "ratio"], rows));
    emit(&format!(
        "{} environments, {} threads, medians of {} measurements; reference: {}\n",
        report.envs, report.threads, args.pairs, report.reference
    ));
    Ok(())
}
