//! Starts of Gymnasium environments at dataset rows: the arguments of `Bridge.reset`.
//!
//! Gymnasium has no interface for setting a state, so methods of the environment are called after the reset: methods
//! that the caller names, or methods that the bridge found by their names. These methods return no observation, so the
//! columns take the values of the start row until the next step. Columns of the goal (`goal_NAME`) take the values of
//! the goal row in the whole episode; where the goal row has none of their shape, those of the environment's `_get_info()`, and
//! NaN until the next step if it has no such method. If a method is given values of the goal row, `desired_goal` of Gymnasium's goal
//! environments takes the `achieved_goal` of that row until the next step, and a vector `info["goal"]` is that of `_get_info()`, or NaN.

use crate::EnvLayout;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};
use swm_core::columns::{EPISODE_SEED, PIXELS, SEED, flat, flat_factor, goal_source, is_flat_factor, join_seed};
use swm_core::{Callable, CallableArgument, DType, DatasetStart, Error, ResetOptions, Result, RowRef, Schema};

/// The names of the methods that the callers of this process have named. A snapshot may call only these and the methods
/// of the environment's description, because a snapshot may come from a file.
static NAMED_METHODS: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// Checks that the arguments of a reset, which come from a snapshot, call no other methods than the environment or a
/// caller in this process has named.
pub fn check_methods(layout: &EnvLayout, arguments: &str) -> Result<()> {
    let parsed: Value = serde_json::from_str(arguments).unwrap_or_default();
    let known = NAMED_METHODS.lock().unwrap_or_else(PoisonError::into_inner);
    for call in parsed["recorded"]["calls"].as_array().into_iter().flatten() {
        let method = call["method"].as_str().unwrap_or_default();
        if !known.contains(method) && !layout.callables().iter().any(|own| own.method == method) {
            return Err(Error::config(
                format!("restoring a snapshot of {}", layout.spec.id),
                format!("it calls the method '{method}', which sets no state here"),
                "restore snapshots of this process, or start an episode with this method in `callables` first",
            ));
        }
    }
    Ok(())
}

/// Returns the methods to call: `named`, or else the methods in the environment's description.
pub fn callables<'a>(layout: &'a EnvLayout, named: &'a [Callable]) -> Result<&'a [Callable]> {
    let callables = if named.is_empty() { layout.callables() } else { named };
    if !callables.is_empty() {
        return Ok(callables);
    }
    Err(Error::config(
        format!("starting {} from a row of a dataset", layout.spec.id),
        "the environment has no method known to set a state",
        "give it a method `set_state(state)`, or name one of its methods in Python: \
         World.evaluate(callables=[{'method': 'set_state', 'args': {'state': {'value': 'state'}}}])",
    ))
}

/// The columns of a dataset that a start reads.
///
/// # Errors
/// When the dataset lacks a column that an argument names.
pub fn columns(layout: &EnvLayout, stored: &Schema, named: &[Callable]) -> Result<Vec<String>> {
    let find = |name: &str| stored.columns().iter().position(|column| flat(&column.name) == name);
    // Images are large, so only the column of frames and the images that arguments name are read.
    let mut read: Vec<bool> = stored.columns().iter().map(|column| is_always_read(&flat(&column.name))).collect();
    for call in callables(layout, named)? {
        for argument in call.args.values() {
            if let Some(column) = argument_column(argument)? {
                let (_, name) = source(&column);
                let index = find(name).ok_or_else(|| {
                    let known = stored.columns().iter().map(|column| column.name.as_str());
                    let known: Vec<&str> = known.filter(|name| source(name).0 == Source::Start).collect();
                    let hint = format!(
                        "an argument of {}() names it, but the columns of the dataset are {}; the prefix `goal_` \
                         denotes the value at the goal",
                        call.method,
                        known.join(", ")
                    );
                    Error::unknown("column", &column, known, hint)
                })?;
                read[index] = true;
            }
        }
    }
    for own in &layout.spec.columns {
        let name = flat(&own.name);
        for index in [find(source(&name).1), achieved(&name).and_then(|name| find(&name))].into_iter().flatten() {
            read[index] = true;
        }
    }
    let read = stored.columns().iter().zip(read).filter(|(_, read)| *read);
    Ok(read.map(|(column, _)| column.name.clone()).collect())
}

/// Whether a column is read for every environment: factors, the seed, the frame.
fn is_always_read(name: &str) -> bool {
    is_flat_factor(name) || [SEED, EPISODE_SEED, PIXELS].contains(&name)
}

/// The row that a column is read from.
#[derive(Clone, Copy, PartialEq)]
enum Source {
    Start,
    Goal,
}

/// The column of a vector `info["goal"]`.
const INFO_GOAL: &str = "info_goal";

/// The row that a column is read from, and the column's name in that row.
fn source(name: &str) -> (Source, &str) {
    goal_source(name).map_or((Source::Start, name), |name| (Source::Goal, name))
}

/// The column that says what a goal environment of Gymnasium has achieved, for its column `desired_goal`; `None` for others.
fn achieved(name: &str) -> Option<String> {
    let outer = name.strip_suffix("desired_goal")?;
    (outer.is_empty() || outer.ends_with('_')).then(|| format!("{outer}achieved_goal"))
}

