//! [`Panels`]: products of rows with a matrix that is laid out once and used often.
//!
//! The matrix is cut into panels of 32 columns, so that a product reads the matrix in order. A tile of the result, some
//! rows of a panel, stays in registers while terms are added to the tile. The result of a row does not depend on the
//! other rows.

use crate::Affine;
use crate::product::{Columns, Rows, Segment, Starts, multiply};

/// The number of elements of a SIMD vector.
pub(crate) const LANES: usize = 16;
/// The number of columns of a panel.
pub(crate) const WIDTH: usize = 2 * LANES;

/// A SIMD vector, whose elements are computed at once.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(crate) struct Lanes(pub [f32; LANES]);

/// The elements of a panel in one row of the matrix.
pub(crate) type Pair = [Lanes; WIDTH / LANES];
const ZERO: Pair = [Lanes([0.0; LANES]); WIDTH / LANES];

/// A matrix `[inputs, outputs]` and a bias, cut into panels.
#[derive(Clone, Debug)]
pub struct Panels {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    /// The elements of each panel, row by row; columns beyond the matrix are 0.
    pub(crate) elements: Vec<Pair>,
    /// The bias of the columns of each panel.
    pub(crate) bias: Vec<Pair>,
}

impl Panels {
    /// Creates a matrix without bias whose elements are `at(input, output)`.
    pub fn new(inputs: usize, outputs: usize, at: impl Fn(usize, usize) -> f32) -> Self {
        let mut panels = Self { inputs, outputs, elements: vec![], bias: vec![ZERO; outputs.div_ceil(WIDTH)] };
        panels.fill(inputs, at);
        panels
    }

    /// Creates the matrix and the bias of a linear layer: `parameters.weight` is `[outputs, inputs]`.
    pub fn linear(parameters: &Affine) -> Self {
        let outputs = parameters.bias.len();
        let inputs = parameters.weight.len() / outputs;
        Self::new(inputs, outputs, |i, o| parameters.weight[o * inputs + i]).with_bias(&parameters.bias)
    }

    /// Returns the matrix with a bias, `[outputs]`.
    #[must_use]
    pub fn with_bias(mut self, bias: &[f32]) -> Self {
        self.set_bias(bias);
        self
    }

    /// Replaces the first elements of the bias, at most `[outputs]`.
    pub(crate) fn set_bias(&mut self, bias: &[f32]) {
        for (column, value) in bias.iter().enumerate() {
            self.bias[column / WIDTH][column % WIDTH / LANES].0[column % LANES] = *value;
        }
    }

    /// Replaces the matrix by a matrix with as many outputs and with elements `at(input, output)`, in the same memory.
    pub fn fill(&mut self, inputs: usize, at: impl Fn(usize, usize) -> f32) {
        self.inputs = inputs;
        self.elements.clear();
        self.elements.resize(self.bias.len() * inputs, ZERO);
        for (index, panel) in self.elements.chunks_exact_mut(inputs.max(1)).enumerate() {
            let first = index * WIDTH;
            for (input, pair) in panel.iter_mut().enumerate() {
                for column in 0..WIDTH.min(self.outputs - first) {
                    pair[column / LANES].0[column % LANES] = at(input, first + column);
                }
            }
        }
    }

    /// Replaces the matrix by the first `inputs` rows of an array, given as a slice and the distance from row to row in
    /// elements.
    ///
    /// # Shapes
    /// `rows` is `[inputs, outputs]` with the given stride.
    pub fn fill_rows(&mut self, inputs: usize, (rows, stride): (&[f32], usize)) {
        self.fill_from(inputs, (rows, stride));
    }

    /// Replaces the matrix by the rows of an array that start at the given indices.
    pub(crate) fn fill_starts(&mut self, rows: &[f32], starts: &[usize]) {
        self.fill_from(starts.len(), (rows, starts));
    }

    /// Changes the number of rows; the elements are any.
    pub(crate) fn resize(&mut self, inputs: usize) {
        self.inputs = inputs;
        self.elements.resize(self.bias.len() * inputs, ZERO);
    }

