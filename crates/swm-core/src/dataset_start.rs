//! Starting an episode at a recorded row of a dataset, towards the state of another row.
//!
//! [`reset`] starts any environment in this way, and [`required_columns`] lists the columns that it reads. Both
//! functions use [`DatasetStartEnv`] if the environment implements it, otherwise [`Env::reset`] and
//! [`Env::restore_from`].

use crate::batch::{RowRef, Schema};
use crate::{Env, Error, Key, ResetOptions, Result, columns};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// The most draws of the sampled factors of an episode.
pub const TRIES: u64 = 100;

/// A start and a goal from a dataset: two rows, whose columns have [`columns::flat`] names.
#[derive(Clone, Copy)]
pub struct DatasetStart<'a> {
    /// The row at which the episode starts.
    pub start: RowRef<'a>,
    /// The row whose state is the goal.
    pub goal: RowRef<'a>,
    /// Methods that set the state of a third-party environment; native environments need none.
    pub callables: &'a [Callable],
}

/// A method of a third-party environment, called by name after a reset.
///
/// The layout equals that of the argument `callables` of `World.evaluate` in the Python package `stable-worldmodel`
/// 0.1.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Callable {
    /// The method's name.
    pub method: String,
    /// The method's keyword arguments.
    #[serde(default)]
    pub args: BTreeMap<String, CallableArgument>,
}

/// An argument of a [`Callable`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CallableArgument {
    /// The value itself, or the name of a column: a plain name reads the start row, a name of [`columns::of_goal`]
    /// reads the goal row.
    #[serde(default)]
    pub value: Value,
    /// Whether `value` is the name of a column.
    #[serde(default = "yes")]
    pub in_dataset: bool,
}

fn yes() -> bool {
    true
}

/// An environment that starts episodes at dataset rows without [`Env::restore_from`], for example by
/// calling methods of a Gymnasium environment.
pub trait DatasetStartEnv {
    /// The columns of a dataset that [`DatasetStartEnv::reset_from`] reads.
    ///
    /// # Errors
    /// When the dataset lacks a required column.
    fn required_columns(&self, stored: &Schema, callables: &[Callable]) -> Result<Vec<String>>;

    /// Starts an episode at a row of a dataset. `seed` and `options` set everything that the rows do not contain:
    /// randomness, and factors that are shifted or not recorded.
    ///
    /// # Errors
    /// As [`Env::reset`], and when a row lacks a required column.
    fn reset_from(&mut self, seed: u64, options: &ResetOptions, from: DatasetStart<'_>) -> Result<()>;
}

/// The columns of a dataset that [`reset`] reads: the columns of [`DatasetStartEnv::required_columns`] if the
/// environment implements it, otherwise all columns except images.
///
/// # Errors
/// When the dataset lacks a required column: by default, a `state` of the environment's shape.
pub fn required_columns(env: &dyn Env, stored: &Schema, callables: &[Callable]) -> Result<Vec<String>> {
    if let Some(env) = env.dataset_start() {
        return env.required_columns(stored, callables);
    }
    let (spec, state) = (env.spec(), stored.column(columns::STATE)?);
    if let Some(own) = spec.columns.iter().find(|column| column.name == columns::STATE)
        && own.shape != state.shape
    {
        return Err(Error::mismatch(
            format!("starting {} from a dataset", spec.id),
            format!("states of shape {:?}", state.shape),
            format!("states of shape {:?}; choose a dataset that was collected in this environment", own.shape),
        ));
    }
    let read = stored.columns().iter().filter(|column| !column.is_image());
    Ok(read.map(|column| column.name.clone()).collect())
}

/// Starts an episode at a row of a dataset: by [`DatasetStartEnv::reset_from`] if the environment implements it,
/// otherwise by [`Env::reset`], which sets everything that the rows do not contain, followed by [`Env::restore_from`].
///
/// Sampled factors that contradict the recorded start, such as a wall where the agent stands, are drawn again: they follow
/// their distribution among the values that the start allows.
///
/// # Errors
/// As [`DatasetStartEnv::reset_from`], [`Env::reset`] and [`Env::restore_from`]; also when no sample of [`TRIES`] fits the
/// start.
pub fn reset(env: &mut dyn Env, seed: u64, options: &ResetOptions, from: DatasetStart<'_>) -> Result<()> {
    if let Some(env) = env.dataset_start_mut() {
        return env.reset_from(seed, options, from);
    }
    let samples = options.variation.variation.as_ref().is_some_and(|names| !names.is_empty());
    let mut tries = 0;
    loop {
        let seed =
            if tries == 0 { seed } else { Key::new(seed).with("samples that fit the start").at(tries).seed() >> 1 };
        env.reset(seed, options)?;
        tries += 1;
        match env.restore_from(from.start, from.goal) {
            Err(Error::OutOfSpace { .. }) if samples && tries < TRIES => {}
            restored => return restored,
        }
    }
}
