//! [`reset_arguments`]: the seed and options of a reset as the JSON that `Bridge.reset` takes.

use crate::EnvLayout;
use serde_json::{Value, json};
use swm_core::{Error, ResetOptions, Result, VariationRequest};

/// Returns the arguments of a reset as JSON.
///
/// # Errors
/// When the options set a state, or name factors or values that the environment does not have.
pub fn reset_arguments(layout: &EnvLayout, seed: u64, options: &ResetOptions) -> Result<Value> {
    let id = &layout.spec.id;
    if options.state.is_some() || options.goal_state.is_some() {
        return Err(Error::config(
            format!("{id}, the state of a reset"),
            "the seed decides the initial state of a Gymnasium environment",
            "choose the initial state by the seed, or by factors of variation if the environment has any",
        ));
    }
    let space = &layout.spec.variation_space;
    let VariationRequest { variation, variation_values } = &options.variation;
    let requested = !variation_values.is_empty() || variation.as_ref().is_some_and(|keys| !keys.is_empty());
    if requested && space.factors().is_empty() {
        let problem = "there are none: neither the environment nor a wrapper has a `variation_space`";
        return Err(Error::config(format!("factors of variation of {id}"), problem, "request no factors"));
    }
    let mut arguments = json!({"seed": fold_seed(seed)});
    if layout.is_native() {
        arguments["native_seed"] = json!(seed);
    }
    if let Some(keys) = variation {
        for key in keys {
            space.select(key)?;
        }
        let all = keys.iter().any(|key| key == "all");
        arguments["variation"] = if all { json!(["all"]) } else { json!(keys) };
    }
    if !variation_values.is_empty() {
        for (key, value) in variation_values {
            let known = space.factors().iter().map(|factor| factor.key.as_str());
            let Some(index) = space.find(key) else {
                return Err(Error::unknown("factor of variation", key, known, "`swm fovs ENV` lists them"));
            };
            space.factors()[index].space.check(key, value)?;
        }
        arguments["variation_values"] = json!(variation_values);
    }
    Ok(arguments)
}

/// Folds a seed to the 31 bits that libraries of Gymnasium environments accept; smaller seeds are unchanged.
fn fold_seed(seed: u64) -> u64 {
    const BITS: u64 = (1 << 31) - 1;
    if seed <= BITS { seed } else { (seed ^ (seed >> 31) ^ (seed >> 62)) & BITS }
}
