//! [`Targets`]: the values that a probe predicts. An angle is predicted as its sine and its cosine, because equal angles
//! may differ by full turns.

use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};
use swm_data::Reader;

/// A function of an angle that a probe predicts instead of the angle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AnglePart {
    /// The sine.
    Sin,
    /// The cosine.
    Cos,
}

/// A value that a probe predicts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Target {
    /// The column.
    pub column: String,
    /// The index of the element in a row of the column.
    pub index: usize,
    /// The function of the element; `None` for the element itself.
    pub part: Option<AnglePart>,
}

/// The targets of some columns, in the order of the columns.
pub(super) struct Targets {
    pub list: Vec<Target>,
    /// For each target the position of its element in the concatenated columns.
    elements: Vec<usize>,
    /// The number of elements of all columns.
    pub width: usize,
}

impl Targets {
    /// Makes the targets of these columns of a dataset; `angles` lists elements that are angles in radians.
    ///
    /// # Errors
    /// When a column is missing or holds images.
    pub fn new(reader: &dyn Reader, columns: &[String], angles: &[(String, usize)]) -> Result<Self> {
        let mut targets = Self { list: vec![], elements: vec![], width: 0 };
        for name in columns {
            let column = reader.schema().column(name)?;
            if column.is_image() {
                let fix = "name numeric columns; the image probe reconstructs images";
                return Err(Error::config(name, "holds images", fix));
            }
            for index in 0..column.len() {
                let is_angle = angles.iter().any(|(angle, element)| angle == name && *element == index);
                let parts = if is_angle { &[Some(AnglePart::Sin), Some(AnglePart::Cos)][..] } else { &[None] };
                targets.list.extend(parts.iter().map(|&part| Target { column: name.clone(), index, part }));
                targets.elements.extend(parts.iter().map(|_| targets.width));
                targets.width += 1;
            }
        }
        Ok(targets)
    }

    /// Returns the targets of the rows of a table. In a row, the concatenated columns start at `first`.
    ///
    /// # Shapes
    /// Maps `[rows, row_width]` to `[rows, targets]`; `row_width` is at least `first` + [`Targets::width`].
    pub fn of(&self, table: &[f32], row_width: usize, first: usize) -> Vec<f32> {
        let target = |value: f32, part| match part {
            None => value,
            Some(AnglePart::Sin) => value.sin(),
            Some(AnglePart::Cos) => value.cos(),
        };
        let elements = || self.list.iter().zip(&self.elements);
        let of_row = |row: &[f32]| elements().map(|(of, &element)| target(row[first + element], of.part)).collect();
        table.chunks_exact(row_width).flat_map(|row| -> Vec<f32> { of_row(row) }).collect()
    }
}
