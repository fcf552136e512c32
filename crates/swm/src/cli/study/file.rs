//! The file of a study: tables of options of `swm eval`, each of which may stand for several variants.

use super::any_file::Size;
use super::published;
use crate::cli::eval::EvalArgs;
use crate::cli::recipes::Datasets;
use crate::cli::recipes::lines::LineFeeds;
use clap::{ArgAction, Args as _, Command};
use serde::Deserialize as _;
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::results::Published;
use swm_core::{Error, Result};
use swm_eval::Common;
use toml::Spanned;
use toml::de::{DeString, DeTable, DeValue, ValueDeserializer};

/// A study as its file describes it.
#[derive(Clone, Debug)]
pub struct StudyFile {
    /// The title.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// What the comparisons of a family have in common.
    pub families: Vec<Common>,
    /// The options of all evaluations.
    pub defaults: Table,
    /// The sources of starts; one without options if the file names none.
    pub starts: Vec<Table>,
    /// The conditions, the unshifted one first.
    pub conditions: Vec<Table>,
    /// The policies.
    pub policies: Vec<Table>,
    /// Success rates that publications state.
    pub published: Vec<Published>,
    /// The datasets that the study collects if they do not exist.
    pub datasets: Datasets,
}

/// A table of options.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// The file and the line, for errors.
    pub at: String,
    /// The name; may contain variables.
    pub name: String,
    /// The values of every option, by the name of the option without its dashes.
    pub(super) options: BTreeMap<String, Vec<String>>,
    /// The variables and their values, in alphabetical order.
    pub(super) each: Vec<(String, Values)>,
    /// The names of the sources of starts from which a policy is evaluated; empty for all.
    pub(super) starts: Vec<String>,
}

/// The values of a variable.
#[derive(Clone, Debug)]
pub(super) enum Values {
    /// These values.
    List(Vec<String>),
    /// The factors of variation of the environment.
    Factors,
}

/// A table with one value for each variable.
#[derive(Clone, Debug, Default)]
pub struct Variant {
    /// The file and the line, for errors.
    pub at: String,
    /// The name.
    pub name: String,
    /// The name with `*` for the training seed, if there is this variable.
    pub any_seed: Option<String>,
    /// The values of every option.
    pub options: BTreeMap<String, Vec<String>>,
    /// The values of the variables.
    pub variables: BTreeMap<String, String>,
    /// The names of the sources of starts from which a policy is evaluated; empty for all.
    pub starts: Vec<String>,
}

/// The place of a table that the command line makes, instead of a line of a file.
pub const OF_THE_COMMAND: &str = "the command";

/// The option of a policy's table that names the policy.
pub const POLICY: &str = "policy";

/// Options that belong to a run and not to an evaluation, or that make several conditions of one.
const RUN_OPTIONS: &[&str] =
    &["output", "videos", "trace", "trust", "envs", "help", "shift", "each-factor", "until", "resume"];

/// The tables of a file.
const TABLES: &[&str] =
    &["title", "question", "families", "collect", "defaults", "starts", "condition", "policy", "published", "small"];

impl StudyFile {
    /// Parses a file at a size; `path` is named in errors.
    ///
    /// # Errors
    /// When the text is not TOML, has an unknown table or option, or lacks a title, a policy, a condition or the size. The
    /// error names the line, and the nearest name.
    pub fn parse(text: &str, path: &Path, size: Size) -> Result<Self> {
        let source = Source::new(text, Some(path));
        let table = DeTable::parse(text).map_err(|error| {
            let at = error.span().map_or(0, |span| span.start);
            Error::config(source.at(at), error.message(), "correct the file")
        })?;
        let (mut file, mut small) = (Self::empty(), None);
        for (key, value) in table.get_ref() {
            match key.get_ref().as_ref() {
                "small" => small = Some(value),
                _ => file.set(&source, key, value)?,
            }
        }
        let missing = |what: &str, fix: &str| Error::config(path.display().to_string(), format!("has no {what}"), fix);
        match small.map(|small| file.small(&source, small)).transpose()? {
            Some(small) if size == Size::Small => file = small,
            None if size == Size::Small => {
                return Err(missing("small size", "add [small.defaults], or run it as it is"));
            }
            _ => {}
        }
        if file.title.is_empty() {
            return Err(missing("title", "begin the file with title = \"…\""));
        }
        file.title = size.title(&file.title);
        if file.starts.is_empty() {
            file.starts.push(Table::default());
        }
        if file.conditions.is_empty() {
            return Err(missing("condition", "add [[condition]] with a name; the first one is not shifted"));
        }
        if file.policies.is_empty() {
            return Err(missing("policy", "add [[policy]] with a name and policy = \"…\""));
        }
        Ok(file)
    }

