//! Running a recipe: every step whose output is missing, then a comparison of the hashes.

use super::file::{Kind, Recipe, Step, parse};
use super::text;
use crate::capsule;
use crate::cli::collect::{self, CollectArgs};
use crate::cli::eval::{self, EvalArgs};
use crate::cli::train::{self, TrainArgs, log_of};
use crate::cli::{Context, emit, emit_json, eprint, output_folder};
use crate::home;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};
use swm_models::{StoredCheckpoint, checkpoint};
use swm_report::ReportOptions;

/// What `swm train --recipe` runs.
pub struct RecipeRun<'a> {
    /// The recipe: a name, or the path of a TOML file.
    pub recipe: &'a str,
    /// The folder of all outputs.
    pub output: &'a Path,
    /// Changes of options and settings.
    pub settings: Vec<&'a str>,
    /// Whether a recipe from a file may choose any name.
    pub trust: bool,
}

/// The file in the folder of a run that records the finished steps.
const STATE: &str = "recipe.json";

/// The record of a run.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    /// The name of the recipe.
    recipe: String,
    /// The hash of the recipe with its settings.
    request: String,
    /// The changes of options and settings.
    settings: Vec<String>,
    /// The processor.
    processor: String,
    /// The hash of the output of each finished step; empty for an evaluation.
    finished: BTreeMap<String, String>,
}

/// The comparison of a hash with the one in the recipe.
#[derive(Serialize)]
struct Compared<'a> {
    name: &'a str,
    hash: &'a str,
    /// The hash in the recipe; `None` if it has none, or if settings were changed.
    expected: Option<&'a str>,
}

/// Runs the steps of a recipe whose outputs are missing, and writes a page.
pub fn run(request: &RecipeRun<'_>, context: &Context) -> anyhow::Result<()> {
    let (text, origin) = text(request.recipe, request.trust)?;
    let mut recipe = Recipe::parse(request.recipe, &text)?;
    request.settings.iter().try_for_each(|setting| recipe.set(setting))?;
    recipe.check_origin(&origin)?;
    check(&recipe, request.output)?;
    let _lock = output_folder::claim(request.output, &["index.html"])?;
    let mut state = State::open(request, &recipe)?;
    let count = recipe.steps().count() + 1;
    for (index, (kind, step)) in recipe.steps().enumerate() {
        let output = kind.output(request.output, &step.name);
        if state.finished.contains_key(&step.name) && output.exists() {
            continue;
        }
        eprint(&format!("{}/{count} {}: {}\n", index + 1, kind.name(), step.name));
        let hash = run_step(&recipe, kind, step, request.output, context)?;
        state.finished.insert(step.name.clone(), hash);
        state.write(request.output)?;
    }
    let page = report(&recipe, request, context)?;
    let compared = state.compare(&recipe);
    let other = recipe.recorded_on.as_deref().filter(|processor| *processor != state.processor);
    if context.json {
        return emit_json(&json!({
            "folder": request.output, "report": page, "hashes": compared, "settings": state.settings,
            "processor": state.processor, "recorded_on": recipe.recorded_on,
        }));
    }
    for Compared { name, hash, expected } in &compared {
        let verdict = match (expected, &state.settings[..], other) {
            (Some(expected), ..) if expected == hash => "equal to the recorded hash".to_owned(),
            (Some(expected), _, Some(other)) => {
                format!("recorded as {expected} on {other}, this is {}", state.processor)
            }
            (Some(expected), ..) => format!("recorded as {expected}"),
            (None, [_, ..], _) => "not compared, because settings were changed".to_owned(),
            (None, ..) => "no hash is recorded".to_owned(),
        };
        emit(&format!("{name}: {hash} ({verdict})\n"));
    }
    emit(&format!("{}\n", page.map_or(request.output.to_owned(), |page| page).display()));
    Ok(())
}

/// Checks the options of every step before anything runs.
///
/// # Errors
/// When an option is unknown or invalid.
pub fn check(recipe: &Recipe, folder: &Path) -> Result<()> {
    for (kind, step) in recipe.steps() {
        let arguments = recipe.arguments(kind, step, folder);
        match kind {
            Kind::Collect => parse::<CollectArgs>(kind, step, &arguments).map(drop)?,
            Kind::Train => parse::<TrainArgs>(kind, step, &arguments)?.config().map(drop)?,
            Kind::Eval => parse::<EvalArgs>(kind, step, &arguments).map(drop)?,
        }
    }
    Ok(())
}

