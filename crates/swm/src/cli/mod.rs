//! The command line: one module per command, each a thin layer over the crates.

mod assets;
mod autopsy;
mod bench;
mod capsules;
mod checkpoints;
mod collect;
mod config;
mod convert;
mod datasets;
mod demo;
mod devices;
mod doctor;
mod envs;
mod eval;
mod eval_policy;
mod eval_until;
mod export;
mod frame;
mod inspect;
mod lab;
mod leaderboard;
mod models;
mod on_ray;
mod output;
mod output_folder;
mod planner;
mod plot;
mod pretrained;
mod probe;
mod progress;
mod pull;
mod recipes;
mod report;
mod reproduce;
mod results_tables;
mod run_record;
mod shell;
mod signals;
mod solvers;
pub mod study;
mod tagged;
mod trackers;
mod train;
mod train_folder;
mod training_curves;
mod usage;
mod wrappers;
mod zoo;

use clap::{FromArgMatches as _, Parser, Subcommand};
pub use lab::Pages;
use output::{as_texts, emit, emit_json, eprint, table};
pub use recipes::check_text as check_recipe;
pub use run_record::{check_training, record_training};
use std::backtrace::{Backtrace, BacktraceStatus};
use std::error::Error as _;
use std::ffi::OsString;
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use swm_core::{Error, Result, limits};

/// Collect data from environments, train world models, plan, evaluate, report
#[derive(Parser)]
#[command(name = "swm", version, propagate_version = true)]
#[command(after_help = "Example: swm demo --output demo")]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Print one JSON document on standard output instead of tables
    #[arg(long, global = true)]
    json: bool,
    /// Worker threads (default: one per core)
    ///
    /// Results do not depend on their number.
    #[arg(long, global = true, default_value_t = 0, hide_default_value = true, value_name = "N")]
    threads: usize,
    /// Renderer of 3-D environments: egl, cpu or auto
    ///
    /// egl is OpenGL on a graphics card, cpu the built-in software renderer; auto chooses egl where a graphics card is
    /// available.
    #[arg(long, global = true, default_value = "auto", hide_default_value = true, value_name = "NAME")]
    renderer: swm_mujoco::render::Choice,
}

