//! [`Scale`]: standardisation of columns to mean 0 and standard deviation 1, for the networks of probes.

use super::ridge::mean_and_std;

/// The mean and the standard deviation of every column of a table.
pub(super) struct Scale {
    mean: Vec<f64>,
    std: Vec<f64>,
}

impl Scale {
    /// Computes the scale of a table `[rows, width]`; a constant column is centred only.
    pub fn of(table: &[f32], rows: usize) -> Self {
        let (mean, std) = mean_and_std(table, rows);
        Self { mean, std: std.into_iter().map(|s| if s > 0.0 { s } else { 1.0 }).collect() }
    }

    /// Returns the number of columns.
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// Standardises a table.
    ///
    /// # Shapes
    /// Maps `[rows, width]` to the same shape.
    pub fn apply(&self, table: &[f32]) -> Vec<f32> {
        let width = self.width();
        let scaled = |(i, &v): (usize, &f32)| ((f64::from(v) - self.mean[i % width]) / self.std[i % width]) as f32;
        table.iter().enumerate().map(scaled).collect()
    }

    /// Converts a standardised table back to the units of the columns.
    ///
    /// # Shapes
    /// Maps `[rows, width]` to the same shape.
    pub fn undo(&self, table: &mut [f32]) {
        let width = self.width();
        for (i, v) in table.iter_mut().enumerate() {
            *v = (f64::from(*v) * self.std[i % width] + self.mean[i % width]) as f32;
        }
    }
}