    fn empty() -> Self {
        Self {
            title: String::new(),
            question: String::new(),
            families: Common::by_default(),
            defaults: Table::default(),
            starts: vec![],
            conditions: vec![],
            policies: vec![],
            published: vec![],
            datasets: Datasets::default(),
        }
    }

    /// Reads a table or a text of the file.
    fn set(&mut self, source: &Source<'_>, key: &Spanned<DeString<'_>>, value: &Spanned<DeValue<'_>>) -> Result<()> {
        match key.get_ref().as_ref() {
            "title" => self.title = source.text_of(value)?,
            "question" => self.question = source.text_of(value)?,
            "families" => self.families = source.families(value)?,
            "collect" => self.datasets = source.datasets(value)?,
            "defaults" => self.defaults = source.table(value, false)?,
            "starts" => self.starts = source.tables(value)?,
            "condition" => self.conditions = source.tables(value)?,
            "policy" => self.policies = source.tables(value)?,
            "published" => self.published = published::read(source, value)?,
            other => {
                let hint = format!("the tables are {}", TABLES.join(", "));
                let what = Error::unknown("table", other, TABLES.iter().copied(), hint);
                return Err(Error::config(source.at(key.span().start), what.to_string(), "correct the file"));
            }
        }
        Ok(())
    }

    /// The study at the small size: options of `small.defaults` replace those of the same name, other tables replace all
    /// tables of their kind. Published values and datasets of the other size are left out.
    fn small(&self, source: &Source<'_>, small: &Spanned<DeValue<'_>>) -> Result<Self> {
        let DeValue::Table(entries) = small.get_ref() else {
            return Err(source.invalid(small, "is not a table", "write [small.defaults], [[small.condition]], …"));
        };
        let mut file = Self { published: vec![], datasets: Datasets::default(), ..self.clone() };
        for (key, value) in entries {
            file.set(source, key, value)?;
        }
        if entries.contains_key("defaults") {
            let (mut merged, small) = (self.defaults.clone(), file.defaults);
            merged.each.retain(|(name, _)| !small.options.contains_key(name));
            merged.options.extend(small.options);
            merged.each.extend(small.each);
            file.defaults = merged;
        }
        Ok(file)
    }
}

/// The text of a file, for positions in errors, and the options of `swm eval`.
pub(super) struct Source<'a> {
    text: &'a str,
    /// The path; `None` for a setting of the command line.
    path: Option<&'a Path>,
    feeds: LineFeeds,
    command: Command,
}