#[derive(Subcommand)]
enum Command {
    /// List the environments, or show one
    #[command(after_help = "Example: swm envs swm/PushT-v1")]
    Envs(envs::EnvsArgs),
    /// List an environment's factors of variation
    #[command(after_help = "Example: swm fovs swm/TwoRoom-v1")]
    Fovs(envs::FovsArgs),
    /// Write the first frame of an episode as PNG
    #[command(after_help = "Example: swm frame swm/PushT-v1 --seed 3 --pin block.shape=1 --output frame.png")]
    Frame(frame::FrameArgs),
    /// List, install and verify assets that environments require
    ///
    /// Assets are MuJoCo with its models, Gymnasium, the Atari games and Craftax.
    #[command(after_help = "Example: swm assets install mujoco")]
    Assets(assets::AssetsArgs),
    /// List the visual wrappers and their settings
    #[command(after_help = "Example: swm wrappers")]
    Wrappers,
    /// List the solvers, and what they require of a model
    #[command(after_help = "Example: swm solvers --json")]
    Solvers,
    /// Run a policy and store its episodes
    #[command(after_help = "Example: swm collect swm/TwoRoom-v1 --output rooms --episodes 300")]
    Collect(Box<on_ray::collect::CollectCommand>),
    /// List the datasets, or commit the shards of one
    #[command(after_help = "Example: swm datasets")]
    Datasets(datasets::DatasetsArgs),
    /// List the dataset formats
    #[command(after_help = "Example: swm formats")]
    Formats,
    /// Show the contents of a dataset
    #[command(after_help = "Example: swm inspect rooms --checksum")]
    Inspect(inspect::InspectArgs),
    /// Write videos and a contact sheet of some episodes
    #[command(after_help = "Example: swm preview rooms --output preview --episodes 4")]
    Preview(datasets::PreviewArgs),
    /// Write a dataset in another format, and verify the result
    #[command(after_help = "Example: swm convert rooms rooms-jpeg --codec jpeg")]
    Convert(on_ray::convert::ConvertCommand),
    /// Write episodes for the viewer of Rerun
    ///
    /// Frames, depth, segmentation, and every other column over the steps; a table of the factors of each episode. The Python
    /// package rerun-sdk writes the file, in the Python of $SWM_PYTHON or python3.
    #[command(after_help = "Example: swm export rooms --episodes 8 --output episodes.rrd")]
    Export(export::ExportArgs),
    /// Find defects of a dataset, and the models it can train
    #[command(after_help = "Example: swm doctor rooms --repair rooms-repaired")]
    Doctor(doctor::DoctorArgs),
    /// List the models and their presets
    #[command(after_help = "Example: swm models")]
    Models,
    /// List the devices that models can compute on
    #[command(after_help = "Example: swm devices")]
    Devices,
    /// Train a model on a dataset or in an environment
    #[command(after_help = "Example: swm train lewm --data rooms --output lewm-rooms optim.lr=3e-4")]
    Train(on_ray::train::TrainCommand),
    /// Draw training curves in the terminal, and as SVG
    #[command(after_help = "Example: swm plot lewm-rooms pldm-rooms --metric loss --output curves.svg")]
    Plot(plot::PlotArgs),
    /// List the recipes of `swm train --recipe`, or print one
    #[command(after_help = "Example: swm recipes two-room/pldm")]
    Recipes(recipes::RecipesArgs),
    /// List the capsules that `zoo:NAME` finds
    #[command(after_help = "Example: swm zoo")]
    Zoo,
    /// Download a dataset, a checkpoint or weights from the hub
    ///
    /// The hub is Hugging Face's, or the one at the address in HF_ENDPOINT.
    #[command(after_help = "Example: swm pull hf://datasets/lerobot/pusht")]
    Pull(pull::PullArgs),
    /// Upload a dataset or a checkpoint to the hub
    #[command(after_help = "Example: swm push rooms hf://datasets/OWNER/NAME --private")]
    Push(pull::PushArgs),
    /// List the checkpoints; show, verify, pack or remove one
    #[command(after_help = "Example: swm checkpoints show lewm-rooms")]
    Checkpoints(checkpoints::CheckpointsArgs),
    /// Predict columns or images from a checkpoint's latents
    #[command(after_help = "Example: swm probe lewm-rooms --data rooms --columns state")]
    Probe(probe::ProbeArgs),
    /// Evaluate checkpoints, experts and the random-policy floor
    #[command(after_help = "Example: swm eval lewm-rooms expert --episodes 100 --output results")]
    Eval(Box<on_ray::eval::EvalCommand>),
    /// Repeat an evaluation from its results and list the differences
    #[command(after_help = "Example: swm reproduce results")]
    Reproduce(reproduce::ReproduceArgs),
    /// Submit to a leaderboard, verify an entry, or build its pages
    #[command(after_help = "Example: swm leaderboard build leaderboard --output site")]
    Leaderboard(leaderboard::LeaderboardArgs),
    /// Run a study: many evaluations with one table
    #[command(after_help = "Example: swm study list")]
    Study(study::StudyArgs),
    /// Find out why a planning world model fails
    ///
    /// Plays the same starts with parts of the planning replaced: S ten times as many candidates, R a new plan after every
    /// model step, D the true dynamics, C the distance of states that a probe reads from latents, E the true distance to the
    /// goal. docs/autopsy.md explains what the answer means.
    #[command(after_help = "Example: swm autopsy zoo:two-room/lewm --env swm/TwoRoom-v1 --output autopsy budget=100")]
    Autopsy(autopsy::AutopsyArgs),
    /// Write one self-contained HTML page of results
    #[command(after_help = "Example: swm report results --output report --training lewm-rooms")]
    Report(report::ReportArgs),
    /// Measure speed, compared with the reference if installed
    #[command(after_help = "Example: swm bench envs swm/PushT-v1")]
    Bench(bench::BenchArgs),
    /// Print the completions of a shell
    #[command(after_help = "Example: swm completions bash")]
    Completions(shell::CompletionsArgs),
    /// Write a manual page for each command
    #[command(after_help = "Example: swm man --output man1")]
    Man(shell::ManArgs),
    /// Show environments, datasets and runs in the browser
    ///
    /// Starts a server for this machine only, prints its URL, and opens the browser. Ctrl-C ends it.
    #[command(after_help = "Example: swm lab --no-open --port 8080")]
    Lab(lab::LabArgs),
    /// Collect, train, plan, evaluate and report within minutes
    #[command(after_help = "Example: swm demo --output demo")]
    Demo(demo::DemoArgs),
}

