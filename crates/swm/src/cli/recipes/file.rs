//! [`Recipe`]: the steps from collecting to evaluating, as a TOML file.
//!
//! A step is a table of options of `swm collect`, `swm train` or `swm eval`, without their dashes. `name` names its output;
//! options of later steps refer to it. `hash` is the expected hash of a dataset or of weights.

use super::lines::{self, Lines};
use crate::cli::train::TrainArgs;
use crate::cli::usage;
use clap::{Args, Parser};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::{Error, Origin, Result, manifest};
use swm_envs::wrappers;
use swm_models::run_folder;
use toml::{Table, Value};

/// The largest recipe, in bytes.
pub const MAX_BYTES: u64 = 1 << 20;

/// The largest number of steps of a recipe.
const MAX_STEPS: usize = 1000;

/// The steps from collecting to evaluating.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Recipe {
    /// What the recipe makes, in a sentence.
    pub summary: String,
    /// The processor on which the hashes were recorded: the weights of another one differ in their last bits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorded_on: Option<String>,
    /// The datasets.
    #[serde(default)]
    pub collect: Vec<Step>,
    /// The checkpoints.
    #[serde(default)]
    pub train: Vec<Step>,
    /// The evaluations.
    #[serde(default)]
    pub eval: Vec<Step>,
}

/// A step of a recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// The name of the output, in the folder of the run.
    pub name: String,
    /// The expected hash of the dataset or the weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hash: Option<String>,
    /// Settings of the training.
    #[serde(default, skip_serializing_if = "Table::is_empty")]
    pub settings: Table,
    /// Arguments and options of the command.
    #[serde(flatten)]
    pub options: BTreeMap<String, Value>,
    /// Where the step is in its file.
    #[serde(skip)]
    pub lines: Lines,
}

/// The command of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Collect,
    Train,
    Eval,
}

/// Options that a recipe may not set: the run sets them, or they are the user's to give.
const RESERVED: &[&str] =
    &["output", "resume", "overwrite", "shard", "format", "trust", "recipe", "print-config", "mix-renderers"];

/// The option of a dataset that may have more episodes than its step asks for. It is no option of `swm collect`.
const MORE_EPISODES: &str = "more-episodes";

/// Options whose values may be names of earlier steps.
pub const REFERENCES: &[&str] = &["data", "dataset", "encoder", "policies", "policy"];

impl Kind {
    /// The name of the command and of its tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Collect => "collect",
            Self::Train => "train",
            Self::Eval => "eval",
        }
    }

    /// The key of the command's positional argument.
    fn positional(self) -> &'static str {
        match self {
            Self::Collect => "env",
            Self::Train => "model",
            Self::Eval => "policies",
        }
    }

    /// The path of the output of a step in the folder of the run.
    pub fn output(self, folder: &Path, name: &str) -> PathBuf {
        folder.join(if self == Self::Collect { format!("{name}.lance") } else { name.to_owned() })
    }
}

impl Step {
    /// Whether a dataset that is there may have more episodes than the step asks for.
    pub fn allows_more(&self) -> bool {
        self.options.get(MORE_EPISODES).and_then(Value::as_bool).unwrap_or_default()
    }

    /// Checks what becomes a positional argument: a second text, or a `=` in a key, would be another setting.
    fn check_texts(&self, kind: Kind) -> std::result::Result<(), String> {
        let key = kind.positional();
        if kind != Kind::Eval && self.options.get(key).is_some_and(|value| !value.is_str()) {
            return Err(format!("has a '{key}' that is not one text"));
        }
        let is_plain =
            |key: &str| !key.is_empty() && key.chars().all(|c| c.is_ascii_alphanumeric() || "_.".contains(c));
        match flat(&self.settings).into_iter().find(|(key, _)| !is_plain(key)) {
            Some((key, _)) => {
                Err(format!("has the setting '{key}': its name has other characters than letters, digits, _ and ."))
            }
            None => Ok(()),
        }
    }
}

