//! [`TriangleResizer`]: the triangle filter of Pillow's `BILINEAR` in `f32`, for parts of images.
//!
//! The vertical pass runs first, because it works on full rows. The result is rounded once, at the end. Pillow rounds
//! between the two passes, so some bytes may differ by 1.

use super::FilterAxis;
use std::ops::Range;

/// Resizes square images of one size to another size.
#[derive(Clone, Debug)]
pub struct TriangleResizer {
    side: usize,
    columns: FilterAxis<f32>,
    rows: FilterAxis<f32>,
    /// A row of the result before it is resized along x.
    line: Vec<f32>,
}

impl TriangleResizer {
    /// Makes a resizer from `side`² to `width` x `height`.
    pub fn new(side: usize, width: usize, height: usize) -> Self {
        let (columns, rows) = (FilterAxis::<f32>::triangle(side, width), FilterAxis::<f32>::triangle(side, height));
        Self { side, columns, rows, line: Vec::with_capacity(3 * side) }
    }

    /// Width and height of the result.
    pub fn size(&self) -> (usize, usize) {
        (self.columns.len(), self.rows.len())
    }

    /// The filters along x and along y.
    pub fn axes(&self) -> [&FilterAxis<f32>; 2] {
        [&self.columns, &self.rows]
    }

    /// Writes the part of the result that depends on the given columns and rows of the source.
    pub fn resize_part(&mut self, source: &[u8], columns: Range<usize>, rows: Range<usize>, result: &mut [u8]) {
        let (columns, rows) = (self.columns.touched(&columns), self.rows.touched(&rows));
        if columns.is_empty() || rows.is_empty() {
            return;
        }
        let left = self.columns.source(columns.start).start;
        let wide = self.columns.source(columns.end - 1).end - left;
        self.line.resize(3 * wide, 0.0);
        for y in rows {
            self.line.fill(0.0);
            for (k, &weight) in self.rows.source(y).zip(self.rows.weights(y)) {
                let source = &source[3 * (k * self.side + left)..][..3 * wide];
                self.line.iter_mut().zip(source).for_each(|(sum, &value)| *sum += weight * f32::from(value));
            }
            let line = self.line.as_chunks::<3>().0;
            let result = &mut result.as_chunks_mut::<3>().0[y * self.columns.len()..];
            for x in columns.clone() {
                let mut sum = [0.5; 3];
                for (&weight, pixel) in self.columns.weights(x).iter().zip(&line[self.columns.source(x).start - left..])
                {
                    (0..3).for_each(|c| sum[c] += weight * pixel[c]);
                }
                result[x] = sum.map(|v| v as u8);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangle_resizing_is_close_to_pillow() {
        // The expected values are the results of Image.fromarray(image).resize(size, Image.BILINEAR) for an image of
        // 6 x 6 pixels with the red channel (x * 37 + y * y * 11) % 256.
        let old: Vec<u8> = (0..36).flat_map(|i| [((i % 6 * 37 + (i / 6) * (i / 6) * 11) % 256) as u8, 0, 0]).collect();
        let red = |width: usize, height: usize, part: usize| {
            let mut new = vec![7; width * height * 3];
            TriangleResizer::new(6, width, height).resize_part(&old, 0..part, 0..part, &mut new);
            new.chunks(3).map(|pixel| pixel[0]).collect::<Vec<_>>()
        };
        let near = |found: &[u8], expected: &[u8]| found.iter().zip(expected).all(|(a, b)| a.abs_diff(*b) <= 1);
        let (full, other) = (red(4, 3, 6), red(2, 8, 6));
        assert!(near(&full, &PILLOW_4_3), "{full:?}");
        assert!(near(&other, &PILLOW_2_8), "{other:?}");
        // The part equals the full result, and the other pixels are not written.
        let part = red(4, 3, 1);
        assert!(part.iter().zip(&full).all(|(a, b)| *a == 7 || a == b));
        assert_eq!((part[0], part[11]), (full[0], 7));
    }

    const PILLOW_4_3: [u8; 12] = [25, 77, 130, 182, 91, 139, 168, 156, 112, 151, 119, 136];
    const PILLOW_2_8: [u8; 16] = [46, 139, 53, 146, 69, 162, 97, 182, 138, 175, 173, 122, 143, 116, 65, 158];
}
