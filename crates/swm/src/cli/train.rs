//! `swm train`: trains a model on a dataset or online in an environment, or runs a recipe.

use super::devices::DeviceArgs;
use super::pretrained::pretrained_weights;
use super::progress::{control, print_summary};
use super::recipes::lines;
use super::trackers::{Tracker, Trackers};
use super::train_folder::Record;
use super::{Context, emit, emit_json, eprint, output, run_record, train_folder};
use crate::home;
use clap::Args;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{EnvPool, Error, Origin, Result, files};
use swm_data::Reader;
use swm_models::{
    FAMILIES, FamilyEntry, OnlineRun, StoredCheckpoint, TrainOptions, TrainRun, TrainSummary, TrainableConfig, inverse,
};

/// Arguments of `swm train`.
#[derive(Args)]
pub struct TrainArgs {
    /// The model; `swm models` lists them
    #[arg(required_unless_present_any = ["recipe", "resume"])]
    pub(super) model: Option<String>,
    /// Run a recipe instead: collect, train, evaluate, report
    ///
    /// A name that `swm recipes` lists, or a TOML file. Finished steps are not repeated. Settings are STEP.OPTION=VALUE.
    #[arg(long, value_name = "RECIPE", requires = "output")]
    #[arg(conflicts_with_all = ["data", "preset", "env", "encoder", "device", "feature_cache", "resume", "print_config"])]
    pub(super) recipe: Option<String>,
    /// Allow a recipe from a file to choose any name
    #[arg(long, requires = "recipe")]
    pub(super) trust: bool,
    /// The dataset: a path or a name
    #[arg(long, value_name = "DATASET")]
    pub(super) data: Option<String>,
    /// Size and schedule: a preset or a TOML file (default: the first preset)
    #[arg(long)]
    pub(super) preset: Option<String>,
    /// Train online in this environment instead (tdmpc2, sac)
    #[arg(long, value_name = "ENV", conflicts_with = "data")]
    pub(super) env: Option<String>,
    /// Time limit of an episode, in steps, with --env
    #[arg(long, value_name = "STEPS", requires = "env")]
    max_steps: Option<usize>,
    /// The checkpoint to write: a path or a name (default: MODEL-DATASET)
    #[arg(short, long, value_name = "CHECKPOINT")]
    pub(super) output: Option<String>,
    /// Checkpoint with the frozen encoder: a path or a name (inverse only)
    #[arg(long, value_name = "CHECKPOINT")]
    encoder: Option<String>,
    #[command(flatten)]
    pub(super) device: DeviceArgs,
    /// Folder that keeps the features of fixed filters for later runs
    ///
    /// Encoders such as keypoints have a part that is not trained. Its features of a dataset are computed once, at the
    /// start; with this folder, the next run on the dataset finds them. Several runs may share it.
    #[arg(long, value_name = "FOLDER", conflicts_with = "env")]
    feature_cache: Option<PathBuf>,
    /// Continue an interrupted run; without MODEL, as it was started
    #[arg(long)]
    pub(super) resume: bool,
    /// Send metrics to trackers as well, such as wandb,trackio
    ///
    /// They run in the Python of $SWM_PYTHON, with their own settings.
    #[arg(long, value_enum, value_name = "TRACKER,…", value_delimiter = ',')]
    log: Vec<Tracker>,
    /// Print the complete config, with what each setting means, and exit
    #[arg(long)]
    pub(super) print_config: bool,
    /// Settings, such as optim.lr=3e-4 seed=1
    #[arg(value_name = "KEY=VALUE")]
    pub(super) settings: Vec<String>,
}

/// Runs `swm train` without a recipe.
pub fn train(args: &TrainArgs, context: &Context) -> anyhow::Result<()> {
    if args.model.is_none() {
        return train(&args.started()?, context);
    }
    if args.print_config {
        let config = args.config()?;
        if context.json {
            return emit_json(&config.to_json());
        }
        emit(&config.to_commented_toml()?);
        return Ok(());
    }
    let (checkpoint, summary) = run_args(args, context)?;
    if context.json {
        return emit_json(&summary);
    }
    emit(&format!("{}\n", checkpoint.display()));
    Ok(())
}