impl Source<'_> {
    fn new<'a>(text: &'a str, path: Option<&'a Path>) -> Source<'a> {
        Source { text, path, feeds: LineFeeds::of(text), command: EvalArgs::augment_args(Command::new("eval")) }
    }

    /// The file and line of a byte, or the setting.
    pub(super) fn at(&self, byte: usize) -> String {
        let Some(path) = self.path else { return self.text.to_owned() };
        format!("{}:{}", path.display(), self.feeds.line(byte))
    }

    pub(super) fn invalid(&self, value: &Spanned<DeValue<'_>>, problem: &str, fix: &str) -> Error {
        Error::config(self.at(value.span().start), problem, fix)
    }

    pub(super) fn text_of(&self, value: &Spanned<DeValue<'_>>) -> Result<String> {
        match value.get_ref() {
            DeValue::String(text) => Ok(text.to_string()),
            DeValue::Integer(number) => Ok(number.to_string()),
            DeValue::Float(number) => Ok(number.to_string()),
            _ => Err(self.invalid(value, "is not a text or a number", "give a text or a number")),
        }
    }

    /// A list of texts; one text is a list of one.
    fn list(&self, value: &Spanned<DeValue<'_>>) -> Result<Vec<String>> {
        match value.get_ref() {
            DeValue::Array(values) => values.iter().map(|value| self.text_of(value)).collect(),
            _ => Ok(vec![self.text_of(value)?]),
        }
    }

    /// A list of what the comparisons of a family have in common; an empty list makes one family of all.
    fn families(&self, value: &Spanned<DeValue<'_>>) -> Result<Vec<Common>> {
        let common = |name: &String| {
            let found = Common::ALL.iter().find(|(known, _)| known == name).map(|(_, common)| *common);
            found.ok_or_else(|| {
                let names = Common::ALL.iter().map(|(name, _)| *name);
                let problem = Error::unknown("part of a family", name, names, "docs/studies.md describes them");
                self.invalid(value, &problem.to_string(), "correct the file")
            })
        };
        self.list(value)?.iter().map(common).collect()
    }

    /// The tables `[[collect]]`, read from their text.
    fn datasets(&self, value: &Spanned<DeValue<'_>>) -> Result<Datasets> {
        let at = self.at(value.span().start);
        let read = toml::Value::deserialize(ValueDeserializer::from(value.clone()));
        Datasets::parse(&at, read.map_err(|error| Error::config(&at, error.message(), "correct the file"))?)
    }

    fn tables(&self, value: &Spanned<DeValue<'_>>) -> Result<Vec<Table>> {
        match value.get_ref() {
            DeValue::Array(values) => values.iter().map(|value| self.table(value, true)).collect(),
            _ => Err(self.invalid(value, "is not a list of tables", "write the name in double brackets")),
        }
    }

    fn table(&self, value: &Spanned<DeValue<'_>>, named: bool) -> Result<Table> {
        let DeValue::Table(entries) = value.get_ref() else {
            return Err(self.invalid(
                value,
                "is not a table",
                "write options as KEY = VALUE below the name in brackets",
            ));
        };
        let mut table = Table { at: self.at(value.span().start), ..Table::default() };
        for (key, value) in entries {
            match key.get_ref().as_ref() {
                "name" if named => table.name = self.text_of(value)?,
                "starts" if named => table.starts = self.list(value)?,
                "each" => self.each(value, &mut table)?,
                option => self.option(option, key.span().start, value, &mut table)?,
            }
        }
        if named && table.name.is_empty() {
            return Err(Error::config(table.at, "the table has no name", "add name = \"…\""));
        }
        if table.name.contains(['\n', '\r']) {
            return Err(Error::config(table.at, "the name has several lines", "write it in one line"));
        }
        Ok(table)
    }

    fn each(&self, value: &Spanned<DeValue<'_>>, table: &mut Table) -> Result<()> {
        let DeValue::Table(variables) = value.get_ref() else {
            return Err(self.invalid(value, "is not a table", "write each = { NAME = [VALUE, VALUE] }"));
        };
        for (name, values) in variables {
            let list = match values.get_ref() {
                DeValue::String(text) if text == "factors" => Values::Factors,
                DeValue::Array(_) => Values::List(self.list(values)?),
                _ => {
                    let fix = "give a list, or \"factors\" for all factors of the environment";
                    return Err(self.invalid(values, "is not a list of values", fix));
                }
            };
            table.each.push((name.get_ref().to_string(), list));
        }
        Ok(())
    }

    /// Adds an option of `swm eval`. A list of an option that can be given once makes a variant of each value.
    fn option(&self, key: &str, at: usize, value: &Spanned<DeValue<'_>>, table: &mut Table) -> Result<()> {
        if key == POLICY {
            table.options.insert(key.to_owned(), vec![self.text_of(value)?]);
            return Ok(());
        }
        let known = || self.command.get_arguments().filter_map(|argument| argument.get_long());
        let known = || known().filter(|long| !RUN_OPTIONS.contains(long));
        let argument = self.command.get_arguments().find(|argument| argument.get_long() == Some(key));
        let Some(argument) = argument.filter(|_| !RUN_OPTIONS.contains(&key)) else {
            let names = known().chain([POLICY, "name", "each"]);
            let problem = Error::unknown("option", key, names, "the options are those of `swm eval`").to_string();
            return Err(Error::config(self.at(at), problem, "correct the file"));
        };
        let many = matches!(argument.get_action(), ArgAction::Append)
            || argument.get_num_args().is_some_and(|range| range.max_values() > 1);
        let flag = !argument.get_action().takes_values();
        let values = match value.get_ref() {
            DeValue::Boolean(true) if flag => vec![],
            DeValue::Boolean(false) if flag => return Ok(()),
            DeValue::Table(pins) if many => pins
                .iter()
                .map(|(key, value)| Ok(format!("{}={}", key.get_ref(), self.list(value)?.join(","))))
                .collect::<Result<_>>()?,
            DeValue::Array(_) if !many => {
                let values = self.list(value)?;
                table.each.push((key.to_owned(), Values::List(values)));
                vec![format!("{{{key}}}")]
            }
            _ if flag => return Err(self.invalid(value, "the option takes no value", "give true or false")),
            _ => self.list(value)?,
        };
        table.options.insert(key.to_owned(), values);
        Ok(())
    }
}

