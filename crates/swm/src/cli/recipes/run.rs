//! Running a recipe: every step whose output is missing, then a comparison of the hashes.

use super::datasets::{self, Found};
use super::file::{self, Kind, Recipe, Step, parse};
use super::{outside, references, text};
use crate::capsule;
use crate::cli::collect::{self, CollectArgs};
use crate::cli::eval::{self, EvalArgs};
use crate::cli::output_folder::{self, RESULTS};
use crate::cli::pretrained::pretrained_weights;
use crate::cli::train::{self, TrainArgs};
use crate::cli::training_curves::of_checkpoint;
use crate::cli::{Context, emit, emit_json, eprint};
use crate::home;
use crate::resolver::HomeResolver;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::{Error, Origin, Result, Schema, files, manifest};
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
    /// The hash of the output of each finished step; older runs have none of an evaluation.
    finished: BTreeMap<String, String>,
    /// For each finished step, the hash of those of the datasets and weights before it; older runs have none.
    #[serde(default)]
    inputs: BTreeMap<String, String>,
    /// For each finished step, the hashes of what it read from outside the recipe; older runs have none.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    outside: BTreeMap<String, outside::Hashes>,
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
    check_folder(request.output)?;
    let (text, origin) = text(request.recipe, request.trust)?;
    let mut recipe = Recipe::parse(request.recipe, &text)?;
    request.settings.iter().try_for_each(|setting| recipe.set(setting))?;
    recipe.check_origin(&origin)?;
    let columns = check(&recipe, request.output)?;
    check_weights(&recipe, request, &origin)?;
    check_columns(&recipe, request.output, &columns)?;
    check_devices(&recipe, request.output, &State::read(request, &recipe)?)?;
    let _lock = output_folder::claim(request.output, &["index.html"])?;
    files::delete_temporary(request.output, |name| name == STATE)?;
    // The folder may come from a stranger, whose links name folders of the user.
    recipe.steps().try_for_each(|(kind, step)| files::check_no_link(&kind.output(request.output, &step.name)))?;
    let mut state = State::open(request, &recipe)?;
    let count = recipe.steps().count() + 1;
    for (index, (kind, step)) in recipe.steps().enumerate() {
        if state.is_finished(&recipe, (kind, step), request.output)? {
            continue;
        }
        eprint(&format!("{}/{count} {}: {}\n", index + 1, kind.name(), step.name));
        let read = outside::of(&recipe, (kind, step), request.output);
        let hash = run_step(&recipe, kind, step, request.output, context)?;
        state.outside.extend((!read.is_empty()).then(|| (step.name.clone(), read)));
        state.inputs.insert(step.name.clone(), state.inputs_of(&recipe, step)?);
        state.finished.insert(step.name.clone(), hash);
        state.write(request.output)?;
    }
    let page = report(&recipe, request, context)?;
    let compared = state.compare(&recipe);
    let alike = |recorded: &&str| capsule::computes_alike(recorded, &state.processor);
    let other = recipe.recorded_on.as_deref().filter(|recorded| !alike(recorded));
    let same_processor = recipe.recorded_on.as_deref().is_some_and(|recorded| alike(&recorded));
    let differs = |compared: &&Compared<'_>| compared.expected.is_some_and(|expected| expected != compared.hash);
    if let Some(Compared { name, .. }) = compared.iter().find(differs).filter(|_| same_processor) {
        eprint(&format!("warning: '{name}' differs from what the recipe recorded on such a processor\n"));
    }
    if context.json {
        return emit_json(&json!({
            "folder": request.output.to_string_lossy(), "report": page.as_ref().map(|page| page.to_string_lossy()),
            "hashes": compared, "settings": state.settings,
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
    emit(&format!("{}\n", page.unwrap_or_else(|| request.output.to_owned()).display()));
    Ok(())
}

/// Checks that the outputs of a recipe can be written to a folder: Lance reads no path with control characters.
///
/// # Errors
/// When it is the address of a server, or its path has a control character.
fn check_folder(folder: &Path) -> Result<()> {
    if folder.to_string_lossy().contains("://") {
        let fix = "give a local folder; `swm convert` copies a dataset to a server";
        return Err(Error::config(folder.display().to_string(), "is the address of a server", fix));
    }
    let path = std::path::absolute(folder).map_err(|error| Error::io(folder, "finding the folder", error))?;
    if path.to_string_lossy().contains(char::is_control) {
        let fix = "give a folder without such characters in its path";
        return Err(Error::config(format!("{path:?}"), "has a line feed or another control character", fix));
    }
    Ok(())
}

/// The columns of the datasets that a recipe collects, by the paths of the datasets.
pub(super) type Columns = BTreeMap<PathBuf, Schema>;

/// Checks the options of every step before anything runs, as far as they do not depend on outputs of earlier steps. Returns
/// the columns of the datasets to collect.
///
/// # Errors
/// When an option is unknown or invalid, or contradicts another.
pub(super) fn check(recipe: &Recipe, folder: &Path) -> Result<Columns> {
    let mut columns = Columns::new();
    let outputs: Vec<PathBuf> = recipe.steps().map(|(kind, step)| kind.output(folder, &step.name)).collect();
    let resolver = HomeResolver::new(Origin::User);
    for (kind, step) in recipe.steps() {
        let arguments = recipe.arguments(kind, step, folder);
        references::check(recipe, kind, step)
            .map_err(|wrong| Error::config(place(kind, step, &wrong.problem), wrong.problem, wrong.fix))?;
        let checked = match kind {
            Kind::Collect => collect::check(&parse::<CollectArgs>(kind, step, &arguments)?)
                .map(|schema| drop(columns.insert(kind.output(folder, &step.name), schema))),
            Kind::Train => {
                let args = parse::<TrainArgs>(kind, step, &arguments)?;
                args.config().and_then(|_| args.check())
            }
            Kind::Eval => {
                let is_output = |policy: &str| outputs.iter().any(|output| output == Path::new(policy));
                let args = parse::<EvalArgs>(kind, step, &arguments)?;
                args.check(&resolver, is_output)
            }
        };
        checked.map_err(|error| of_step(kind, step, error))?;
    }
    Ok(columns)
}

/// Names the step in an error of its options.
fn of_step(kind: Kind, step: &Step, error: Error) -> Error {
    let text = error.to_string();
    let place = place(kind, step, &text);
    match error {
        // Callers tell unknown names apart by their kind.
        Error::UnknownName { kind, given, nearest, hint } => {
            Error::UnknownName { kind, given, nearest, hint: format!("{hint}; correct {place}") }
        }
        _ => Error::config(place, text, "correct its options"),
    }
}

/// Returns where the option or setting of a step is that a problem names.
fn place(kind: Kind, step: &Step, problem: &str) -> String {
    format!("[[{}]] '{}' of the recipe{}", kind.name(), step.name, step.lines.of_problem(problem))
}

/// Checks that the datasets to collect have the columns that the trainings on them read, such as images of the model's size.
///
/// # Errors
/// When a column is missing, or has another shape.
pub(super) fn check_columns(recipe: &Recipe, folder: &Path, columns: &Columns) -> Result<()> {
    for step in &recipe.train {
        let args: TrainArgs = parse(Kind::Train, step, &recipe.arguments(Kind::Train, step, folder))?;
        if let Some(schema) = args.data.as_ref().and_then(|data| columns.get(Path::new(data))) {
            args.config()?.check_columns(schema).map_err(|error| of_step(Kind::Train, step, error))?;
        }
    }
    Ok(())
}

/// Checks that the devices of the steps that are not finished can be opened: another machine may have had those of the others.
///
/// # Errors
/// When one cannot be opened, or the folder of a finished evaluation has files that are not its own.
fn check_devices(recipe: &Recipe, folder: &Path, state: &State) -> Result<()> {
    for (kind, step) in recipe.steps() {
        if state.finished.contains_key(&step.name) && output_exists(kind, &kind.output(folder, &step.name))? {
            continue;
        }
        let arguments = recipe.arguments(kind, step, folder);
        let checked = match kind {
            Kind::Collect => Ok(()),
            Kind::Train => parse::<TrainArgs>(kind, step, &arguments)?.device.check(),
            Kind::Eval => parse::<EvalArgs>(kind, step, &arguments)?.device.check(),
        };
        checked.map_err(|error| of_step(kind, step, error))?;
    }
    Ok(())
}

/// Checks that no training of the recipe begins with weights that would be downloaded. Weights that the user sets are
/// the user's own.
///
/// # Errors
/// When a file chose such weights, in a setting or by a preset that names them.
fn check_weights(recipe: &Recipe, request: &RecipeRun<'_>, origin: &Origin) -> Result<()> {
    for step in &recipe.train {
        let arguments = recipe.arguments(Kind::Train, step, request.output);
        let config = parse::<TrainArgs>(Kind::Train, step, &arguments)?.config()?.to_json();
        for (key, from) in pretrained_weights(&config) {
            let own = format!("{}.{key}=", step.name);
            // What is no file is looked for on the hub of models, but the weights of an earlier step are made later.
            let is_made =
                recipe.train.iter().any(|other| file::weights(&other.name, request.output) == Path::new(&from));
            if !is_made
                && !Path::new(&from).is_file()
                && !request.settings.iter().any(|setting| setting.starts_with(&own))
            {
                let name = format!("the pretrained weights '{from}' of [[train]] '{}'", step.name);
                origin.check_user(&name, "which may be downloaded", Some(format!("{own}FILE").as_str()))?;
            }
        }
    }
    Ok(())
}

/// Returns whether the output of a finished step is there. The other files of an evaluation are nothing without its
/// results.
///
/// # Errors
/// When the folder of an evaluation has no results, but files that are not of an evaluation.
fn output_exists(kind: Kind, output: &Path) -> Result<bool> {
    if kind != Kind::Eval || !output.exists() || output.join(RESULTS).exists() {
        return Ok(output.exists());
    }
    let Some(other) = output_folder::foreign_file(output)? else { return Ok(false) };
    let problem = format!("it has no {RESULTS}, and holds {}, which is not of an evaluation", other.display());
    let fix = "restore the results, or move the folder away, to evaluate again";
    Err(Error::corrupt(output, problem, fix))
}

/// Checks that the output of a finished step is the one that the run recorded: otherwise another one was put in its
/// place, and the results of later steps are not its own.
///
/// # Errors
/// When its hash differs, or it is damaged.
fn check_output(kind: Kind, output: &Path, recorded: &str) -> Result<()> {
    let fix = "remove it and the outputs of the steps that use it, to make them again; or choose another folder";
    if kind == Kind::Train
        && let Some(fault) = checkpoint::faults(output)?.into_iter().next()
    {
        return Err(Error::corrupt(output, fault, fix));
    }
    // Older runs recorded no hash of an evaluation.
    if kind == Kind::Eval && recorded.is_empty() {
        return Ok(());
    }
    let found = output_hash(kind, output)?;
    if found == recorded {
        return Ok(());
    }
    let problem = format!("its hash is {found}, and the run made it with the hash {recorded}");
    Err(Error::corrupt(output, problem, fix))
}

/// Returns the hash of a dataset, of weights, or of the file of an evaluation's results.
fn output_hash(kind: Kind, output: &Path) -> Result<String> {
    match kind {
        Kind::Collect => home::open_dataset(&output.to_string_lossy())?.content_hash(),
        Kind::Train => {
            let stored = StoredCheckpoint::read(output)?;
            Ok(stored.manifest().hashes.get("weights").cloned().unwrap_or_default())
        }
        Kind::Eval => Ok(manifest::hash(&files::read(&output.join(RESULTS), output_folder::MAX_OUTPUT_BYTES)?)),
    }
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
            let args: CollectArgs = parse(kind, step, &arguments)?;
            let what = format!("the dataset {}", output.display());
            if let Found::Recorded(hash) = datasets::find(step, &what, &output, &args)? {
                return Ok(hash);
            }
            collect::run_args(&args, context)?;
        }
        Kind::Train => {
            train::run_args(&parse(kind, step, &arguments)?, context)?;
        }
        Kind::Eval => {
            let (results, _) = eval::run_args(&parse(kind, step, &arguments)?, context)?;
            if !context.json {
                emit(&crate::cli::results_tables::summary(&results));
            }
        }
    }
    Ok(output_hash(kind, &output)?)
}

/// Writes the page of all evaluations; `None` without evaluations.
fn report(recipe: &Recipe, request: &RecipeRun<'_>, context: &Context) -> Result<Option<PathBuf>> {
    let files = recipe.eval.iter().map(|step| request.output.join(&step.name).join(RESULTS));
    let results = files.map(|file| Ok((file.clone(), swm_report::read_results(&file)?))).collect::<Result<Vec<_>>>()?;
    if results.is_empty() {
        return Ok(None);
    }
    let settings: Vec<String> = request.settings.iter().map(|setting| format!(" {setting}")).collect();
    let options = ReportOptions {
        title: Some(recipe.summary.clone()),
        training: recipe.train.iter().map(|step| of_checkpoint(&step.name, &request.output.join(&step.name))).collect(),
        command: Some(format!("swm train --recipe {} -o DIR{}", request.recipe, settings.concat())),
    };
    if context.interrupt.load(std::sync::atomic::Ordering::SeqCst) {
        return Err(Error::Interrupted);
    }
    swm_report::write_report_with(&results, &options, request.output).map(Some)
}

impl State {
    /// Reads the record of the run in the folder, or writes a new one.
    ///
    /// # Errors
    /// As [`State::read`].
    fn open(request: &RecipeRun<'_>, recipe: &Recipe) -> Result<Self> {
        let state = Self::read(request, recipe)?;
        if !request.output.join(STATE).exists() {
            state.write(request.output)?;
        }
        Ok(state)
    }

    /// Reads the record of the run in the folder; without one, returns that of a new run.
    ///
    /// # Errors
    /// When the folder holds a run of another recipe or with other settings.
    fn read(request: &RecipeRun<'_>, recipe: &Recipe) -> Result<Self> {
        let path = request.output.join(STATE);
        let new = Self {
            recipe: request.recipe.to_owned(),
            request: recipe.request_hash()?,
            settings: request.settings.iter().map(ToString::to_string).collect(),
            processor: capsule::cpu_level(),
            ..Self::default()
        };
        if !path.exists() {
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
        Ok(Self { finished: found.finished, inputs: found.inputs, outside: found.outside, ..new })
    }

    fn write(&self, folder: &Path) -> Result<()> {
        eval::write_json(&folder.join(STATE), self)
    }

    /// Returns whether a step is finished, with the recorded output. A step whose output is gone is recorded as not
    /// finished.
    ///
    /// # Errors
    /// When the output is another one, damaged, longer than the step asks for, or made from other outputs of earlier steps.
    fn is_finished(&mut self, recipe: &Recipe, (kind, step): (Kind, &Step), folder: &Path) -> Result<bool> {
        let output = kind.output(folder, &step.name);
        match self.finished.get(&step.name) {
            Some(recorded) if output_exists(kind, &output)? => {
                check_output(kind, &output, recorded)?;
                if kind == Kind::Collect {
                    let args = parse(kind, step, &recipe.arguments(kind, step, folder))?;
                    datasets::find(step, &format!("the dataset {}", output.display()), &output, &args)?;
                }
                let (made_from, found) = (self.inputs.get(&step.name), self.inputs_of(recipe, step)?);
                if made_from.is_some_and(|inputs| *inputs != found) {
                    let problem = "was made from other outputs of earlier steps than those that are there";
                    return Err(Error::corrupt(&output, problem, "move it away, to make it again"));
                }
                let read = outside::of(recipe, (kind, step), folder);
                if let Some(what) = self.outside.get(&step.name).and_then(|recorded| outside::changed(recorded, &read))
                {
                    let fix = "restore that, or move this away, to make it again";
                    return Err(Error::corrupt(&output, format!("was made with {what}, which has changed since"), fix));
                }
                Ok(true)
            }
            Some(_) => {
                self.finished.remove(&step.name);
                self.write(folder).map(|()| false)
            }
            None => Ok(false),
        }
    }

    /// Returns the hash of those of the datasets and weights before a step.
    fn inputs_of(&self, recipe: &Recipe, step: &Step) -> Result<String> {
        let before = recipe.steps().take_while(|(_, other)| other.name != step.name);
        let made = before.filter(|(kind, _)| *kind != Kind::Eval).map(|(_, other)| self.finished.get(&other.name));
        let text = serde_json::to_vec(&made.collect::<Vec<_>>());
        Ok(manifest::hash(&text.map_err(|error| Error::external("writing the record of a recipe", error))?))
    }

    /// Returns the hashes of datasets and weights, with the recorded ones.
    fn compare<'a>(&'a self, recipe: &'a Recipe) -> Vec<Compared<'a>> {
        let made = recipe.steps().filter(|(kind, _)| *kind != Kind::Eval);
        let compared = made.filter_map(|(_, step)| {
            let hash = self.finished.get(&step.name)?;
            Some(Compared { name: &step.name, hash, expected: step.hash.as_deref() })
        });
        compared.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_of_finished_steps_are_not_checked() {
        let step = "name = \"small\"\nmodel = \"lewm\"\ndata = \"rooms\"\ndevice = \"abacus:0\"";
        let recipe = Recipe::parse("x", &format!("summary = \"s\"\n[[train]]\n{step}")).expect("a recipe");
        let folder = tempfile::tempdir().expect("a folder");
        let mut state = State::default();
        let check = |state: &State| check_devices(&recipe, folder.path(), state).map_err(|error| error.to_string());
        assert!(check(&state).is_err_and(|error| error.contains("abacus") && error.contains("'small'")));
        state.finished.insert("small".to_owned(), String::new());
        assert!(check(&state).is_err(), "its output is gone");
        std::fs::create_dir(folder.path().join("small")).expect("an output");
        assert_eq!(check(&state), Ok(()));
    }
}