/// Trains the model of a command line; returns the checkpoint, and the summary of the run as JSON.
pub fn run_args(args: &TrainArgs, context: &Context) -> anyhow::Result<(PathBuf, Value)> {
    let config = args.config()?;
    args.check()?;
    let options = TrainOptions {
        resume: args.resume,
        device: args.device.open()?,
        threads: context.threads,
        cache: home::weights()?,
        feature_cache: args.feature_cache.clone(),
        ..TrainOptions::default()
    };
    if let Some(env) = &args.env {
        return train_online(args, env, &*config, options, context);
    }
    let encoder = args.encoder.as_deref().map(home::find_checkpoint).transpose()?;
    let (reader, out) = args.dataset_and_output()?;
    let setup = TrainRun { reader, encoder: encoder.as_deref(), out: &out, options };
    // A folder that holds another run is refused as such.
    if args.resume || StoredCheckpoint::read(&out).is_err() {
        config.check_data(&setup)?;
    }
    let record = Record::write(&out, args.resume)?;
    let withdraw = |error: &Error| record.iter().for_each(|record| record.withdraw(error));
    let trackers = Trackers::start(&args.log, &out, &config.to_json(), &context.interrupt).inspect_err(withdraw)?;
    let summary = run(&*config, setup, context);
    drop(trackers);
    let summary = summary.inspect_err(withdraw)?;
    Ok((summary.checkpoint.clone(), json!(summary)))
}

/// Trains online in an environment.
fn train_online(
    args: &TrainArgs,
    env: &str,
    config: &dyn TrainableConfig,
    options: TrainOptions,
    context: &Context,
) -> anyhow::Result<(PathBuf, Value)> {
    let choice = crate::env(env, &Origin::User)?;
    let threads = swm_core::pool::threads(context.threads)?;
    let environments = |count: usize| {
        let envs = (0..count).map(|_| choice.env()).collect::<Result<Vec<_>>>()?;
        EnvPool::new(envs, config.image_size().map(|side| (side, side)), args.max_steps, Arc::clone(&threads))
    };
    let name = args.output.clone().unwrap_or_else(|| {
        let env = env.rsplit('/').next().unwrap_or(env).split(',').next().unwrap_or(env);
        format!("{}-{env}", args.model())
    });
    let out = home::new_checkpoint(&name)?;
    let record = Record::write(&out, args.resume)?;
    let withdraw = |error: &Error| record.iter().for_each(|record| record.withdraw(error));
    let trackers = Trackers::start(&args.log, &out, &config.to_json(), &context.interrupt).inspect_err(withdraw)?;
    let setup = OnlineRun { environments: &environments, out: &out, options };
    let summary = config.train_online(setup, &mut control(context)).unwrap_or_else(|| {
        let problem = format!("{} trains on datasets only", args.model());
        Err(Error::config("--env", problem, "give a dataset with --data, or train tdmpc2 or sac"))
    });
    drop(trackers);
    let summary = summary.inspect_err(withdraw)?;
    let evaluated = summary.evaluated.map_or(String::new(), |mean| format!(", mean return {mean:.1}"));
    let best = summary.best.map_or(String::new(), |(step, mean)| format!(", best {mean:.1} after step {step}"));
    let message = format!(
        "{} gradient steps and {} environment steps in {:.0} s{evaluated}{best}, {}",
        summary.steps,
        summary.env_steps,
        summary.seconds,
        out.display()
    );
    print_summary("train", &message);
    if summary.interrupted {
        anyhow::bail!(Error::Interrupted);
    }
    Ok((summary.checkpoint.clone(), json!(summary)))
}

impl TrainArgs {
    /// Returns the arguments with which the run in the output folder was started, to continue it. Dataset, environment,
    /// encoder and device are those of this command line, if it names them.
    ///
    /// # Errors
    /// When there is no such run, this command line has options that the run cannot follow, or the record of the run names
    /// what only the user may name: a URI, or an environment that loads code.
    fn started(&self) -> Result<Self> {
        let fix = "name the model and the dataset as well: swm train MODEL --data DATASET --output RUN --resume";
        let Some(output) = &self.output else {
            return Err(Error::config("--resume", "neither a model nor a run is given", "name the run with --output"));
        };
        let folder = home::own_checkpoint(output)?;
        let path = folder.join(run_record::FILE);
        if !path.exists() {
            let problem = format!("is no run of `swm train`: it has no {}", run_record::FILE);
            return Err(Error::config(folder.display().to_string(), problem, fix));
        }
        let record = run_record::read(&folder)?;
        let started = record.first().and_then(|(cli, from)| Some((cli.into_train()?, from)));
        // A recipe writes to a folder of its own, in which it continues by itself.
        let is_training = |started: &Self| started.model.is_some() && started.recipe.is_none();
        let Some((started, from)) = started.filter(|(started, _)| is_training(started)) else {
            return Err(Error::corrupt(path, "it holds no command line of a training", fix));
        };
        self.check_options_of(&started, &folder)?;
        if started.encoder.is_some() {
            return Err(inverse::not_resumed());
        }
        let preset = match &started.preset {
            Some(preset) if is_preset_file(preset) => Some(path_of_record("--preset", preset, (&folder, from))?),
            preset => preset.clone(),
        };
        let mut started = Self { preset, ..started };
        // Printing the configuration opens nothing.
        if !self.print_config {
            self.check_names_of(&started, (&folder, from), &Origin::file(&path, false))?;
            if let (None, Some(data)) = (&self.data, &started.data) {
                started.data = Some(path_of_record("--data", data, (&folder, from))?);
            }
            eprint(&format!("continuing: {}\n", output::shorten(record.commands[0].command.join(" "))));
        }
        Ok(Self {
            data: self.data.clone().or(started.data),
            env: self.env.clone().or(started.env),
            max_steps: self.max_steps.or(started.max_steps),
            device: DeviceArgs { device: self.device.device.clone().or(started.device.device) },
            output: Some(output.clone()),
            resume: true,
            print_config: self.print_config,
            trust: false,
            // Only the user may ask for a tracker, which is a program, and name another folder that is written to.
            log: self.log.clone(),
            feature_cache: self.feature_cache.clone(),
            ..started
        })
    }

