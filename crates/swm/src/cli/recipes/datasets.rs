//! [`Datasets`]: datasets by name in the home folder, collected where they are missing.

use super::file::{Kind, Recipe, parse};
use crate::cli::collect::{self, CollectArgs};
use crate::cli::{Context, eprint};
use crate::home;
use std::path::Path;
use swm_core::{Origin, Result};
use toml::{Table, Value};

/// The collecting steps of a recipe, whose outputs are datasets in the home folder.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Datasets {
    /// The file and the line of the tables.
    at: String,
    steps: Option<Recipe>,
}

impl Datasets {
    /// Reads the tables `[[collect]]` of a file; `at` is named in errors.
    ///
    /// # Errors
    /// As [`Recipe::parse`].
    pub fn parse(at: &str, tables: Value) -> Result<Self> {
        let text = |text: &str| Value::String(text.to_owned());
        let table = Table::from_iter([("summary".to_owned(), text("datasets")), ("collect".to_owned(), tables)]);
        let steps = Recipe::parse_part(at, &table.to_string())?;
        for step in &steps.collect {
            let arguments = steps.arguments(Kind::Collect, step, Path::new("datasets"));
            parse::<CollectArgs>(Kind::Collect, step, &arguments)?;
        }
        Ok(Self { at: at.to_owned(), steps: Some(steps) })
    }

    /// The arguments of `swm collect` for each dataset.
    pub fn commands(&self) -> Vec<Vec<String>> {
        let steps = |recipe: &Recipe| {
            let command = |step| {
                let arguments = recipe.arguments(Kind::Collect, step, Path::new(""));
                let name = format!("--output={}", step.name);
                let (_, rest) = arguments.split_first()?;
                Some([&["collect".to_owned(), name][..], rest].concat())
            };
            recipe.collect.iter().filter_map(command).collect()
        };
        self.steps.as_ref().map_or(vec![], steps)
    }

    /// Collects what is missing, and completes what was interrupted.
    ///
    /// # Errors
    /// When `origin` is a file, which may not write to the home folder, or collecting fails.
    pub fn make(&self, origin: &Origin, context: &Context) -> anyhow::Result<()> {
        let Some(recipe) = &self.steps else { return Ok(()) };
        let folder = home::datasets()?;
        for step in &recipe.collect {
            let output = Kind::Collect.output(&folder, &step.name);
            let mut arguments = recipe.arguments(Kind::Collect, step, &folder);
            if output.exists() {
                arguments.insert(0, "--resume".to_owned());
            }
            let args: CollectArgs = parse(Kind::Collect, step, &arguments)?;
            let is_complete =
                output.exists() && home::open_dataset(&output.to_string_lossy())?.episodes().len() >= args.episodes();
            if !is_complete {
                origin.check_user(
                    &format!("the dataset '{}' to collect", step.name),
                    "which it stores in the home folder",
                    None,
                )?;
                collect::run_args(&args, context)?;
            }
            let found = home::open_dataset(&output.to_string_lossy())?.content_hash()?;
            if let Some(expected) = step.hash.as_ref().filter(|expected| **expected != found) {
                let what =
                    format!("{}: the dataset {} has the hash {found}, not {expected}", self.at, output.display());
                eprint(&format!("warning: {what}: results are those of another dataset\n"));
            }
        }
        Ok(())
    }

    /// Checks the environments and wrappers that the tables name.
    ///
    /// # Errors
    /// When a file chose a name that only the user may choose.
    pub fn check_origin(&self, origin: &Origin) -> Result<()> {
        self.steps.as_ref().map_or(Ok(()), |recipe| recipe.check_origin(origin))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_collecting_steps() {
        let table = |text: &str| toml::from_str::<Table>(text).expect("TOML").remove("collect").expect("tables");
        let text = "[[collect]]\nname = \"rooms\"\nenv = \"swm/TwoRoom-v1\"\npolicy = \"random\"\nepisodes = 3\n";
        let datasets = Datasets::parse("study.toml:4", table(text)).expect("a dataset");
        let expected = ["collect", "--output=rooms", "--episodes=3", "--policy=random", "--", "swm/TwoRoom-v1"];
        assert_eq!(datasets.commands(), [expected.map(str::to_owned)]);
        for (from, to, part) in [("episodes", "epsodes", "epsodes"), ("\"rooms\"", "\"../rooms\"", "../rooms")] {
            let error = Datasets::parse("study.toml:4", table(&text.replace(from, to))).expect_err(to).to_string();
            assert!(error.contains(part), "{error}");
        }
        assert_eq!(Datasets::default().commands().len(), 0);
    }
}
