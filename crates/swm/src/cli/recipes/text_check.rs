//! [`check_text`]: what is known of a recipe by its text alone.

use super::file::{Kind, Recipe, parse};
use crate::cli::collect::CollectArgs;
use crate::cli::eval::EvalArgs;
use crate::cli::train::TrainArgs;
use crate::resolver::HomeResolver;
use std::path::Path;
use swm_core::{Origin, Result};

/// Checks a recipe that a stranger may have written; `what` names it in errors. Makes no environment but those of the crate
/// `swm-envs`, and reads no other file.
///
/// # Errors
/// When the text is not a recipe, names what only the user may name, or has an unknown or invalid option.
pub fn check_text(what: &str, text: &str) -> Result<()> {
    let recipe = Recipe::parse(what, text)?;
    let origin = Origin::file(what, false);
    recipe.check_origin(&origin)?;
    let resolver = HomeResolver::new(origin);
    for (kind, step) in recipe.steps() {
        let arguments = recipe.arguments(kind, step, Path::new("folder"));
        match kind {
            Kind::Collect => drop(parse::<CollectArgs>(kind, step, &arguments)?),
            Kind::Train => drop(parse::<TrainArgs>(kind, step, &arguments)?.config()?),
            Kind::Eval => parse::<EvalArgs>(kind, step, &arguments)?.check_options(&resolver)?,
        }
    }
    Ok(())
}