    /// Checks that a run that was started with other arguments can follow the options of this command line.
    ///
    /// # Errors
    /// When one of them has no effect on the run.
    fn check_options_of(&self, started: &Self, folder: &Path) -> Result<()> {
        let is_online = started.env.is_some();
        let trains = if is_online { "trains online in an environment" } else { "trains on a dataset" };
        let options = [
            ("--preset", self.preset.is_some(), "keeps its configuration"),
            ("--encoder", self.encoder.is_some(), "trains its own encoder"),
            ("--data", self.data.is_some() && is_online, trains),
            ("--feature-cache", self.feature_cache.is_some() && is_online, trains),
            ("--env", self.env.is_some() && !is_online, trains),
        ];
        let refused = options.into_iter().filter(|(_, given, _)| *given).map(|(option, _, reason)| (option, reason));
        let (refused, mut reasons): (Vec<&str>, Vec<&str>) = refused.unzip();
        if refused.is_empty() {
            return Ok(());
        }
        reasons.dedup();
        let problem = format!("the run {} {}", folder.display(), reasons.join(", and "));
        let fix =
            "leave this out, or name the model and all settings of the run: swm train MODEL --output RUN --resume …";
        Err(Error::config(refused.join(", "), problem, fix))
    }

    /// Checks the names in the recorded arguments of a run that this command line does not replace.
    ///
    /// # Errors
    /// When one is what only the user may name: a URI, an environment that loads code, or weights that may be downloaded.
    fn check_names_of(&self, started: &Self, (run, from): (&Path, &Path), origin: &Origin) -> Result<()> {
        if let (None, Some(env)) = (&self.env, &started.env) {
            crate::env(env, origin)?;
        }
        if let (None, Some(data)) = (&self.data, started.data.as_ref().filter(|data| data.contains("://"))) {
            origin.check_user(&format!("the dataset {data}"), "which opens a connection", Some("--data"))?;
        }
        if StoredCheckpoint::read(run).is_err() {
            started.check_weights(from, origin)?;
        }
        Ok(())
    }

    /// Checks the pretrained weights of a run that begins, whose arguments a file chose, in the folder `from`: what is no file would
    /// be looked for on the hub of models.
    ///
    /// # Errors
    /// When the configuration is invalid, or names weights that may be downloaded or are another file in the current folder.
    fn check_weights(&self, from: &Path, origin: &Origin) -> Result<()> {
        for (key, weights) in pretrained_weights(&self.config()?.to_json()) {
            let name = format!("the pretrained weights '{weights}'");
            let path = Path::new(&weights);
            if path.is_relative() && !is_current(from) && (path.is_file() || from.join(path).is_file()) {
                let fix = format!("continue the run there: cd {}", from.display());
                return Err(Error::config(name, "are a path in the folder in which the run was started", fix));
            }
            if !path.is_file() {
                origin.check_user(&name, "which may be downloaded", Some(&key))?;
            }
        }
        Ok(())
    }

    /// Checks the options against each other and the family. Reads no dataset.
    ///
    /// # Errors
    /// When one contradicts another.
    pub(super) fn check(&self) -> Result<()> {
        let family = self.family()?;
        if self.encoder.is_some() && family.borrows_encoder.is_none() {
            let problem = format!("{} trains its own encoder", family.id);
            return Err(Error::config("--encoder", problem, "remove the flag, or train inverse"));
        }
        // clap drops the requirement of --env when --data excludes it.
        if let (None, Some(_)) = (&self.env, self.max_steps) {
            let problem = "limits the episodes of an environment, and this training plays none";
            return Err(Error::config("--max-steps", problem, "remove it, or train online with --env"));
        }
        Ok(())
    }

