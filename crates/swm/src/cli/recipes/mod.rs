//! `swm recipes`: lists recipes; `swm train --recipe` runs one.

mod datasets;
mod file;
pub(super) mod lines;
mod outside;
mod references;
mod run;
mod text_check;

pub use datasets::Datasets;
pub use file::is_preset_name;
pub use run::{RecipeRun, run};
pub use text_check::check_text;

use super::{emit, emit_json, table};
use clap::Args;
use file::{MAX_BYTES, Recipe};
use serde_json::{Value, json};
use std::path::Path;
use swm_core::{Error, Origin, Result, files};

/// The recipes of this program: their names and texts.
const SHIPPED: &[(&str, &str)] = &[
    ("ogb-cube/gcbc", include_str!("../../../recipes/ogb-cube/gcbc.toml")),
    ("ogb-cube/lewm", include_str!("../../../recipes/ogb-cube/lewm.toml")),
    ("push-t/dino-wm", include_str!("../../../recipes/push-t/dino-wm.toml")),
    ("push-t/gcbc", include_str!("../../../recipes/push-t/gcbc.toml")),
    ("push-t/gciql", include_str!("../../../recipes/push-t/gciql.toml")),
    ("push-t/gcivl", include_str!("../../../recipes/push-t/gcivl.toml")),
    ("push-t/lewm", include_str!("../../../recipes/push-t/lewm.toml")),
    ("push-t/pldm", include_str!("../../../recipes/push-t/pldm.toml")),
    ("reacher/lewm", include_str!("../../../recipes/reacher/lewm.toml")),
    ("two-room/lewm", include_str!("../../../recipes/two-room/lewm.toml")),
    ("two-room/lewm-straight", include_str!("../../../recipes/two-room/lewm-straight.toml")),
    ("two-room/pldm", include_str!("../../../recipes/two-room/pldm.toml")),
];

/// Arguments of `swm recipes`.
#[derive(Args)]
pub struct RecipesArgs {
    /// The recipe to print: a name, or the path of a TOML file
    recipe: Option<String>,
}

/// Lists the recipes, or prints one.
pub fn recipes(args: &RecipesArgs, as_json: bool) -> anyhow::Result<()> {
    if let Some(given) = &args.recipe {
        let (text, _) = text(given, false)?;
        let recipe = Recipe::parse(given, &text)?;
        if as_json {
            return emit_json(&recipe);
        }
        emit(&text);
        return Ok(());
    }
    let parsed = SHIPPED.iter().map(|(name, text)| Ok((*name, Recipe::parse(name, text)?)));
    let parsed: Vec<(&str, Recipe)> = parsed.collect::<Result<_>>()?;
    if as_json {
        let rows: Vec<Value> = parsed.iter().map(|(name, recipe)| json!({"name": name, "recipe": recipe})).collect();
        return emit_json(&rows);
    }
    let rows = parsed.iter().map(|(name, recipe)| {
        let steps: Vec<&str> = recipe.steps().map(|(_, step)| step.name.as_str()).collect();
        vec![(*name).to_owned(), recipe.summary.clone(), steps.join(", ")]
    });
    emit(&table(&["recipe", "summary", "steps"], rows));
    Ok(())
}

/// Returns the text of a recipe, given as a name or as the path of a TOML file, and who chose the names in it.
fn text(given: &str, trust: bool) -> Result<(String, Origin)> {
    if let Some((_, text)) = SHIPPED.iter().find(|(name, _)| *name == given) {
        return Ok(((*text).to_owned(), Origin::User));
    }
    let path = Path::new(given);
    if path.extension().is_none_or(|end| end != "toml") {
        let known = SHIPPED.iter().map(|(name, _)| *name);
        return Err(Error::unknown("recipe", given, known, "`swm recipes` lists them; a path ends with .toml"));
    }
    let text = String::from_utf8(files::read(path, MAX_BYTES)?);
    let text = text.map_err(|error| Error::corrupt(path, error.to_string(), "give a TOML file"))?;
    Ok((text, Origin::file(path, trust)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    #[test]
    fn every_recipe_of_the_repository_is_shipped_and_valid() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("recipes");
        let mut folders: Vec<PathBuf> = vec![root.clone()];
        let mut found = vec![];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
                let path = entry.path();
                match path.is_dir() {
                    true => folders.push(path),
                    false => {
                        found.push(path.strip_prefix(&root).expect("a path").with_extension("").display().to_string())
                    }
                }
            }
        }
        found.sort();
        let mut shipped: Vec<&str> = SHIPPED.iter().map(|(name, _)| *name).collect();
        shipped.sort_unstable();
        assert_eq!(found, shipped);
        for (name, text) in SHIPPED {
            let recipe = Recipe::parse(name, text).expect(name);
            let columns = run::check(&recipe, Path::new("folder")).expect(name);
            run::check_columns(&recipe, Path::new("folder"), &columns).expect(name);
        }
    }
}