/// The flat name of the column that an argument names; `None` for a literal value.
fn argument_column(argument: &CallableArgument) -> Result<Option<String>> {
    match (&argument.value, argument.in_dataset) {
        (_, false) => Ok(None),
        (Value::String(name), true) => Ok(Some(flat(name))),
        (other, true) => Err(Error::mismatch(
            "reading callables",
            format!("the value {other} from the dataset"),
            "a column's name; with 'in_dataset': False, any value, which is passed unchanged",
        )),
    }
}

/// The seed and options of the reset: the recorded seed, unless factors are to be sampled, and the recorded factors.
pub fn reset(layout: &EnvLayout, seed: u64, options: &ResetOptions, start: RowRef<'_>) -> Result<(u64, ResetOptions)> {
    let mut options = options.clone();
    let samples = options.variation.variation.as_ref().is_some_and(|keys| !keys.is_empty());
    let seed = if samples { seed } else { recorded_seed(start)?.unwrap_or(seed) };
    for factor in layout.spec.variation_space.factors() {
        let name = flat_factor(&factor.key);
        if let Some(index) = start.schema().find(&name)
            && start.schema().columns()[index].len() == factor.space.len()
        {
            options.variation.variation_values.insert(factor.key.clone(), start.to_f64(&name)?);
        }
    }
    Ok((seed, options))
}

/// The seed of the recorded episode, from the column `seed`, which other programs write, or from `episode_seed`.
fn recorded_seed(start: RowRef<'_>) -> Result<Option<u64>> {
    let values = |name| start.schema().find(name).map(|_| start.to_f64(name)).transpose();
    if let Some(&[seed]) = values(SEED)?.as_deref()
        && seed >= 0.0
    {
        return Ok(Some(seed as u64));
    }
    let elements = values(EPISODE_SEED)?.and_then(|elements| <[f64; 3]>::try_from(elements).ok());
    Ok(elements.map(join_seed))
}

/// The argument `recorded` of `Bridge.reset`: the methods with their arguments, and the recorded values that the
/// columns take after the methods ran.
pub fn json(layout: &EnvLayout, from: &DatasetStart<'_>) -> Result<Value> {
    let value = |name: &str| {
        let (row_of, name) = source(name);
        let row = if row_of == Source::Goal { from.goal } else { from.start };
        row.schema().find(name).map(|index| array(row, index))
    };
    let (mut made, mut sets_goal) = (vec![], false);
    let mut named = NAMED_METHODS.lock().unwrap_or_else(PoisonError::into_inner);
    for call in callables(layout, from.callables)? {
        if !named.contains(&call.method) {
            named.insert(call.method.clone());
        }
        let mut arguments = serde_json::Map::new();
        for (key, argument) in &call.args {
            let given = match argument_column(argument)? {
                None => argument.value.clone(),
                Some(column) => {
                    sets_goal |= source(&column).0 == Source::Goal;
                    value(&column).unwrap_or_default()
                }
            };
            arguments.insert(key.clone(), given);
        }
        made.push(json!({"method": call.method, "args": arguments}));
    }
    let (mut shown, mut held) = (serde_json::Map::new(), serde_json::Map::new());
    // Columns of the goal that have another shape in the dataset: their values of the reset are of another goal.
    let mut unknown = vec![];
    for own in &layout.spec.columns {
        let name = flat(&own.name);
        let (row_of, column) = source(&name);
        let stored = from.start.schema().find(column).map(|at| &from.start.schema().columns()[at]);
        let fits = stored.is_some_and(|stored| stored.len() == own.len());
        // What the environment itself calls its goal, if a method has just set another.
        if sets_goal && name == INFO_GOAL {
            unknown.push(&own.name);
            continue;
        }
        let reached = achieved(&name).filter(|_| sets_goal).and_then(|name| {
            let index = from.goal.schema().find(&name)?;
            (from.goal.schema().columns()[index].len() == own.len()).then(|| array(from.goal, index))
        });
        if let Some(value) = reached {
            shown.insert(own.name.clone(), value);
            continue;
        }
        match value(&name).filter(|_| fits) {
            Some(value) if row_of == Source::Goal => _ = held.insert(own.name.clone(), value),
            Some(value) => _ = shown.insert(own.name.clone(), value),
            None if row_of == Source::Goal && (stored.is_some() || layout.is_native()) => unknown.push(&own.name),
            None => {}
        }
    }
    Ok(json!({"calls": made, "shown": shown, "held": held, "unknown": unknown}))
}

/// The value of a column in a row as hexadecimal bytes, which preserve every bit.
fn array(row: RowRef<'_>, index: usize) -> Value {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    let column = &row.schema().columns()[index];
    let digits = row.bytes(index).iter().flat_map(|byte| [byte >> 4, byte & 15]);
    let data: String = digits.map(|digit| char::from(DIGITS[usize::from(digit)])).collect();
    json!({"dtype": column.dtype.name(), "shape": column.shape, "data": data})
}

/// The frame that shows the goal of an episode.
#[derive(Clone, PartialEq)]
pub struct GoalFrame {
    /// Height and width in pixels.
    pub size: [usize; 2],
    /// The pixels, `[height, width, 3]`.
    pub rgb: Vec<u8>,
}

impl GoalFrame {
    /// The frame in the goal's row, if it has one.
    pub fn of(from: &DatasetStart<'_>) -> Option<Self> {
        let index = from.goal.schema().find(PIXELS)?;
        let column = &from.goal.schema().columns()[index];
        match column.shape[..] {
            [height, width, 3] if column.dtype == DType::U8 => {
                Some(Self { size: [height, width], rgb: from.goal.bytes(index).to_vec() })
            }
            _ => None,
        }
    }
}