impl Recipe {
    /// Reads the file of a recipe. `what` names it in errors, with the line.
    ///
    /// # Errors
    /// When the text is not a recipe, a name is used twice or is not a plain file name, or an option is reserved.
    pub fn parse(what: &str, text: &str) -> Result<Self> {
        Self::parse_with(what, text, true)
    }

    /// Reads a recipe whose text is a part of another file, so that its lines say nothing.
    ///
    /// # Errors
    /// As [`Recipe::parse`].
    pub fn parse_part(what: &str, text: &str) -> Result<Self> {
        Self::parse_with(what, text, false)
    }

    fn parse_with(what: &str, text: &str, has_lines: bool) -> Result<Self> {
        let invalid =
            |problem: String| Error::config(format!("recipe {what}"), problem, "docs/zoo.md describes recipes");
        let mut recipe: Self = toml::from_str(text).map_err(|error| {
            let line = if has_lines { lines::of_error(text, &error) } else { String::new() };
            invalid(format!("{}{line}", error.message()))
        })?;
        let parts = [("collect", &mut recipe.collect), ("train", &mut recipe.train), ("eval", &mut recipe.eval)];
        for (kind, steps) in parts.into_iter().filter(|_| has_lines) {
            steps.iter_mut().zip(Lines::of(text, kind)).for_each(|(step, lines)| step.lines = lines);
        }
        let count = recipe.steps().count();
        if count > MAX_STEPS {
            return Err(invalid(format!("it has {count} steps, and at most {MAX_STEPS} are allowed")));
        }
        let mut names = vec![];
        for (kind, step) in recipe.steps() {
            let name = step.name.as_str();
            let is_plain = name.starts_with(|c: char| c.is_ascii_alphanumeric())
                && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c));
            let invalid = |problem: String| {
                let line = step.lines.of_problem(&problem);
                invalid(problem + &line)
            };
            if !is_plain || name.len() > 64 {
                return Err(invalid(format!("the name '{name}' has other characters than letters, digits, - and _")));
            }
            if names.contains(&name) {
                return Err(invalid(format!("two steps have the name '{name}'")));
            }
            names.push(name);
            let is_hash = |hash: &String| hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit());
            if let Some(hash) = step.hash.as_ref().filter(|hash| !is_hash(hash)) {
                return Err(invalid(format!("the hash '{hash}' of '{name}' has not 64 hexadecimal digits")));
            }
            let is_option = |key: &str| key.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-');
            if let Some(key) = step.options.keys().find(|key| !is_option(key)) {
                return Err(invalid(format!("[[{}]] '{name}' has '{key}', which is no option", kind.name())));
            }
            if let Some(key) = step.options.keys().find(|key| RESERVED.contains(&key.as_str())) {
                return Err(invalid(format!("[[{}]] '{name}' sets '{key}', which a recipe may not", kind.name())));
            }
            if kind != Kind::Train && !step.settings.is_empty() {
                return Err(invalid(format!("[[{}]] '{name}' has settings, which only [[train]] has", kind.name())));
            }
            step.check_texts(kind).map_err(|problem| invalid(format!("[[{}]] '{name}' {problem}", kind.name())))?;
        }
        Ok(recipe)
    }

    /// Returns the steps in the order in which they run.
    pub fn steps(&self) -> impl Iterator<Item = (Kind, &Step)> {
        fn of(kind: Kind, steps: &[Step]) -> impl Iterator<Item = (Kind, &Step)> {
            steps.iter().map(move |step| (kind, step))
        }
        of(Kind::Collect, &self.collect).chain(of(Kind::Train, &self.train)).chain(of(Kind::Eval, &self.eval))
    }

    /// Changes an option or a setting: `STEP.OPTION=VALUE`, such as `rooms.episodes=20` or `lewm.optim.lr=3e-4`. The expected
    /// hashes, which are those without changes, are dropped.
    ///
    /// # Errors
    /// When there is no such step, or the text has another form.
    pub fn set(&mut self, text: &str) -> Result<()> {
        let wrong = |problem: String| {
            Error::config(format!("setting {text}"), problem, "write STEP.OPTION=VALUE, such as rooms.episodes=20")
        };
        let (name, key, value) = text
            .split_once('=')
            .and_then(|(key, value)| key.split_once('.').map(|(name, key)| (name, key, value)))
            .ok_or_else(|| wrong("it has another form".to_owned()))?;
        let names: Vec<String> = self.steps().map(|(_, step)| step.name.clone()).collect();
        let trains = self.train.iter().any(|step| step.name == name);
        let is_option = |key: &str| {
            let command = TrainArgs::augment_args(clap::Command::new("train"));
            key == "model" || command.get_arguments().any(|argument| argument.get_long() == Some(key))
        };
        let mut all = self.collect.iter_mut().chain(&mut self.train).chain(&mut self.eval);
        let Some(step) = all.find(|step| step.name == name) else {
            let known = names.iter().map(String::as_str);
            let hint = format!("its steps are {}", names.join(", "));
            return Err(Error::unknown("step of the recipe", name, known, hint));
        };
        if RESERVED.contains(&key) {
            return Err(wrong(format!("a recipe may not set '{key}'")));
        }
        let value = toml::from_str::<Table>(&format!("value = {value}"))
            .ok()
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(|| Value::String(value.to_owned()));
        match trains && !is_option(key) {
            true => {
                remove_dotted(&mut step.settings, key);
                step.settings.insert(key.to_owned(), value);
            }
            false => drop(step.options.insert(key.to_owned(), value)),
        }
        self.collect.iter_mut().chain(&mut self.train).chain(&mut self.eval).for_each(|step| step.hash = None);
        Ok(())
    }

    /// Returns the hash that identifies the recipe with its settings; expected hashes do not change it.
    ///
    /// # Errors
    /// Never for a recipe that was parsed.
    pub fn request_hash(&self) -> Result<String> {
        let mut request = self.clone();
        let steps = request.collect.iter_mut().chain(&mut request.train).chain(&mut request.eval);
        steps.for_each(|step| {
            step.hash = None;
            step.options.remove(MORE_EPISODES);
        });
        let without = Self { recorded_on: None, summary: String::new(), ..request };
        let text = serde_json::to_string(&without).map_err(|error| Error::external("writing a recipe", error))?;
        Ok(manifest::hash(text.as_bytes()))
    }

    /// Checks the names in the recipe that load code, start programs, read files or open connections. Pretrained weights are checked in
    /// the complete configuration of a training, because a preset may name them.
    ///
    /// # Errors
    /// When a file chose such a name.
    pub fn check_origin(&self, origin: &Origin) -> Result<()> {
        for (_, step) in self.steps() {
            for (key, value) in &step.options {
                for text in texts(value) {
                    if key == "env" {
                        crate::env(&text, origin)?;
                    } else if key == "wrapper" && wrappers::read(&text)?.0.reads_files() {
                        origin.check_user(&format!("the wrapper '{text}'"), "which reads files", None)?;
                    } else if key == "log" && !text.split(',').all(is_written_here) {
                        origin.check_user(&format!("the tracker '{text}'"), "which is started", None)?;
                    } else if key == "preset" && !is_preset_name(&text) {
                        origin.check_user(&format!("the preset '{text}'"), "which is a file", None)?;
                    } else if key == "feature-cache" {
                        origin.check_user(&format!("the folder '{text}'"), "which is written to", None)?;
                    } else if text.contains("://") {
                        origin.check_user(&format!("'{text}'"), "which opens a network connection", None)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns the settings of a training under dotted keys. The name of an earlier training as `weights` becomes the path of
    /// its weights.
    pub fn settings(&self, step: &Step, folder: &Path) -> Vec<(String, String)> {
        let earlier = || self.train.iter().take_while(|other| other.name != step.name);
        let resolve = |(key, value): (String, String)| {
            let is_weights = key.rsplit('.').next() == Some("weights");
            match earlier().find(|other| is_weights && Value::from(other.name.as_str()).to_string() == value) {
                Some(other) => (key, Value::from(weights(&other.name, folder).display().to_string()).to_string()),
                None => (key, value),
            }
        };
        flat(&step.settings).into_iter().map(resolve).collect()
    }

    /// Returns the arguments of a step's command, after the program and the command. Names of steps become paths in
    /// `folder`.
    pub fn arguments(&self, kind: Kind, step: &Step, folder: &Path) -> Vec<String> {
        let resolve = |key: &str, text: String| match self.steps().find(|(_, other)| other.name == text) {
            Some((kind, other)) if REFERENCES.contains(&key) => kind.output(folder, &other.name).display().to_string(),
            _ => text,
        };
        let values =
            |key: &str, value: &Value| texts(value).into_iter().map(|text| resolve(key, text)).collect::<Vec<_>>();
        let mut arguments = vec![format!("--output={}", kind.output(folder, &step.name).display())];
        let is_of_recipe = |key: &str, value: &Value| kind == Kind::Collect && key == MORE_EPISODES && value.is_bool();
        let is_option = |key: &str, value: &Value| key != kind.positional() && !is_of_recipe(key, value);
        for (key, value) in step.options.iter().filter(|(key, value)| is_option(key, value)) {
            match value {
                Value::Boolean(true) => arguments.push(format!("--{key}")),
                Value::Boolean(false) => {}
                _ => arguments.extend(values(key, value).into_iter().map(|text| format!("--{key}={text}"))),
            }
        }
        // No text after `--` is an option.
        arguments.push("--".to_owned());
        if let Some(value) = step.options.get(kind.positional()) {
            arguments.extend(values(kind.positional(), value));
        }
        arguments.extend(self.settings(step, folder).into_iter().map(|(key, value)| format!("{key}={value}")));
        arguments
    }
}

/// The path of the weights of the training with a name.
pub fn weights(name: &str, folder: &Path) -> PathBuf {
    run_folder::weights(&Kind::Train.output(folder, name))
}

/// Parses the arguments of a step as the command line does.
///
/// # Errors
/// When the command has no such option, or refuses a value.
pub fn parse<T: Args>(kind: Kind, step: &Step, arguments: &[String]) -> Result<T> {
    #[derive(Parser)]
    struct Command<T: Args> {
        #[command(flatten)]
        arguments: T,
    }
    let words = std::iter::once(kind.name()).chain(arguments.iter().map(String::as_str));
    Command::<T>::try_parse_from(words).map(|command| command.arguments).map_err(|error| {
        let problem = usage::on_one_line(&error);
        let what = format!("[[{}]] '{}' of the recipe{}", kind.name(), step.name, step.lines.of_problem(&problem));
        Error::config(what, problem, format!("`swm {} --help` lists the options", kind.name()))
    })
}

/// Returns the texts of a value: the elements of an array, or one text.
pub fn texts(value: &Value) -> Vec<String> {
    match value {
        Value::Array(values) => values.iter().flat_map(texts).collect(),
        Value::String(text) => vec![text.clone()],
        other => vec![other.to_string()],
    }
}

/// Whether a log is a file of the run, which no other program writes.
fn is_written_here(log: &str) -> bool {
    matches!(log, "jsonl" | "tensorboard")
}

/// Returns whether a text can be the name of a preset, and no path: names have no dots and no slashes.
pub fn is_preset_name(text: &str) -> bool {
    text.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c))
}

/// Returns the settings of nested tables under dotted keys.
pub fn flat(table: &Table) -> Vec<(String, String)> {
    table
        .iter()
        .flat_map(|(key, value)| match value {
            Value::Table(inner) => {
                flat(inner).into_iter().map(|(below, text)| (format!("{key}.{below}"), text)).collect()
            }
            other => vec![(key.clone(), other.to_string())],
        })
        .collect()
}

/// Removes the setting with a dotted key from nested tables.
fn remove_dotted(table: &mut Table, key: &str) {
    table.remove(key);
    if let Some((first, rest)) = key.split_once('.')
        && let Some(Value::Table(inner)) = table.get_mut(first)
    {
        remove_dotted(inner, rest);
    }
}
