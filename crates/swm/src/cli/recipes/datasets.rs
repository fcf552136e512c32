//! [`Datasets`]: datasets by name in the home folder, collected where they are missing.

use super::file::{Kind, Recipe, Step, parse};
use crate::cli::collect::{self, CollectArgs};
use crate::cli::{Context, eprint};
use crate::home;
use std::path::Path;
use std::sync::Arc;
use swm_core::{Error, Manifest, Origin, Result};
use swm_data::{ImageCodec, Location, Reader};
use swm_eval::continuation::{Difference, difference};
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
    /// When `origin` is a file, which may not write to the home folder, collecting fails, or a complete dataset is another
    /// than the one to collect.
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
            let what = format!("{}: the dataset {}", self.at, output.display());
            let found = match find(step, &what, &output, &args)? {
                Found::Recorded(hash) => hash,
                Found::Complete(stored) => {
                    let hash = stored.content_hash()?;
                    check_complete(step, &what, &args, (stored.manifest(), &hash))?;
                    hash
                }
                Found::Unfinished => {
                    let name = format!("the dataset '{}' to collect", step.name);
                    origin.check_user(&name, "which it stores in the home folder", None)?;
                    collect::run_args(&args, context)?;
                    home::open_dataset(&output.to_string_lossy())?.content_hash()?
                }
            };
            if let Some(expected) = step.hash.as_ref().filter(|expected| **expected != found) {
                let problem = format!("has the hash {found}, not {expected}: results are those of another dataset");
                eprint(&format!("warning: {what} {problem}\n"));
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

/// What is there of the dataset of a step.
pub(super) enum Found {
    /// No dataset, or one with fewer episodes than the step asks for.
    Unfinished,
    /// The dataset with the hash in the step, which is returned: it is used as it is.
    Recorded(String),
    /// Another dataset with as many episodes as the step asks for, or more if the step allows them.
    Complete(Arc<dyn Reader>),
}

/// Looks for the dataset of a step. `what` names the dataset in errors.
///
/// # Errors
/// When it cannot be read, or has more episodes than the step asks for and allows.
pub(super) fn find(step: &Step, what: &str, output: &Path, args: &CollectArgs) -> Result<Found> {
    if !output.exists() {
        return Ok(Found::Unfinished);
    }
    swm_data::recover(&Location::from(output))?;
    if swm_data::has_no_dataset(output) {
        return Ok(Found::Unfinished);
    }
    let stored = home::open_dataset(&output.to_string_lossy())?;
    let (count, wanted) = (stored.episodes().len(), args.episodes());
    if count < wanted {
        return Ok(Found::Unfinished);
    }
    if let Some(recorded) = &step.hash
        && *recorded == stored.content_hash()?
    {
        return Ok(Found::Recorded(recorded.clone()));
    }
    if count == wanted || step.allows_more() {
        return Ok(Found::Complete(stored));
    }
    let problem = format!("it has {count} episodes, and [[collect]] '{}' asks for {wanted}", step.name);
    let fix = "move it away, to collect it as asked; or write more-episodes = true in the table, to use all of them";
    Err(Error::config(what, problem, fix))
}

/// Checks that a complete dataset, with this manifest and hash, is the one that a step collects, as far as the manifest says.
///
/// # Errors
/// When a setting differs.
fn check_complete(
    step: &Step,
    what: &str,
    args: &CollectArgs,
    (manifest, hash): (Option<Manifest>, &str),
) -> Result<()> {
    // Joined datasets, and those of other programs, have no manifest of a collection.
    let Some(manifest) = manifest.filter(|manifest| manifest.kind == "collect") else {
        eprint(&format!("warning: {what} does not record how it was collected, and is used as it is\n"));
        return Ok(());
    };
    let (wanted, unknown) = collect::manifest(args)?;
    if let Some(found) = differs(&manifest, &wanted) {
        let asked = format!("[[collect]] '{}' asks for {} {}", step.name, found.setting, found.wanted);
        let problem = format!("{}, and {asked}", found.problem());
        let fix = format!(
            "move the dataset away, to collect it as asked; change the name or the settings of the table; or write \
             hash = \"{hash}\" in the table, to use the dataset as it is"
        );
        return Err(Error::config(what, problem, fix));
    }
    if let Some(error) = unknown {
        eprint(&format!("warning: {what} is used as it is, because its policy cannot be compared: {error}\n"));
    }
    Ok(())
}

/// Returns a setting in which a dataset differs from the one that a step collects. Frames of all lossless codecs are the same.
fn differs(stored: &Manifest, wanted: &Manifest) -> Option<Difference> {
    let is_lossless = |manifest: &Manifest| {
        let codec = serde_json::from_value(manifest.config["codec"].clone());
        codec.is_ok_and(|codec: ImageCodec| matches!(codec, ImageCodec::Png | ImageCodec::Qoi))
    };
    let mut stored = stored.clone();
    if is_lossless(&stored) && is_lossless(wanted) {
        stored.config["codec"] = wanted.config["codec"].clone();
    }
    difference(&stored, wanted)
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
    #[test]
    fn settings_of_a_complete_dataset_are_compared() {
        let recipe = |policy: &str, more: &str| {
            let table = format!("env = \"swm/TwoRoom-v1\"\npolicy = \"{policy}\"\nepisodes = 3\n{more}");
            Recipe::parse("x", &format!("summary = \"s\"\n[[collect]]\nname = \"rooms\"\n{table}")).expect("a recipe")
        };
        let args = |recipe: &Recipe| -> CollectArgs {
            let arguments = recipe.arguments(Kind::Collect, &recipe.collect[0], Path::new("datasets"));
            parse(Kind::Collect, &recipe.collect[0], &arguments).expect("options")
        };
        let manifest = |policy: &str, more: &str| collect::manifest(&args(&recipe(policy, more))).expect("a manifest");
        let (qoi, unknown) = manifest("random", "");
        assert!(unknown.is_none());
        let setting = |more: &str| differs(&manifest("random", more).0, &qoi).map(|found| found.setting);
        assert_eq!(setting("codec = \"png\""), None);
        for (more, named) in [("codec = \"jpeg\"", "codec"), ("seed = 9", "seed"), ("image = 32", "image")] {
            assert_eq!(setting(more).as_deref(), Some(named));
        }
        let check = |kind: &str| {
            let (recipe, stored) = (recipe("random", "seed = 9"), Manifest { kind: kind.to_owned(), ..qoi.clone() });
            check_complete(&recipe.collect[0], "rooms", &args(&recipe), (Some(stored), "abc"))
        };
        let error = check("collect").expect_err("another seed").to_string();
        for part in ["collected with seed 0", "'rooms' asks for seed 9", "hash = \"abc\""] {
            assert!(error.contains(part), "{error}");
        }
        check("concat").expect("a joined dataset is used as it is");
        // The checkpoint of the policy is gone.
        let (gone, unknown) = manifest("gone/model", "");
        assert!(unknown.is_some_and(|error| error.to_string().contains("gone/model")));
        assert_eq!(differs(&gone, &gone), None);
        let found = differs(&gone, &qoi).expect("another policy");
        assert_eq!((found.setting.as_str(), found.wanted.as_str()), ("policy", "\"random\""));
    }
}