/// Runs a step and returns the hash of its output.
fn run_step(recipe: &Recipe, kind: Kind, step: &Step, folder: &Path, context: &Context) -> anyhow::Result<String> {
    let output = kind.output(folder, &step.name);
    let mut arguments = recipe.arguments(kind, step, folder);
    let is_begun = match kind {
        Kind::Collect => output.exists(),
        Kind::Train => checkpoint::family(&output).is_some(),
        Kind::Eval => false,
    };
    if is_begun {
        arguments.insert(0, "--resume".to_owned());
    }
    match kind {
        Kind::Collect => {
            collect::run_args(&parse(kind, step, &arguments)?, context)?;
            Ok(home::open_dataset(&output.to_string_lossy())?.content_hash()?)
        }
        Kind::Train => {
            train::run_args(&parse(kind, step, &arguments)?, context)?;
            let stored = StoredCheckpoint::read(&output)?;
            Ok(stored.manifest().hashes.get("weights").cloned().unwrap_or_default())
        }
        Kind::Eval => {
            let (results, _) = eval::run_args(&parse(kind, step, &arguments)?, context)?;
            if !context.json {
                emit(&crate::cli::results_tables::summary(&results));
            }
            Ok(String::new())
        }
    }
}

/// Writes the page of all evaluations; `None` without evaluations.
fn report(recipe: &Recipe, request: &RecipeRun<'_>, context: &Context) -> Result<Option<PathBuf>> {
    let files = recipe.eval.iter().map(|step| request.output.join(&step.name).join("results.json"));
    let results = files.map(|file| Ok((file.clone(), swm_report::read_results(&file)?))).collect::<Result<Vec<_>>>()?;
    if results.is_empty() {
        return Ok(None);
    }
    let settings: Vec<String> = request.settings.iter().map(|setting| format!(" {setting}")).collect();
    let options = ReportOptions {
        title: Some(recipe.summary.clone()),
        metrics: recipe.train.first().map(|step| log_of(&request.output.join(&step.name))),
        command: Some(format!("swm train --recipe {} -o DIR{}", request.recipe, settings.concat())),
    };
    if context.interrupt.load(std::sync::atomic::Ordering::SeqCst) {
        return Err(Error::Interrupted);
    }
    swm_report::write_report_with(&results, &options, request.output).map(Some)
}

impl State {
    /// Reads the record of the run in the folder, or begins a new one.
    ///
    /// # Errors
    /// When the folder holds a run of another recipe or with other settings.
    fn open(request: &RecipeRun<'_>, recipe: &Recipe) -> Result<Self> {
        let path = request.output.join(STATE);
        let new = Self {
            recipe: request.recipe.to_owned(),
            request: recipe.request_hash()?,
            settings: request.settings.iter().map(ToString::to_string).collect(),
            processor: capsule::cpu_level(),
            finished: BTreeMap::new(),
        };
        if !path.exists() {
            new.write(request.output)?;
            return Ok(new);
        }
        let fix = "choose another folder with --output";
        let bytes = files::read(&path, super::MAX_BYTES)?;
        let found: Self =
            serde_json::from_slice(&bytes).map_err(|error| Error::corrupt(&path, error.to_string(), fix))?;
        if found.request != new.request {
            let problem = format!("it holds a run of the recipe {} with other settings or steps", found.recipe);
            return Err(Error::config(request.output.display().to_string(), problem, fix));
        }
        Ok(Self { finished: found.finished, ..new })
    }

    fn write(&self, folder: &Path) -> Result<()> {
        eval::write_json(&folder.join(STATE), self)
    }

    /// Returns the hashes of datasets and weights, with the recorded ones.
    fn compare<'a>(&'a self, recipe: &'a Recipe) -> Vec<Compared<'a>> {
        let made = recipe.steps().filter(|(kind, _)| *kind != Kind::Eval);
        let compared = made.filter_map(|(_, step)| {
            let hash = self.finished.get(&step.name)?;
            let expected = step.hash.as_deref().filter(|_| self.settings.is_empty());
            Some(Compared { name: &step.name, hash, expected })
        });
        compared.collect()
    }
}