    /// Returns the family of the model.
    fn family(&self) -> Result<&'static FamilyEntry> {
        FAMILIES.get(self.model())
    }

    /// Returns the id of the family as given; the command line requires one without a recipe.
    fn model(&self) -> &str {
        self.model.as_deref().unwrap_or_default()
    }

    /// Returns the configuration: the preset with the settings.
    ///
    /// # Errors
    /// When the family, the preset or a setting is unknown, or a value is invalid.
    pub fn config(&self) -> Result<Box<dyn TrainableConfig>> {
        self.config_with(&[])
    }

    /// Returns the configuration with more settings.
    ///
    /// # Errors
    /// As [`TrainArgs::config`].
    pub(super) fn config_with(&self, more: &[String]) -> Result<Box<dyn TrainableConfig>> {
        let (family, settings) = (self.family()?, [&self.settings[..], more].concat());
        self.preset.as_deref().map_or(Ok(()), check_preset_file)?;
        (family.config)(self.preset.as_deref().unwrap_or(family.presets[0].id), &settings)
    }

    /// Returns the dataset and the folder of the checkpoint.
    fn dataset_and_output(&self) -> Result<(Arc<dyn Reader>, PathBuf)> {
        let Some(data) = &self.data else {
            let fix =
                "name one (`swm datasets` lists them), or an environment with --env for a model that trains online";
            return Err(Error::config("--data", "no dataset is given", fix));
        };
        let name = self.output.clone().unwrap_or_else(|| {
            let stem = Path::new(data).file_stem().unwrap_or_default().to_string_lossy();
            format!("{}-{stem}", self.model())
        });
        Ok((home::open_dataset(data)?, home::new_checkpoint(&name)?))
    }
}

/// The largest file of a preset that is read.
const MAX_PRESET: u64 = 1 << 24;

/// Whether a preset is the path of a file, and not a name.
fn is_preset_file(preset: &str) -> bool {
    Path::new(preset).extension().is_some_and(|end| end == "toml")
}

/// Returns a path or the name of a dataset in the recorded arguments of a run that was started in the folder `from`, as this command
/// finds it in its own folder. URIs mean the same everywhere.
///
/// # Errors
/// When it is not there any more, this folder has one of the same path, which may be another, and the run has no checkpoint yet, which
/// would know it by its content.
fn path_of_record(option: &str, given: &str, (run, from): (&Path, &Path)) -> Result<String> {
    let (here, there) = (Path::new(given), from.join(given));
    if is_current(from) || !(there.exists() || here.exists()) {
        return Ok(given.to_owned());
    }
    if there.exists() {
        return Ok(there.to_string_lossy().into_owned());
    }
    if let Some(named) = home::named_dataset(given)?.filter(|_| option == "--data") {
        return Ok(named.to_string_lossy().into_owned());
    }
    if StoredCheckpoint::read(run).is_ok() {
        return Ok(given.to_owned());
    }
    let problem =
        format!("the run was started in {}, where it is not any more, and has no checkpoint yet", from.display());
    let fix = match option {
        "--data" => "put it back, or name the dataset: --data PATH",
        _ => "put it back, or name the model and all settings of the run: swm train MODEL --output RUN --resume …",
    };
    Err(Error::config(format!("{option} {given}"), problem, fix))
}

/// Whether this is the current folder.
fn is_current(folder: &Path) -> bool {
    std::env::current_dir().and_then(|current| Ok(current.canonicalize()? == folder.canonicalize()?)).unwrap_or(false)
}

/// Checks that a preset that is a file is TOML; the error names the file and the line.
fn check_preset_file(preset: &str) -> Result<()> {
    if !is_preset_file(preset) {
        return Ok(());
    }
    let text = String::from_utf8_lossy(&files::read(Path::new(preset), MAX_PRESET)?).into_owned();
    let parsed: std::result::Result<toml::Table, _> = toml::from_str(&text);
    parsed.map(drop).map_err(|error| {
        let problem = format!("{}{}", error.message(), lines::of_error(&text, &error));
        Error::config(format!("preset {preset}"), problem, "correct the file")
    })
}

/// Trains on a dataset, and shows progress.
pub fn run(config: &dyn TrainableConfig, setup: TrainRun<'_>, context: &Context) -> Result<TrainSummary> {
    let out = setup.out.to_owned();
    train_folder::check_links(&out)?;
    let summary = config.train(setup, &mut control(context))?;
    let early = if summary.stopped_early { ", stopped early" } else { "" };
    let best = summary.best.map_or(String::new(), |(step, loss)| format!(", best {loss:.4} after step {step}"));
    let message = format!(
        "{} steps in {:.0} s{early}{best} ({} parameters, {:.0} clips/s, {:.0} % of the time waiting for data), {}",
        summary.steps,
        summary.seconds,
        summary.parameters,
        summary.clips_per_second,
        100.0 * summary.data_wait,
        out.display()
    );
    print_summary("train", &message);
    if summary.interrupted {
        return Err(Error::Interrupted);
    }
    Ok(summary)
}