    fn fill_from(&mut self, inputs: usize, (rows, starts): (&[f32], impl Starts)) {
        self.resize(inputs);
        for (index, panel) in self.elements.chunks_exact_mut(inputs.max(1)).enumerate() {
            let first = index * WIDTH;
            let width = WIDTH.min(self.outputs - first);
            for (input, pair) in panel.iter_mut().enumerate() {
                let row = &rows[starts.of(input) + first..][..width];
                let (whole, part) = row.as_chunks::<LANES>();
                let (filled, rest) = pair.split_at_mut(whole.len());
                filled.iter_mut().zip(whole).for_each(|(lanes, row)| lanes.0 = *row);
                rest.fill(ZERO[0]);
                if let Some(lanes) = rest.first_mut() {
                    lanes.0[..part.len()].copy_from_slice(part);
                }
            }
        }
    }

    /// Returns the number of rows of the matrix.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Returns the number of columns of the matrix.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Computes `y = x W + b`.
    ///
    /// # Shapes
    /// `x` is `[rows, inputs]`, `y` is `[rows, outputs]`.
    pub fn apply(&self, x: &[f32], y: &mut [f32]) {
        self.apply_strided(y.len() / self.outputs, (x, self.inputs), (y, self.outputs));
    }

    /// Computes `y = x W + b` for rows with strides: each array is a slice and the distance from row to row in
    /// elements.
    ///
    /// # Shapes
    /// `x` is `[rows, inputs]`, `y` is `[rows, outputs]`.
    pub fn apply_strided(&self, rows: usize, x: (&[f32], usize), y: (&mut [f32], usize)) {
        let whole = [Segment { offset: 0, length: self.inputs }];
        multiply(rows, Rows { values: x.0, starts: x.1, segments: &whole }, self, y);
    }

    /// Computes `y += xᵀ W + b`, the product in the gradient of weights. Each array is a slice and the distance from
    /// row to row in elements.
    ///
    /// # Shapes
    /// `x` is `[inputs, rows]`, `y` is `[rows, outputs]`.
    pub fn add_transposed(&self, rows: usize, x: (&[f32], usize), y: (&mut [f32], usize)) {
        multiply(rows, Columns { values: x.0, starts: x.1 }, self, y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panel_products_match_the_definition_of_the_matrix_product() {
        let value = |i: usize| (i * 37 % 101) as f32 / 101.0 - 0.5;
        for rows in [1, 2, 5, 12, 31] {
            for (inputs, outputs) in [(1, 1), (3, 5), (17, 16), (40, 33), (64, 80)] {
                let x: Vec<f32> = (0..rows * inputs).map(value).collect();
                let bias: Vec<f32> = (0..outputs).map(|i| value(i + 7)).collect();
                let weight = |i, o| value(i * outputs + o + 3);
                let panels = Panels::new(inputs, outputs, weight).with_bias(&bias);
                let mut y = vec![f32::NAN; rows * outputs];
                panels.apply(&x, &mut y);
                for (index, y) in y.iter().enumerate() {
                    let (row, output) = (index / outputs, index % outputs);
                    let terms = (0..inputs).map(|i| f64::from(x[row * inputs + i]) * f64::from(weight(i, output)));
                    let expected = f64::from(bias[output]) + terms.sum::<f64>();
                    assert!((f64::from(*y) - expected).abs() < 1e-5, "{rows} {inputs} {outputs}: {y} for {expected}");
                }
                // The transposed product adds the same values to the previous result.
                let columns: Vec<f32> = (0..rows * inputs).map(|i| x[i % rows * inputs + i / rows]).collect();
                let mut sum = y.clone();
                panels.add_transposed(rows, (&columns, rows), (&mut sum, outputs));
                assert!(sum.iter().zip(&y).all(|(sum, y)| *sum == 2.0 * y));
                // Filling from rows gives the same matrix.
                let matrix: Vec<f32> = (0..inputs * outputs).map(|i| weight(i / outputs, i % outputs)).collect();
                let mut again = Panels::new(0, outputs, |_, _| 0.0).with_bias(&bias);
                again.fill_rows(inputs, (&matrix, outputs));
                again.apply(&x, &mut sum);
                assert_eq!(sum, y);
                // A row that is computed alone and with a stride has the same bytes as among other rows.
                let mut alone = vec![f32::NAN; outputs + 2];
                panels.apply_strided(1, (&x[(rows - 1) * inputs..], inputs), (&mut alone, outputs + 2));
                assert_eq!(alone[..outputs], y[(rows - 1) * outputs..]);
                assert!(alone[outputs..].iter().all(|value| value.is_nan()));
            }
        }
    }
}