impl Cli {
    /// The arguments of `swm train`; `None` for another command.
    pub(crate) fn into_train(self) -> Option<train::TrainArgs> {
        if let Command::Train(command) = self.command { Some(command.args) } else { None }
    }
}

/// The global options and the interrupt flag, for long-running commands.
#[derive(Clone)]
pub struct Context {
    /// Whether to print JSON.
    pub json: bool,
    /// The thread budget of environments, decoders and matrix products; 0 for one thread per core.
    pub threads: usize,
    /// Set by the first Ctrl-C; runs stop at the next safe point.
    pub interrupt: Arc<AtomicBool>,
}

/// Runs the command line with these arguments, the program's name first. Returns the exit code: 0 for success, 1 for a
/// failure or lost output, 2 for wrong usage, 130 for an interrupted run.
pub fn run(arguments: impl IntoIterator<Item = impl Into<OsString> + Clone>) -> u8 {
    signals::report_large_files();
    let arguments: Vec<OsString> = arguments.into_iter().map(Into::into).collect();
    run_record::remember(&arguments);
    let code = match parse(arguments) {
        Ok(_) if std::time::SystemTime::now() < std::time::UNIX_EPOCH => {
            // Libraries below take such a time for damage, or panic.
            eprint("error: the clock of this machine is before 1970; set it\n");
            1
        }
        Ok(cli) => cli.run(),
        Err(error) => print_usage(&error),
    };
    match output::take_failure() {
        None => code,
        Some(failure) => {
            eprint(&format!("error: standard output: writing: {failure}; the output is lost\n"));
            code.max(1)
        }
    }
}

/// Parses a command line, the program's name first.
fn parse(arguments: Vec<OsString>) -> clap::error::Result<Cli> {
    let mut command = shell::command();
    let mut matches = command.try_get_matches_from_mut(arguments)?;
    Cli::from_arg_matches_mut(&mut matches).map_err(|error| error.format(&mut command))
}

/// Prints help, a version, or an error in the arguments.
fn print_usage(error: &clap::Error) -> u8 {
    use std::io::Write as _;
    if error.use_stderr() {
        let text = usage::plain(error);
        // Arguments with control characters, such as names of files, are printed without clap's colours.
        let is_safe = matches!(swm_core::text::printable(&text), std::borrow::Cow::Borrowed(_));
        if is_safe { output::print_styled(&usage::coloured(error)) } else { eprint(&text) }
    } else {
        let printed = error.print();
        output::check(printed.and_then(|()| std::io::stdout().flush()));
    }
    u8::try_from(error.exit_code()).unwrap_or(2)
}

/// The least stack of a thread in bytes: that of threads which Rust starts without the variable.
const LEAST_STACK: usize = 2 << 20;

/// Checks the variable that sets the stack of threads: one that overflows its stack aborts the program.
///
/// # Errors
/// When it is less than [`LEAST_STACK`].
fn check_stack(given: Option<&str>) -> Result<()> {
    match given.and_then(|text| text.parse::<usize>().ok()) {
        Some(bytes) if bytes < LEAST_STACK => {
            let problem = format!("threads need a stack of at least {LEAST_STACK} bytes");
            Err(Error::config(format!("RUST_MIN_STACK={bytes}"), problem, "remove the variable, or set it higher"))
        }
        _ => Ok(()),
    }
}

