//! What two rows of a dataset say of how a Gymnasium environment starts, in the words of `Bridge.reset`.
//!
//! Nothing in Gymnasium says how an environment takes a state, so methods of its own are called after the reset: those that
//! the caller names, or those that the bridge found under names that say it. Gymnasium shows nothing after such a call, so the columns
//! show what the row holds; those of the goal (`goal_NAME`) what the goal's row holds, in every step.

use crate::Form;
use serde_json::{Value, json};
use swm_core::columns::{EPISODE_SEED, PIXELS, SEED, flat, flat_factor, goal_source, is_flat_factor, join_seed};
use swm_core::{Callable, CallableArgument, DType, DatasetStart, Error, ResetOptions, Result, RowRef, Schema};

/// The methods to call: those that somebody named, or else those that the environment is known by.
pub fn calls<'a>(form: &'a Form, named: &'a [Callable]) -> Result<&'a [Callable]> {
    let calls = if named.is_empty() { form.calls() } else { named };
    if !calls.is_empty() {
        return Ok(calls);
    }
    Err(Error::config(
        format!("starting {} from a row of a dataset", form.spec.id),
        "nothing says how it takes a state",
        "give it a method `set_state(state)`, or name one of its own, from Python: World.evaluate(callables=[{'method': \
         'set_state', 'args': {'state': {'value': 'state'}}}])",
    ))
}

/// The columns that decide a start, of those a dataset has; an error for an argument that it lacks.
pub fn columns(form: &Form, stored: &Schema, named: &[Callable]) -> Result<Vec<String>> {
    let find = |name: &str| stored.columns().iter().position(|column| flat(&column.name) == name);
    // Pictures are large: none but that of the goal and those that somebody wants.
    let mut wanted: Vec<bool> = stored.columns().iter().map(|column| kept(&flat(&column.name))).collect();
    for call in calls(form, named)? {
        for argument in call.args.values() {
            if let Some(column) = argument_column(argument)? {
                let (_, name) = source(&column);
                let place = find(name).ok_or_else(|| {
                    let known = stored.columns().iter().map(|column| column.name.as_str());
                    let known: Vec<&str> = known.filter(|name| source(name).0 == Whose::Start).collect();
                    let hint = format!(
                        "{}() wants it, and the dataset has {}; with `goal_` before a name it is the goal's",
                        call.method,
                        known.join(", ")
                    );
                    Error::unknown("column", &column, known, hint)
                })?;
                wanted[place] = true;
            }
        }
    }
    for own in &form.spec.columns {
        let name = flat(&own.name);
        if let Some(place) = find(source(&name).1) {
            wanted[place] = true;
        }
    }
    let wanted = stored.columns().iter().zip(wanted).filter(|(_, wanted)| *wanted);
    Ok(wanted.map(|(column, _)| column.name.clone()).collect())
}

/// Whether a column is read whatever the environment shows: its factors, its seed, the picture of the goal.
fn kept(name: &str) -> bool {
    is_flat_factor(name) || [SEED, EPISODE_SEED, PIXELS].contains(&name)
}

/// Of which row a column is.
#[derive(Clone, Copy, PartialEq)]
enum Whose {
    Start,
    Goal,
}

/// Of which row a column is, and its name there.
fn source(name: &str) -> (Whose, &str) {
    goal_source(name).map_or((Whose::Start, name), |name| (Whose::Goal, name))
}

/// The column that an argument names, under its flat name.
fn argument_column(argument: &CallableArgument) -> Result<Option<String>> {
    match (&argument.value, argument.in_dataset) {
        (_, false) => Ok(None),
        (Value::String(name), true) => Ok(Some(flat(name))),
        (other, true) => Err(Error::mismatch(
            "reading callables",
            format!("the value {other} from the dataset"),
            "a column's name; with 'in_dataset': False it is the value itself",
        )),
    }
}

