//! The command line: one file a group of commands, each a thin front of the crates.

mod assets;
mod bench;
mod checkpoints;
mod collect;
mod config;
mod convert;
mod datasets;
mod demo;
mod doctor;
mod envs;
mod eval;
mod inspect;
mod models;
mod planner;
mod probe;
mod progress;
mod pull;
mod report;
mod solvers;
mod train;
mod wrappers;

use clap::{Parser, Subcommand};
use progress::Progress;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Collect data from worlds, train world models, plan with them, evaluate and report.
#[derive(Parser)]
#[command(name = "swm", version, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Print one JSON document on standard output instead of tables
    #[arg(long, global = true)]
    json: bool,
    /// Worker threads (default: one for each core); results do not depend on it
    #[arg(long, global = true, default_value_t = 0, hide_default_value = true, value_name = "N")]
    threads: usize,
    /// What draws worlds of three dimensions: egl (OpenGL), cpu (our own), or auto, which is egl where a graphics card is
    #[arg(long, global = true, default_value = "auto", hide_default_value = true, value_name = "NAME")]
    renderer: swm_mujoco::render::Choice,
}

#[derive(Subcommand)]
enum Command {
    /// List the environments, or show one
    Envs(envs::EnvsArgs),
    /// List an environment's factors of variation
    Fovs(envs::FovsArgs),
    /// List, install and verify what worlds need of others: MuJoCo and its models, Gymnasium, the Atari games, Craftax
    Assets(assets::AssetsArgs),
    /// List the visual wrappers and their settings
    Wrappers,
    /// List the solvers, what they plan and what they ask of a model
    Solvers,
    /// Run a policy and store its episodes
    Collect(collect::CollectArgs),
    /// List the datasets at home, or make one of the parts that several machines wrote
    Datasets(datasets::DatasetsArgs),
    /// List the dataset formats
    Formats,
    /// Say what is in a dataset
    Inspect(inspect::InspectArgs),
    /// Make a video and a contact sheet of some episodes of a dataset
    Preview(datasets::PreviewArgs),
    /// Write a dataset in another format or codec, and compare what comes out
    Convert(convert::ConvertArgs),
    /// Say what is wrong with a dataset and which models it can train; write a new one of what is sound
    Doctor(doctor::DoctorArgs),
    /// List the models and their presets
    Models,
    /// Train a model on a dataset
    Train(train::TrainArgs),
    /// Fetch weights of others from the Hugging Face hub, to begin a training with
    Pull(pull::PullArgs),
    /// List the checkpoints at home; show, verify, import, export or remove one
    Checkpoints(checkpoints::CheckpointsArgs),
    /// Read columns, or the pictures themselves, from a checkpoint's latents
    Probe(probe::ProbeArgs),
    /// Evaluate a checkpoint, the expert or the random floor
    Eval(Box<eval::EvalArgs>),
    /// Run an evaluation again from its results and say what differs
    Reproduce(eval::ReproduceArgs),
    /// Make one self-contained HTML page of results
    Report(report::ReportArgs),
    /// Measure speed, beside the reference where it is installed
    Bench(bench::BenchArgs),
    /// Collect, train, plan, evaluate and report, in minutes
    Demo(demo::DemoArgs),
}

/// What commands that work for a while may use.
pub struct Context {
    /// Whether to print JSON.
    pub json: bool,
    /// The budget of cores, shared by environments, decoders and matrix products; 0 means all of them.
    pub threads: usize,
    /// Set by the first Ctrl-C; long loops stop at the next safe point.
    pub stop: Arc<AtomicBool>,
}

impl Cli {
    /// Runs the command; the exit code is 0 when done, 1 when it failed, 2 for wrong usage, 130 when
    /// interrupted.
    pub fn run(self) -> u8 {
        // A program that embeds this one may be logging already.
        let _ = tracing_subscriber::fmt()
            .with_writer(std::io::stderr)
            .with_env_filter(
                tracing_subscriber::EnvFilter::try_from_env("SWM_LOG")
                    .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn")),
            )
            .without_time()
            .try_init();
        match self.dispatch() {
            Ok(()) => 0,
            Err(error) => {
                // Our own errors say everything in one line; others are told with their causes.
                let ours = error.downcast_ref::<swm_core::Error>();
                complain(&ours.map_or_else(|| format!("error: {error:#}\n"), |ours| format!("error: {ours}\n")));
                match ours {
                    Some(swm_core::Error::Interrupted) => 130,
                    Some(error) if error.is_usage() => 2,
                    _ => 1,
                }
            }
        }
    }

    fn dispatch(self) -> anyhow::Result<()> {
        let json = self.json;
        swm_mujoco::render::choose(self.renderer);
        match self.command {
            Command::Envs(args) => envs::envs(&args, json),
            Command::Fovs(args) => envs::fovs(&args, json),
            Command::Assets(args) => assets::assets(&args, json),
            Command::Wrappers => wrappers::wrappers(json),
            Command::Solvers => solvers::solvers(json),
            Command::Datasets(args) => datasets::datasets(&args, json),
            Command::Formats => datasets::formats(json),
            Command::Inspect(args) => inspect::inspect(&args, json),
            Command::Preview(args) => datasets::preview(&args, json),
            Command::Models => models::models(json),
            Command::Checkpoints(args) => checkpoints::checkpoints(&args, json),
            Command::Report(args) => report::report(&args, json),
            Command::Convert(args) => convert::convert(&args, &Context::new(json, self.threads)),
            Command::Doctor(args) => doctor::doctor(&args, &Context::new(json, self.threads)),
            Command::Collect(args) => collect::collect(&args, &Context::new(json, self.threads)),
            Command::Train(args) => train::train(&args, &Context::new(json, self.threads)),
            Command::Pull(args) => pull::pull(&args, json),
            Command::Probe(args) => probe::probe(&args, &Context::new(json, self.threads)),
            Command::Eval(args) => eval::eval(&args, &Context::new(json, self.threads)),
            Command::Reproduce(args) => eval::reproduce(&args, &Context::new(json, self.threads)),
            Command::Bench(args) => bench::bench(&args, &Context::new(json, self.threads)),
            Command::Demo(args) => demo::demo(&args, &Context::new(json, self.threads)),
        }
    }
}

impl Context {
    fn new(json: bool, threads: usize) -> Self {
        // Burn's matrix products use rayon's global pool: it is given the same number of threads.
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().ok();
        let stop = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&stop);
        ctrlc::set_handler(move || {
            if flag.swap(true, Ordering::SeqCst) {
                std::process::exit(130);
            }
            complain("\nstopping at the next safe point; press Ctrl-C again to stop at once\n");
        })
        .ok();
        Self { json, threads, stop }
    }
}

/// Prints to standard output; a reader that went away is no error.
pub fn emit(text: &str) {
    use std::io::Write as _;
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).ok();
}

/// Prints one JSON document.
pub fn emit_json(value: &impl serde::Serialize) -> anyhow::Result<()> {
    emit(&(serde_json::to_string_pretty(value)? + "\n"));
    Ok(())
}

/// Prints to standard error.
pub fn complain(text: &str) {
    use std::io::Write as _;
    std::io::stderr().write_all(text.as_bytes()).ok();
}

/// A table in the house style.
pub fn table(header: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut table = comfy_table::Table::new();
    table.load_preset(comfy_table::presets::NOTHING);
    table.set_style(comfy_table::TableComponent::HeaderLines, '─');
    table.set_style(comfy_table::TableComponent::MiddleHeaderIntersections, '─');
    table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic);
    table.set_header(header.to_vec());
    for row in rows {
        table.add_row(row);
    }
    format!("{table}\n")
}
