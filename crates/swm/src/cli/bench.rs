//! `swm bench`: how fast it is, beside the reference where it is installed.

use super::{Context, complain, emit, emit_json, table};
use clap::{Args, Subcommand};
use swm::ENVS;
use swm::subject::LewmSubject;
use swm_bench::{
    BenchConfig, DataBenchConfig, Drawing, ModelBenchConfig, ModelBenchReport, PlanBenchConfig, RenderBenchConfig,
    Work, bench_data, bench_envs, bench_model, bench_plan, bench_render,
};
use swm_core::EnvChoice;
use swm_data::Location;
use swm_models::device;
use swm_mujoco::render::{Choice as Renderer, name, with};

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
    /// Planning: iterations a second of CEM with a model that costs nothing, and the planner's share of the time beside a
    /// model; then a LeWM of the published size: a plan, the costs of one iteration, encoding a picture
    Plan(PlanArgs),
    /// A training step of a LeWM of the published size
    Train(TrainArgs),
    /// Clips a second from every format, and conversions; the use of memory over epochs
    Data(DataArgs),
    /// Pictures a second, by environment and size, drawn by each renderer there is: on one thread, or on so many as --threads says
    Render(RenderArgs),
}

#[derive(Args)]
struct RenderArgs {
    /// Which environments (default: all of three dimensions)
    envs: Vec<String>,
    /// Picture sizes
    #[arg(long, value_delimiter = ',', default_value = "64,224")]
    sizes: Vec<usize>,
    /// Turns of each renderer
    #[arg(long, default_value_t = 5)]
    turns: usize,
    /// Seconds of a turn
    #[arg(long, default_value_t = 0.5)]
    seconds: f64,
}