impl Cli {
    /// Runs the command and returns its exit code.
    fn run(self) -> u8 {
        // If an embedding program has already set up logging, `try_init` fails and that setup stays in place.
        let _ = tracing_subscriber::fmt()
            .with_writer(std::io::stderr)
            .with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr()))
            .with_env_filter(
                tracing_subscriber::EnvFilter::try_from_env("SWM_LOG")
                    .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn")),
            )
            .without_time()
            .try_init();
        std::panic::set_hook(Box::new(print_panic));
        // A panic of the main thread, or of a thread that it joins, ends the run as an error does.
        let outcome = catch_unwind(AssertUnwindSafe(|| self.dispatch()));
        match outcome.unwrap_or_else(|panic| Err(Error::panicked("the command panicked", &*panic).into())) {
            Ok(()) => 0,
            Err(error) => {
                // An error of this engine is one complete line; other errors are printed with their causes.
                let own = error.downcast_ref::<Error>();
                output::print_error(&own.map_or_else(|| format!("{error:#}"), ToString::to_string));
                match own {
                    Some(Error::Interrupted) => 130,
                    Some(error) if error.is_usage() => 2,
                    _ => 1,
                }
            }
        }
    }

    fn dispatch(self) -> anyhow::Result<()> {
        let json = self.json;
        limits::THREADS.check(self.threads)?;
        // Rayon starts as many threads as this variable says where `--threads` does not: some commands do not pass that on.
        let of_rayon = std::env::var("RAYON_NUM_THREADS").ok().and_then(|text| text.parse().ok());
        limits::RAYON_THREADS.check(of_rayon.unwrap_or(0))?;
        check_stack(std::env::var("RUST_MIN_STACK").ok().as_deref())?;
        swm_mujoco::render::choose(self.renderer);
        match self.command {
            Command::Envs(args) => envs::envs(&args, json),
            Command::Fovs(args) => envs::fovs(&args, json),
            Command::Frame(args) => frame::frame(&args, json),
            Command::Assets(args) => assets::assets(&args, json),
            Command::Wrappers => wrappers::wrappers(json),
            Command::Solvers => solvers::solvers(json),
            Command::Devices => devices::devices(json),
            Command::Datasets(args) => datasets::datasets(&args, json),
            Command::Formats => datasets::formats(json),
            Command::Inspect(args) => on_threads(self.threads, || inspect::inspect(&args, json)),
            Command::Preview(args) => on_threads(self.threads, || datasets::preview(&args, json)),
            Command::Models => models::models(json),
            Command::Plot(args) => plot::plot(&args, json),
            Command::Completions(args) => shell::completions(&args),
            Command::Man(args) => shell::man(&args, json),
            Command::Recipes(args) => recipes::recipes(&args, json),
            Command::Zoo => zoo::zoo(json),
            Command::Checkpoints(args) => checkpoints::checkpoints(&args, &Context::new(json, self.threads)?),
            Command::Report(args) => report::report(&args, json),
            Command::Convert(args) => on_ray::convert::run(&args, &Context::new(json, self.threads)?),
            Command::Export(args) => export::export(&args, &Context::new(json, self.threads)?),
            Command::Doctor(args) => doctor::doctor(&args, &Context::new(json, self.threads)?),
            Command::Collect(args) => on_ray::collect::run(&args, &Context::new(json, self.threads)?),
            Command::Train(args) => on_ray::train::run(&args, &Context::new(json, self.threads)?),
            Command::Pull(args) => pull::pull(&args, &Context::new(json, self.threads)?),
            Command::Push(args) => pull::push(&args, &Context::new(json, self.threads)?),
            Command::Probe(args) => probe::probe(&args, &Context::new(json, self.threads)?),
            Command::Eval(args) => on_ray::eval::run(&args, &Context::new(json, self.threads)?),
            Command::Leaderboard(args) => leaderboard::leaderboard(&args, &Context::new(json, self.threads)?),
            Command::Study(args) => study::study(&args, json, || Context::new(json, self.threads)),
            Command::Autopsy(args) => autopsy::autopsy(&args, &Context::new(json, self.threads)?),
            Command::Reproduce(args) => reproduce::reproduce(&args, &Context::new(json, self.threads)?),
            Command::Bench(args) => bench::bench(&args, &Context::new(json, self.threads)?),
            Command::Lab(args) => lab::lab(&args, &Context::new(json, self.threads)?),
            Command::Demo(args) => demo::demo(&args, &Context::new(json, self.threads)?),
        }
    }
}

