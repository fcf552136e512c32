//! Checks of settings and of the inputs of planning costs, which several model families share.

use crate::pixels;
use crate::train::{check_sizes, limits};
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{Candidates, Error, Result, Schema};

/// Checks that dropout rates are at least 0 and below 1.
///
/// # Errors
/// When a rate is out of range; the error names the first such rate.
pub(crate) fn dropout_rates(rates: &[(&str, f32)]) -> Result<()> {
    match rates.iter().find(|(_, rate)| !(0.0..1.0).contains(rate)) {
        Some((name, rate)) => Err(Error::config(*name, rate.to_string(), "give a probability below 1")),
        None => Ok(()),
    }
}

/// Checks that weights of losses are finite and at least 0.
///
/// # Errors
/// When a weight is negative or not finite; the error names the first such weight.
pub(crate) fn loss_weights(weights: &[(&str, f32)]) -> Result<()> {
    match weights.iter().find(|(_, weight)| !(weight.is_finite() && *weight >= 0.0)) {
        Some((name, weight)) => Err(Error::config(*name, weight.to_string(), "give a number of at least 0")),
        None => Ok(()),
    }
}

/// Checks that the means of pixels, which are 0 to 1, are near them, and that the standard deviations are positive.
///
/// # Errors
/// When a mean is beyond 100 or a standard deviation is not positive.
pub(crate) fn pixel_normalization(mean: [f32; 3], std: [f32; 3]) -> Result<()> {
    if !mean.iter().all(|mean| mean.abs() <= 100.0) {
        return Err(Error::config(
            "model.pixel_mean",
            format!("{mean:?}"),
            "give three values of pixels, which are 0 to 1",
        ));
    }
    if std.iter().any(|std| *std <= 0.0) {
        return Err(Error::config("model.pixel_std", format!("{std:?}"), "give three positive values"));
    }
    Ok(())
}

/// Checks that clips of `num_steps` frames contain a window of `history` frames and the frame after the window.
///
/// # Errors
/// When `num_steps` is below `history + 1` or below 2.
pub(crate) fn clip_covers_history(num_steps: usize, history: usize) -> Result<()> {
    check_sizes(&[("data.num_steps", num_steps, 2, limits::FRAMES)])?;
    if num_steps - 1 < history {
        return Err(Error::config(
            "data.num_steps",
            format!("{num_steps} frames train only {} of the {history} steps of history", num_steps - 1),
            format!("give at least {}, or lower model.predictor.history", history + 1),
        ));
    }
    Ok(())
}

/// Checks the image columns that a planning cost reads: `pixels`, `goal` and, if present, the recorded history, whose
/// actions have `action_dim` elements.
///
/// # Errors
/// When a column is missing or has another shape.
pub(crate) fn planning_images(schema: &Schema, side: usize, action_dim: usize) -> Result<()> {
    pixels::check(side, schema, PIXELS)?;
    pixels::check(side, schema, GOAL)?;
    if schema.find("history.length").is_none() {
        return Ok(());
    }
    let past = schema.column("history.action")?.shape.first().copied().unwrap_or(0);
    let expected = [("history.action", vec![past, action_dim]), ("history.pixels", vec![past, side, side, 3])];
    for (name, expected) in expected {
        column_shape(schema, name, &expected)?;
    }
    Ok(())
}

/// Checks the shape of a column.
///
/// # Errors
/// When the column is missing or has another shape.
pub(crate) fn column_shape(schema: &Schema, name: &str, expected: &[usize]) -> Result<()> {
    let given = &schema.column(name)?.shape;
    if given == expected {
        return Ok(());
    }
    Err(Error::mismatch(
        format!("reading '{name}'"),
        format!("shape {given:?}"),
        format!("{expected:?}, as the model was trained"),
    ))
}

/// Checks that candidates and costs fit `envs` observed environments and actions of `action_dim` elements per model
/// step.
///
/// # Errors
/// When the number of environments, of action elements or of costs differs.
pub(crate) fn candidate_sizes(
    what: &str,
    candidates: &Candidates<'_>,
    costs: &[f32],
    [envs, action_dim]: [usize; 2],
) -> Result<()> {
    let given = [candidates.envs, candidates.dim, costs.len()];
    let expected = [envs, action_dim, candidates.envs * candidates.samples];
    if given == expected {
        return Ok(());
    }
    let describe = |[envs, dim, costs]: [usize; 3]| {
        format!("{envs} environments, {dim} action elements a model step, {costs} costs")
    };
    Err(Error::mismatch(what, describe(given), describe(expected)))
}