/// Measures renderers.
fn render(args: &RenderArgs, context: &Context) -> anyhow::Result<()> {
    let envs: Vec<EnvChoice> = match &args.envs[..] {
        [] => swm_mujoco::ENVS.rows.iter().map(EnvChoice::from).collect(),
        ids => ids.iter().map(|id| swm::env(id)).collect::<swm_core::Result<_>>()?,
    };
    let cpu = |work: &mut dyn FnMut() -> swm_core::Result<()>| with(Renderer::Cpu, work);
    let egl = |work: &mut dyn FnMut() -> swm_core::Result<()>| with(Renderer::Egl, work);
    let mut renderers: Vec<(String, &Drawing<'_>)> = vec![(with(Renderer::Cpu, name)?, &cpu)];
    match with(Renderer::Egl, name) {
        Ok(name) => renderers.push((name, &egl)),
        Err(problem) => complain(&format!("{problem}\n")),
    }
    let threads = context.threads.max(1);
    let config = RenderBenchConfig { sizes: args.sizes.clone(), turns: args.turns, seconds: args.seconds, threads };
    let rows = bench_render(&envs, &renderers, &config)?;
    if context.json {
        return emit_json(&rows);
    }
    let rows = rows.iter().map(|row| {
        let speed = format!("{:.0}", row.frames_per_second);
        vec![row.env.clone(), format!("{} px", row.size), row.renderer.clone(), speed]
    });
    emit(&table(&["environment", "pictures", "renderer", "pictures/s"], rows));
    let on = if threads == 1 { "one thread".to_owned() } else { format!("up to {threads} threads a picture") };
    emit(&format!("{on}, medians of {} turns\n", args.turns));
    Ok(())
}

#[derive(Args)]
struct DataArgs {
    /// The environment whose pictures are loaded
    #[arg(default_value = "swm/PushT-v1")]
    env: String,
    /// Formats to load from (default: all)
    #[arg(long, value_delimiter = ',')]
    formats: Vec<String>,
    /// Episodes of the datasets
    #[arg(long, default_value_t = 40)]
    episodes: usize,
    /// Steps of an episode
    #[arg(long, default_value_t = 100)]
    steps: usize,
    /// Picture size
    #[arg(long, default_value_t = 224)]
    size: usize,
    /// Pairs of turns, ours and the reference's
    #[arg(long, default_value_t = 5)]
    pairs: usize,
    /// Seconds of a turn
    #[arg(long, default_value_t = 2.0)]
    seconds: f64,
    /// Epochs over which the use of memory is watched
    #[arg(long, default_value_t = 10)]
    epochs: usize,
    /// A folder of an object store to load from beside this machine's disk, such as s3://bucket/bench; the environment says
    /// how it is reached (AWS_ENDPOINT_URL …)
    #[arg(long, value_name = "URI")]
    remote: Option<String>,
    /// Leave out converting
    #[arg(long)]
    load_only: bool,
}

/// Measures loading and converting.
fn data(args: &DataArgs, context: &Context) -> anyhow::Result<()> {
    let report = bench_data(
        &swm::env(&args.env)?,
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
    )?;
    if context.json {
        return emit_json(&report);
    }
    emit(&report.to_string());
    Ok(())
}

#[derive(Args)]
struct PlanArgs {
    /// Environments planned in one call
    #[arg(long, value_delimiter = ',', default_value = "1,16")]
    envs: Vec<usize>,
    /// Pairs of turns, ours and the reference's
    #[arg(long, default_value_t = 5)]
    pairs: usize,
    /// Seconds of a turn with a model that costs nothing
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
    /// Iterations of a plan with a LeWM; 0 leaves the LeWM out
    #[arg(long, default_value_t = 30)]
    iterations: usize,
    /// Where the LeWM computes: cpu, vulkan, cuda (:1 for the second such GPU) or auto
    #[arg(long, default_value = "cpu")]
    device: String,
}

/// Measures planners, and a model that is planned with.
fn plan(args: &PlanArgs, context: &Context) -> anyhow::Result<()> {
    let planner = bench_plan(&PlanBenchConfig {
        envs: args.envs.clone(),
        pairs: args.pairs,
        seconds: args.seconds,
        threads: context.threads,
        ..PlanBenchConfig::default()
    })?;
    if args.iterations > 0 {
        let works = vec![(Work::Plan, 1), (Work::Cost, 2), (Work::Encode, 10)];
        let model = lewm(works, args.iterations, 2, args.pairs, &args.device, context)?;
        if context.json {
            return emit_json(&serde_json::json!({ "planner": planner, "model": model }));
        }
        emit(&format!("{planner}{model}"));
    } else if context.json {
        return emit_json(&serde_json::json!({ "planner": planner }));
    } else {
        emit(&planner.to_string());
    }
    Ok(())
}

#[derive(Args)]
struct TrainArgs {
    /// Clips of a batch
    #[arg(long, default_value_t = 8)]
    clips: usize,
    /// Pairs of turns, ours and the reference's
    #[arg(long, default_value_t = 5)]
    pairs: usize,
    /// Where it computes: cpu, vulkan, cuda (:1 for the second such GPU) or auto
    #[arg(long, default_value = "cpu")]
    device: String,
}

/// Measures training.
fn train(args: &TrainArgs, context: &Context) -> anyhow::Result<()> {
    let report = lewm(vec![(Work::Train, 1)], 1, args.clips, args.pairs, &args.device, context)?;
    if context.json {
        return emit_json(&report);
    }
    let rate = report.rows.first().map_or(0.0, |row| args.clips as f64 / row.seconds);
    emit(&format!("{report}{} clips a step: {rate:.1} clips/s\n", args.clips));
    Ok(())
}

/// Measures a LeWM of the published size.
fn lewm(
    works: Vec<(Work, usize)>,
    iterations: usize,
    clips: usize,
    pairs: usize,
    name: &str,
    context: &Context,
) -> anyhow::Result<ModelBenchReport> {
    let device = device::parse(name)?;
    let weights = tempfile::NamedTempFile::new()?;
    Ok(swm_core::pool::threads(context.threads)?.install(|| {
        let mut subject = LewmSubject::new(iterations, clips, &device)?;
        subject.write(weights.path())?;
        let python = PlanBenchConfig::default().python;
        let config = ModelBenchConfig { works, pairs, sizes: subject.sizes(), python };
        bench_model(&config, weights.path(), &mut subject)
    })?)
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
    /// Steps of an episode, on both sides: the fewer, the more resets count
    #[arg(long, default_value_t = 50)]
    episode_steps: usize,
}

/// Measures.
pub fn bench(args: &BenchArgs, context: &Context) -> anyhow::Result<()> {
    let args = match &args.what {
        What::Envs(args) => args,
        What::Plan(args) => return plan(args, context),
        What::Train(args) => return train(args, context),
        What::Data(args) => return data(args, context),
        What::Render(args) => return render(args, context),
    };
    let entries: Vec<EnvChoice> = match &args.envs[..] {
        [] => ENVS.rows.iter().map(EnvChoice::from).collect(),
        ids => ids.iter().map(|id| swm::env(id)).collect::<swm_core::Result<_>>()?,
    };
    let report = bench_envs(
        &entries,
        &BenchConfig {
            envs: args.num_envs,
            sizes: args.sizes.clone(),
            bare: !args.pictures_only,
            episode_steps: args.episode_steps,
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
