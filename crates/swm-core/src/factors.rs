//! Factor values as bytes, and out of dataset rows: what every environment's `snapshot`, `restore` and
//! `restore_from` need.

use crate::{Error, FactorValues, Key, Result, RowRef, Snapshot, VariationRequest, VariationSpace, columns};

/// A request that resolves to exactly these values.
///
/// Only what differs from its default is pinned: constraints are checked on pinned factors, and defaults that
/// nobody touched are trusted, at the reset as well as here.
pub fn pin(values: &FactorValues) -> VariationRequest {
    let changed = values.factors().iter().zip(values.iter()).filter(|(factor, (_, value))| factor.init_value != *value);
    VariationRequest {
        variation: Some(vec![]),
        variation_values: changed.map(|(_, (key, value))| (key.to_owned(), value.to_vec())).collect(),
    }
}

/// The factors of a dataset row: those it has a column for, and `current` for the others.
///
/// # Errors
/// When a column holds a value outside its factor's space.
pub fn from_row(space: &VariationSpace, current: &FactorValues, row: RowRef<'_>) -> Result<FactorValues> {
    let mut request = pin(current);
    for factor in space.factors() {
        let name = columns::flat_factor(&factor.key);
        if row.schema().find(&name).is_some() {
            let value: Vec<f64> =
                row.to_f64(&name)?.iter().enumerate().map(|(i, &v)| snapped(v, factor.space.bounds(i))).collect();
            if value == factor.init_value {
                request.variation_values.remove(&factor.key);
            } else {
                request.variation_values.insert(factor.key.clone(), value);
            }
        }
    }
    space.resolve(&request, Key::new(0))
}

/// A value on its way through single precision may end a hair outside its bounds.
fn snapped(value: f64, (low, high): (f64, f64)) -> f64 {
    let hair = f64::from(f32::EPSILON) * low.abs().max(high.abs());
    if value >= low - hair && value <= high + hair { value.clamp(low, high) } else { value }
}

/// Appends every value, in sampling order, to `bytes`.
fn write(values: &FactorValues, bytes: &mut Vec<u8>) {
    for (_, value) in values.iter() {
        bytes.extend(value.iter().flat_map(|v| v.to_le_bytes()));
    }
}

/// Bytes that [`write`] appends for a space.
fn byte_len(space: &VariationSpace) -> usize {
    space.factors().iter().map(|factor| factor.space.len() * size_of::<f64>()).sum()
}

/// A snapshot: the environment's id, its factors, and whatever bytes its state is.
pub fn snapshot(id: &str, values: &FactorValues, state: impl IntoIterator<Item = u8>) -> Snapshot {
    let mut bytes = id.as_bytes().to_vec();
    write(values, &mut bytes);
    bytes.extend(state);
    Snapshot(bytes)
}

/// The factors of a [`snapshot`], `None` where they are the `current` ones, and the bytes of its state.
///
/// # Errors
/// When it is of another environment, too short, or holds impossible values.
pub fn restored<'a>(
    id: &str,
    space: &VariationSpace,
    current: &FactorValues,
    snapshot: &'a Snapshot,
) -> Result<(Option<FactorValues>, &'a [u8])> {
    match snapshot.0.strip_prefix(id.as_bytes()) {
        Some(body) => read_changed(space, current, body),
        None => Err(foreign(id, "a snapshot of another environment")),
    }
}

/// A snapshot that is none of this environment.
pub fn foreign(id: &str, given: impl Into<String>) -> Error {
    Error::mismatch("restoring a snapshot", given, format!("one of {id}"))
}

/// As [`read`], but `None` for the values of `current`. Whoever plans in a simulator restores one episode's states
/// thousands of times: its factors are told apart by their bytes, and neither resolved nor arranged again.
///
/// # Errors
/// As [`read`].
fn read_changed<'a>(
    space: &VariationSpace,
    current: &FactorValues,
    bytes: &'a [u8],
) -> Result<(Option<FactorValues>, &'a [u8])> {
    let numbers = current.iter().flat_map(|(_, value)| value);
    let known = bytes
        .split_at_checked(byte_len(space))
        .filter(|(head, _)| head.as_chunks().0.iter().copied().eq(numbers.map(|number| number.to_le_bytes())));
    match known {
        Some((_, rest)) => Ok((None, rest)),
        None => read(space, bytes).map(|(values, rest)| (Some(values), rest)),
    }
}

/// The values [`write`] wrote, and the bytes behind them.
///
/// # Errors
/// When there are too few bytes or they hold impossible values.
fn read<'a>(space: &VariationSpace, bytes: &'a [u8]) -> Result<(FactorValues, &'a [u8])> {
    let Some((mut head, rest)) = bytes.split_at_checked(byte_len(space)) else {
        let (given, expected) = (format!("{} bytes", bytes.len()), format!("at least {}", byte_len(space)));
        return Err(Error::mismatch("restoring the factors of a snapshot", given, expected));
    };
    let mut request = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
    for factor in space.factors() {
        let (own, next) = head.split_at(factor.space.len() * size_of::<f64>());
        let numbers = own.as_chunks().0.iter();
        let value: Vec<f64> = numbers.map(|&number| f64::from_le_bytes(number)).collect();
        if value != factor.init_value {
            request.variation_values.insert(factor.key.clone(), value);
        }
        head = next;
    }
    Ok((space.resolve(&request, Key::new(0))?, rest))
}
