//! Conversion of factor values to and from bytes, and from dataset rows, for the methods `snapshot`, `restore` and
//! `restore_from` of environments.

use crate::{Error, FactorValues, Key, Result, RowRef, Snapshot, VariationRequest, VariationSpace, columns};

/// Returns the request that resolves to exactly `values`.
///
/// Only values that differ from their defaults are pinned, because [`VariationSpace::resolve`] checks constraints on
/// pinned factors and does not check defaults.
pub fn pin(values: &FactorValues) -> VariationRequest {
    let changed = values.factors().iter().zip(values.iter()).filter(|(factor, (_, value))| factor.init_value != *value);
    VariationRequest {
        variation: Some(vec![]),
        variation_values: changed.map(|(_, (key, value))| (key.to_owned(), value.to_vec())).collect(),
    }
}

/// The factor values of a dataset row. A factor without a column keeps its value in `current`.
///
/// # Errors
/// When a column holds a value outside its factor's space.
pub fn from_row(space: &VariationSpace, current: &FactorValues, row: RowRef<'_>) -> Result<FactorValues> {
    let mut request = pin(current);
    for factor in space.factors() {
        let name = columns::flat_factor(&factor.key);
        if row.schema().find(&name).is_some() {
            let value = row.to_f64(&name)?;
            if value.len() != factor.space.len() {
                // The error of a value of another length.
                factor.space.check(&factor.key, &value)?;
            }
            let rounded = value.iter().enumerate().map(|(i, &v)| clamp_rounded(v, factor.space.bounds(i)));
            let value: Vec<f64> = rounded.collect();
            if value == factor.init_value {
                request.variation_values.remove(&factor.key);
            } else {
                request.variation_values.insert(factor.key.clone(), value);
            }
        }
    }
    space.resolve(&request, Key::new(0))
}

/// Clamps a value that rounding to single precision moved just outside its bounds.
fn clamp_rounded(value: f64, (low, high): (f64, f64)) -> f64 {
    let tolerance = f64::from(f32::EPSILON) * low.abs().max(high.abs());
    if value >= low - tolerance && value <= high + tolerance { value.clamp(low, high) } else { value }
}

/// Appends every value, in sampling order, to `bytes`.
fn write(values: &FactorValues, bytes: &mut Vec<u8>) {
    for (_, value) in values.iter() {
        bytes.extend(value.iter().flat_map(|v| v.to_le_bytes()));
    }
}

/// The number of bytes that [`write`] appends.
fn byte_len(space: &VariationSpace) -> usize {
    space.factors().iter().map(|factor| factor.space.len() * size_of::<f64>()).sum()
}

/// A snapshot of an environment's id, factor values, and state bytes.
pub fn snapshot(id: &str, values: &FactorValues, state: impl IntoIterator<Item = u8>) -> Snapshot {
    let mut bytes = id.as_bytes().to_vec();
    write(values, &mut bytes);
    bytes.extend(state);
    Snapshot(bytes)
}

/// Parses a [`snapshot`] into its factor values, `None` if they equal `current`, and its state bytes.
///
/// # Errors
/// When the snapshot is of another environment, too short, or holds invalid values.
pub fn parse_snapshot<'a>(
    id: &str,
    space: &VariationSpace,
    current: &FactorValues,
    snapshot: &'a Snapshot,
) -> Result<(Option<FactorValues>, &'a [u8])> {
    match snapshot.0.strip_prefix(id.as_bytes()) {
        Some(body) => read_changed(space, current, body),
        None => Err(wrong_snapshot(id, "a snapshot of another environment")),
    }
}

/// The error for a snapshot that was not made by the environment `id`.
pub fn wrong_snapshot(id: &str, given: impl Into<String>) -> Error {
    Error::mismatch("restoring a snapshot", given, format!("one of {id}"))
}

/// As [`read`], but returns `None` if the values equal `current`. A planner that simulates restores states of one
/// episode thousands of times, and comparing bytes is much faster than resolving the factors again.
///
/// # Errors
/// As [`read`].
fn read_changed<'a>(
    space: &VariationSpace,
    current: &FactorValues,
    bytes: &'a [u8],
) -> Result<(Option<FactorValues>, &'a [u8])> {
    let elements = current.iter().flat_map(|(_, value)| value);
    let unchanged = bytes
        .split_at_checked(byte_len(space))
        .filter(|(head, _)| head.as_chunks().0.iter().copied().eq(elements.map(|element| element.to_le_bytes())));
    match unchanged {
        Some((_, rest)) => Ok((None, rest)),
        None => read(space, bytes).map(|(values, rest)| (Some(values), rest)),
    }
}

/// Parses the values that [`write`] wrote, and returns the values and the bytes after the values.
///
/// # Errors
/// When there are too few bytes, or a value is outside its factor's space.
fn read<'a>(space: &VariationSpace, bytes: &'a [u8]) -> Result<(FactorValues, &'a [u8])> {
    let Some((mut head, rest)) = bytes.split_at_checked(byte_len(space)) else {
        let (given, expected) = (format!("{} bytes", bytes.len()), format!("at least {}", byte_len(space)));
        return Err(Error::mismatch("restoring the factors of a snapshot", given, expected));
    };
    let mut request = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
    for factor in space.factors() {
        let (own, next) = head.split_at(factor.space.len() * size_of::<f64>());
        let value: Vec<f64> = own.as_chunks().0.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect();
        if value != factor.init_value {
            request.variation_values.insert(factor.key.clone(), value);
        }
        head = next;
    }
    Ok((space.resolve(&request, Key::new(0))?, rest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Batch, ColumnSpec, DType, Factor, Schema, Space};

    #[test]
    fn recorded_columns_of_another_length_than_the_factor_are_errors() {
        let size = Space::uniform_box([2], DType::Float32, 0.0, 1.0);
        let space = VariationSpace::new(vec![Factor::new("agent.size", size, [0.25, 0.75])], &[]);
        let request = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let current = space.resolve(&request, Key::new(0)).expect("the defaults");
        let restored = |length: usize| {
            let column = ColumnSpec::new(columns::flat_factor("agent.size"), DType::Float32, [length]);
            let mut batch = Batch::zeros(&Schema::new([column]).expect("a schema"), 1);
            batch.row_mut(0).at::<f32>(0).fill(0.5);
            from_row(&space, &current, batch.row(0))
        };
        assert_eq!(restored(2).expect("a value of the factor").get("agent.size"), [0.5, 0.5]);
        for length in [1, 3] {
            let error = restored(length).expect_err("another length").to_string();
            assert!(error.contains("agent.size") && error.contains(&format!("{:?}", vec![0.5; length])), "{error}");
        }
    }
}
