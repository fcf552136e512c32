//! Rows in blocks: the elements of 32 rows are stored feature by feature, as a panel of a matrix is ([`Panels`](crate::Panels)), so that
//! products with weights on the left read and write them in order.

use crate::panels::WIDTH;

/// The number of rows in a block.
pub const BLOCK: usize = WIDTH;

/// Writes rows in blocks, whose missing rows are 0. Other features of a block are not changed.
///
/// # Shapes
/// `rows` is `[rows, width]`; `blocks` is `[blocks, features, BLOCK]`, of which the features from `first` on are written.
pub fn write_blocks(rows: &[f32], width: usize, blocks: &mut [f32], features: usize, first: usize) {
    let mut rows = rows.chunks(BLOCK * width.max(1));
    for block in blocks.chunks_exact_mut(BLOCK * features) {
        let block = &mut block[first * BLOCK..][..width * BLOCK];
        let rows = rows.next().unwrap_or_default();
        if rows.len() < block.len() {
            block.fill(0.0);
        }
        transpose((rows, width), (block, BLOCK));
    }
}

/// The sides of the squares in which [`transpose`] moves elements.
const SQUARE: usize = 16;

/// Copies the transpose of a matrix to another, in squares, so that neighbours are read and written together. Each matrix is a row-major
/// slice and the number of its columns; the second one can have more columns than the first one has rows.
pub(crate) fn transpose((from, width): (&[f32], usize), (to, columns): (&mut [f32], usize)) {
    let height = from.len() / width.max(1);
    for top in (0..height).step_by(SQUARE) {
        for left in (0..width).step_by(SQUARE) {
            let (high, wide) = (SQUARE.min(height - top), SQUARE.min(width - left));
            if (high, wide) == (SQUARE, SQUARE) {
                let square: [[f32; SQUARE]; SQUARE] = std::array::from_fn(|row| {
                    *from[(top + row) * width + left..].first_chunk().expect("a row of a square")
                });
                for column in 0..SQUARE {
                    let to: &mut [f32; SQUARE] =
                        to[(left + column) * columns + top..].first_chunk_mut().expect("a row of a square");
                    *to = std::array::from_fn(|row| square[row][column]);
                }
            } else {
                for row in top..top + high {
                    for column in left..left + wide {
                        to[column * columns + row] = from[row * width + column];
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_blocks_are_columns_and_missing_rows_are_zero() {
        for [rows, width, features, first] in [[1usize, 1, 1, 0], [33, 5, 9, 3], [70, 40, 41, 1], [64, 16, 16, 0]] {
            let values: Vec<f32> = (0..rows * width).map(|i| i as f32 + 1.0).collect();
            let mut blocks = vec![-1.0; (rows.div_ceil(BLOCK) + 1) * BLOCK * features];
            write_blocks(&values, width, &mut blocks, features, first);
            for (i, value) in blocks.iter().enumerate() {
                let (row, feature) = (i / (features * BLOCK) * BLOCK + i % BLOCK, i / BLOCK % features);
                let written = (first..first + width).contains(&feature);
                let expected = match (written, row < rows) {
                    (false, _) => -1.0,
                    (true, true) => (row * width + feature - first) as f32 + 1.0,
                    (true, false) => 0.0,
                };
                assert_eq!(*value, expected, "row {row}, feature {feature}");
            }
        }
    }
}
