//! Positions of agents and goals: single precision in environments, double precision where paths are planned.

use swm_core::{Result, RowRef};

/// A position in single precision, the precision of the reference: x, y in the environment's unit of length.
pub type Position = [f32; 2];

/// A position in double precision, for path planning: x, y in the environment's unit of length.
pub type Position64 = [f64; 2];

/// Rounds the first two values of a factor or of a `state` column to a [`Position`].
pub fn position(values: &[f64]) -> Position {
    [values[0] as f32, values[1] as f32]
}

/// Converts a position to double precision.
pub fn widen(position: Position) -> Position64 {
    position.map(f64::from)
}

/// The Euclidean distance between two positions.
pub fn distance64(a: Position64, b: Position64) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Reads a position from a column of a row, such as `state`.
///
/// # Errors
/// When the row has no such column.
pub fn read_position(row: RowRef<'_>, column: &str) -> Result<Position64> {
    let values = row.to_f64(column)?;
    Ok([values[0], values[1]])
}