/// What the reset is given: the recorded seed, unless factors are to be sampled from a new one, and the recorded factors.
pub fn reset(form: &Form, seed: u64, options: &ResetOptions, start: RowRef<'_>) -> Result<(u64, ResetOptions)> {
    let mut options = options.clone();
    let samples = options.variation.variation.as_ref().is_some_and(|keys| !keys.is_empty());
    let seed = if samples { seed } else { recorded_seed(start)?.unwrap_or(seed) };
    for factor in form.spec.variation_space.factors() {
        let name = flat_factor(&factor.key);
        if let Some(place) = start.schema().find(&name)
            && start.schema().columns()[place].len() == factor.space.len()
        {
            options.variation.variation_values.insert(factor.key.clone(), start.to_f64(&name)?);
        }
    }
    Ok((seed, options))
}

/// The seed of the recorded episode: a column `seed`, as other programs store it, or ours, three numbers of 21 bits.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn recorded_seed(start: RowRef<'_>) -> Result<Option<u64>> {
    let numbers = |name| start.schema().find(name).map(|_| start.to_f64(name)).transpose();
    if let Some(&[seed]) = numbers(SEED)?.as_deref()
        && seed >= 0.0
    {
        return Ok(Some(seed as u64));
    }
    let elements = numbers(EPISODE_SEED)?.and_then(|elements| <[f64; 3]>::try_from(elements).ok());
    Ok(elements.map(join_seed))
}

/// The methods with their arguments, and what the columns show then.
pub fn json(form: &Form, from: &DatasetStart<'_>) -> Result<Value> {
    let value = |name: &str| {
        let (whose, name) = source(name);
        let row = if whose == Whose::Goal { from.goal } else { from.start };
        row.schema().find(name).map(|place| array(row, place))
    };
    let mut made = vec![];
    for call in calls(form, from.callables)? {
        let mut arguments = serde_json::Map::new();
        for (key, argument) in &call.args {
            let given = match argument_column(argument)? {
                None => argument.value.clone(),
                Some(column) => value(&column).unwrap_or_default(),
            };
            arguments.insert(key.clone(), given);
        }
        made.push(json!({"method": call.method, "args": arguments}));
    }
    let (mut shown, mut held) = (serde_json::Map::new(), serde_json::Map::new());
    for own in &form.spec.columns {
        let name = flat(&own.name);
        let (whose, there) = source(&name);
        let fits =
            from.start.schema().find(there).is_some_and(|at| from.start.schema().columns()[at].len() == own.len());
        if let Some(value) = value(&name).filter(|_| fits) {
            let place = if whose == Whose::Goal { &mut held } else { &mut shown };
            place.insert(own.name.clone(), value);
        }
    }
    Ok(json!({"calls": made, "shown": shown, "held": held}))
}

/// A row's part of a column, to the bit.
fn array(row: RowRef<'_>, place: usize) -> Value {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    let column = &row.schema().columns()[place];
    let digits = row.bytes(place).iter().flat_map(|byte| [byte >> 4, byte & 15]);
    let data: String = digits.map(|digit| char::from(DIGITS[usize::from(digit)])).collect();
    json!({"dtype": column.dtype.name(), "shape": column.shape, "data": data})
}

/// A picture of what is to be reached.
#[derive(Clone, PartialEq)]
pub struct Goal {
    /// Height and width.
    pub size: [usize; 2],
    /// Rows of pixels.
    pub rgb: Vec<u8>,
}

impl Goal {
    /// The picture in the goal's row.
    pub fn of(from: &DatasetStart<'_>) -> Option<Self> {
        let place = from.goal.schema().find(PIXELS)?;
        let column = &from.goal.schema().columns()[place];
        match column.shape[..] {
            [height, width, 3] if column.dtype == DType::U8 => {
                Some(Self { size: [height, width], rgb: from.goal.bytes(place).to_vec() })
            }
            _ => None,
        }
    }
}
