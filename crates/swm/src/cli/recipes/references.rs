//! [`check`]: whether the outputs that a step of a recipe uses are made before it.

use super::file::{Kind, REFERENCES, Recipe, Step, flat, texts};
use swm_models::FAMILIES;
use toml::Value;

/// A reference to a step that has no such output, or not yet.
pub struct Wrong {
    /// What is wrong.
    pub problem: String,
    /// What to do.
    pub fix: String,
}

/// Checks the options and settings of a step that name steps.
///
/// # Errors
/// When one names a step that has no such output, or not yet; says which.
pub fn check(recipe: &Recipe, kind: Kind, step: &Step) -> Result<(), Wrong> {
    for (key, value) in step.options.iter().filter(|(key, _)| REFERENCES.contains(&key.as_str())) {
        for name in texts(value) {
            check_one(recipe, (kind, step), key, |other| other.name == name)?;
        }
    }
    for (key, value) in flat(&step.settings).iter().filter(|(key, _)| key.rsplit('.').next() == Some("weights")) {
        check_one(recipe, (kind, step), key, |other| Value::from(other.name.as_str()).to_string() == *value)?;
    }
    Ok(())
}

/// Checks that the step that an option names, if it is one, runs before `step` and has an output for this option.
fn check_one(
    recipe: &Recipe,
    (kind, step): (Kind, &Step),
    key: &str,
    is_named: impl Fn(&Step) -> bool,
) -> Result<(), Wrong> {
    let named = recipe.steps().enumerate().find(|(_, (_, other))| is_named(other));
    let Some((index, (made, other))) = named else { return Ok(()) };
    let (wanted, output) = match key {
        "data" | "dataset" => (Kind::Collect, "dataset"),
        _ => (Kind::Train, "training"),
    };
    let problem = if other.name == step.name {
        "which is the step itself".to_owned()
    } else if kind == Kind::Collect {
        "and datasets are collected before any model is trained".to_owned()
    } else if made != wanted {
        format!("which is a step of [[{}]], and no {output}", made.name())
    } else if recipe.steps().skip(index).any(|(_, later)| later.name == step.name) {
        let trained = family(other);
        match FAMILIES.rows.iter().find(|row| row.id == family(step)).and_then(|row| row.borrows_encoder) {
            Some(lends) if key == "encoder" && trained != lends => {
                format!("which trains '{trained}', and an encoder is one of '{lends}'")
            }
            _ => return Ok(()),
        }
    } else {
        "which runs after it".to_owned()
    };
    let name = &other.name;
    Err(Wrong {
        problem: format!("'{key}' names the step '{name}', {problem}"),
        fix: format!("name an earlier step; write ./{name}, if a path is meant; or rename that step"),
    })
}

/// Returns the family that a step trains.
fn family(step: &Step) -> &str {
    step.options.get("model").and_then(Value::as_str).unwrap_or_default()
}