impl Context {
    /// Starts the threads of matrix products, and handles signals.
    fn new(json: bool, threads: usize) -> Result<Self> {
        // Burn's matrix products run in rayon's global pool, so the pool gets the same number of threads. An embedding
        // program may have started the pool already, which is not an error.
        let started = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
        if let Err(error) = started
            && error.source().is_some()
        {
            return Err(Error::external("starting worker threads", error));
        }
        let interrupt = signals::interrupt_flag().map_err(|error| Error::external("handling Ctrl-C", error))?;
        let context = Self { json, threads, interrupt };
        let of_downloads = context.clone();
        crate::home::show_downloads(move || progress::control(&of_downloads));
        Ok(context)
    }
}

/// Runs a command that decodes or hashes on `threads` threads, or on one where the system cannot start as many: rayon's global pool
/// would panic at its first use.
///
/// # Errors
/// Those of the command, and when not even one thread can be started.
fn on_threads(threads: usize, command: impl FnOnce() -> anyhow::Result<()> + Send) -> anyhow::Result<()> {
    // Before the others, because the threads of a pool that could not be started end later.
    let one = swm_core::pool::threads(1)?;
    swm_core::pool::threads(threads).unwrap_or(one).install(command)
}

/// Prints a panic as one line, and its backtrace only if `RUST_BACKTRACE` asks for one. It holds no lock while it
/// captures the backtrace, and the program ends if there is no memory for it.
fn print_panic(panic: &PanicHookInfo<'_>) {
    let (thread, message) = (std::thread::current(), panic.payload_as_str().unwrap_or("no message"));
    let place = panic.location().map_or(String::new(), |location| format!(" ({location})"));
    eprint(&format!("internal error in the thread '{}': {message}{place}\n", thread.name().unwrap_or("?")));
    let backtrace = Backtrace::capture();
    if backtrace.status() == BacktraceStatus::Captured {
        eprint(&format!("{backtrace}\n"));
    }
}

#[cfg(test)]
mod tests {
    use super::Cli;
    use clap::{Command, CommandFactory as _};

    /// The width, in columns, that the first line of a help text must not reach.
    const MAX_COLUMNS: usize = 80;

    fn check(command: &Command, path: &str) {
        let about = command.get_about().expect(path).to_string();
        assert!(about.len() < MAX_COLUMNS, "{path}: {about}");
        let example = command.get_after_help().unwrap_or_else(|| panic!("{path} has no example")).to_string();
        assert!(example.starts_with("Example: swm"), "{path}: {example}");
        for argument in command.get_arguments() {
            let help = argument.get_help().map(ToString::to_string).unwrap_or_default();
            assert!(help.len() < MAX_COLUMNS, "{path} {}: {help}", argument.get_id());
        }
        for subcommand in command.get_subcommands() {
            check(subcommand, &format!("{path} {}", subcommand.get_name()));
        }
    }

    #[test]
    fn help_of_every_command_is_short_and_has_an_example() {
        check(&Cli::command(), "swm");
    }

    #[test]
    fn example_of_every_command_parses() {
        fn parse(command: &Command) {
            let example = command.get_after_help().expect("an example").to_string();
            let words = example.trim_start_matches("Example: ").split(' ');
            Cli::command().try_get_matches_from(words).unwrap_or_else(|error| panic!("{example}: {error}"));
            command.get_subcommands().for_each(parse);
        }
        parse(&Cli::command());
    }
}
