//! [`multiply`]: products of matrices that are used once, as in training. [`Panels`](crate::Panels) lay out matrices that are used often.

use gemm::{Parallelism, gemm};

/// The number of multiplications from which a product is computed by several threads.
const PARALLEL: usize = 1 << 22;

/// A row-major matrix, or its transpose.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    values: &'a [f32],
    rows: usize,
    columns: usize,
    is_transposed: bool,
}

impl<'a> Matrix<'a> {
    /// Creates a matrix.
    ///
    /// # Shapes
    /// `values` is `[rows, columns]`.
    pub fn new(values: &'a [f32], columns: usize) -> Self {
        let rows = values.len().checked_div(columns).unwrap_or(0);
        assert_eq!(rows * columns, values.len(), "the elements of a matrix with {columns} columns");
        Self { values, rows, columns, is_transposed: false }
    }

    /// Returns the transpose, without moving an element.
    #[must_use]
    pub fn transposed(self) -> Self {
        Self { rows: self.columns, columns: self.rows, is_transposed: !self.is_transposed, ..self }
    }

    /// The distances between neighbours in a row and in a column, in elements.
    fn strides(&self) -> (isize, isize) {
        if self.is_transposed { (self.rows as isize, 1) } else { (1, self.columns as isize) }
    }
}

/// Returns the product of two matrices, row-major. It is the same on any number of threads.
///
/// # Panics
/// If `lhs` does not have as many columns as `rhs` has rows.
pub fn multiply(lhs: Matrix<'_>, rhs: Matrix<'_>) -> Vec<f32> {
    assert_eq!(lhs.columns, rhs.rows, "the inner sides of a product");
    let (rows, columns, inner) = (lhs.rows, rhs.columns, lhs.columns);
    let is_large = rows * columns * inner >= PARALLEL;
    let parallelism = if is_large { Parallelism::Rayon(0) } else { Parallelism::None };
    let ((lhs_cs, lhs_rs), (rhs_cs, rhs_rs)) = (lhs.strides(), rhs.strides());
    let mut product = Vec::with_capacity(rows * columns);
    // SAFETY: the matrices have as many elements as their sides and strides say (`Matrix::new`), and their inner sides agree. The
    // vector has room for the product, all of whose elements are written and none of which is read.
    #[allow(unsafe_code, reason = "the product takes pointers and writes memory that is not initialised")]
    unsafe {
        gemm(
            rows,
            columns,
            inner,
            product.as_mut_ptr(),
            1,
            columns as isize,
            false,
            lhs.values.as_ptr(),
            lhs_cs,
            lhs_rs,
            rhs.values.as_ptr(),
            rhs_cs,
            rhs_rs,
            0.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
        product.set_len(rows * columns);
    }
    product
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_matrices_and_transposes_match_the_definition() {
        let values = |count: usize, seed: usize| -> Vec<f32> {
            (0..count).map(|i| ((i + seed) * 37 % 101) as f32 / 50.0 - 1.0).collect()
        };
        for [rows, inner, columns] in [[1, 1, 1], [5, 7, 3], [2, 0, 3], [0, 4, 2], [33, 20, 18], [256, 256, 130]] {
            let (lhs, rhs) = (values(rows * inner, 1), values(inner * columns, 2));
            let at = |i: usize, j: usize| -> f64 {
                (0..inner).map(|k| f64::from(lhs[i * inner + k]) * f64::from(rhs[k * columns + j])).sum()
            };
            let transpose = |values: &[f32], rows: usize, columns: usize| -> Vec<f32> {
                (0..values.len()).map(|i| values[i % rows * columns + i / rows]).collect()
            };
            let (lhs_t, rhs_t) = (transpose(&lhs, rows, inner), transpose(&rhs, inner, columns));
            let of = |values, columns: usize, rows: usize| Matrix { values, rows, columns, is_transposed: false };
            for lhs in [of(&lhs, inner, rows), of(&lhs_t, rows, inner).transposed()] {
                for rhs in [of(&rhs, columns, inner), of(&rhs_t, inner, columns).transposed()] {
                    let product = multiply(lhs, rhs);
                    assert_eq!(product.len(), rows * columns);
                    for (i, value) in product.iter().enumerate() {
                        let expected = at(i / columns, i % columns);
                        assert!((f64::from(*value) - expected).abs() < 1e-4, "{rows} {inner} {columns}: {i}");
                    }
                }
            }
        }
    }
}