impl Table {
    /// Returns the table with settings `KEY=VALUE`, which replace options of the same name.
    ///
    /// # Errors
    /// When a setting is malformed, is given twice, or is no option of `swm eval`.
    pub fn with(&self, settings: &[String]) -> Result<Self> {
        let mut table = Self { name: String::new(), ..self.clone() };
        let mut given: BTreeMap<&str, &str> = BTreeMap::new();
        for setting in settings {
            let Some((key, value)) = setting.split_once('=') else {
                return Err(Error::config(setting, "is not a setting", "write KEY=VALUE, such as episodes=20"));
            };
            if let Some(first) = given.insert(key, setting) {
                return Err(Error::twice(format!("setting {key}"), first, setting));
            }
            table.each.retain(|(name, _)| name != key);
            // A value that is not valid TOML is a string.
            let toml = [format!("value = {value}"), format!("value = {}", toml::Value::from(value))];
            let parsed = toml.iter().find_map(|text| DeTable::parse(text).ok());
            let Some(value) = parsed.as_ref().and_then(|parsed| parsed.get_ref().get("value")) else { continue };
            Source::new(setting, None).option(key, 0, value, &mut table)?;
        }
        Ok(table)
    }

    /// The value of an option that has one value without variables.
    pub fn option(&self, key: &str) -> Option<&str> {
        self.options.get(key).and_then(|values| values.first()).map(String::as_str)
    }
}

impl Variant {
    /// Combines tables; the options of a later table replace those of an earlier one.
    pub fn combine(variants: &[&Self]) -> Self {
        let mut all = Self::default();
        for variant in variants {
            all.options.extend(variant.options.clone());
            all.variables.extend(variant.variables.clone());
        }
        all
    }

    /// The arguments of `swm eval`, the program's name first. A policy that looks like an option follows `--`.
    pub fn arguments(&self) -> Vec<String> {
        let mut arguments = vec!["eval".to_owned()];
        let policies = || self.options.get(POLICY).into_iter().flatten();
        let is_option = policies().any(|policy| policy.starts_with('-'));
        arguments.extend(policies().filter(|_| !is_option).cloned());
        for (key, values) in self.options.iter().filter(|(key, _)| *key != POLICY) {
            if values.is_empty() {
                arguments.push(format!("--{key}"));
            }
            arguments.extend(values.iter().map(|value| format!("--{key}={value}")));
        }
        if is_option {
            arguments.push("--".to_owned());
            arguments.extend(policies().cloned());
        }
        arguments
    }
}
