//! [`Scale`]: columns of mean 0 and spread 1, which networks are fitted on.

use super::ridge::moments;

/// The mean and the spread of every column of a table.
pub(super) struct Scale {
    mean: Vec<f64>,
    spread: Vec<f64>,
}

impl Scale {
    /// Those of a table; a column that never changes keeps its scale.
    pub fn of(table: &[f32], rows: usize) -> Self {
        let (mean, spread) = moments(table, rows);
        Self { mean, spread: spread.into_iter().map(|s| if s > 1e-12 { s } else { 1.0 }).collect() }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// The table, scaled.
    #[allow(clippy::cast_possible_truncation)]
    pub fn apply(&self, table: &[f32]) -> Vec<f32> {
        let width = self.width();
        let scaled = |(i, &v): (usize, &f32)| ((f64::from(v) - self.mean[i % width]) / self.spread[i % width]) as f32;
        table.iter().enumerate().map(scaled).collect()
    }

    /// A scaled table in its own units again.
    #[allow(clippy::cast_possible_truncation)]
    pub fn undo(&self, table: &mut [f32]) {
        let width = self.width();
        for (i, v) in table.iter_mut().enumerate() {
            *v = (f64::from(*v) * self.spread[i % width] + self.mean[i % width]) as f32;
        }
    }
}
