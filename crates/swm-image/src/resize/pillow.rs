//! [`PillowResizer`]: resizing as Pillow does it.
//!
//! The vertical pass runs first, as in Pillow from version 13 on. Results of older versions differ by 1 in some bytes.

use super::axis::{FilterAxis, WEIGHT_HALF, weighted_byte};

/// Pillow's filters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PillowFilter {
    /// `BILINEAR`: a triangle filter. When downscaling, its support grows with the scale (antialiasing).
    Triangle,
    /// `NEAREST`, for pixel art.
    Nearest,
}

/// Resizes images with one of Pillow's filters. The resizer reuses its weights while the sizes stay the same.
pub struct PillowResizer {
    filter: PillowFilter,
    /// Height and width of the source and of the result.
    sizes: [(usize, usize); 2],
    columns: FilterAxis<i32>,
    rows: FilterAxis<i32>,
    /// A row of the result before it is resized along x, as weighted sums.
    sums: Vec<i32>,
    /// A row of the result before it is resized along x, as bytes.
    line: Vec<u8>,
}

impl PillowResizer {
    /// Makes a resizer with a filter.
    pub fn new(filter: PillowFilter) -> Self {
        let (columns, rows) = (FilterAxis::default(), FilterAxis::default());
        Self { filter, sizes: [(0, 0); 2], columns, rows, sums: vec![], line: vec![] }
    }

    /// Computes the weights for two sizes, unless the last image had the same sizes.
    fn prepare(&mut self, from: (usize, usize), to: (usize, usize)) {
        if self.sizes == [from, to] {
            return;
        }
        let axis = match self.filter {
            PillowFilter::Triangle => FilterAxis::<i32>::triangle,
            PillowFilter::Nearest => FilterAxis::<i32>::nearest,
        };
        (self.rows, self.columns) = (axis(from.0, to.0), axis(from.1, to.1));
        self.sums.resize(3 * from.1, 0);
        self.line.resize(3 * from.1, 0);
        self.sizes = [from, to];
    }

    /// Resizes an image of `from = (height, width)` to `to = (height, width)`. If the sizes are equal, copies the
    /// image.
    pub fn resize(&mut self, source: &[u8], from: (usize, usize), result: &mut [u8], to: (usize, usize)) {
        if from == to {
            result.copy_from_slice(source);
            return;
        }
        self.prepare(from, to);
        let row_bytes = 3 * from.1;
        for ((first, weights), result) in self.rows.taps().zip(result.chunks_exact_mut(3 * to.1)) {
            self.sums.fill(WEIGHT_HALF);
            for (row, &weight) in source[row_bytes * first..].chunks_exact(row_bytes).zip(weights) {
                self.sums.iter_mut().zip(row).for_each(|(sum, &byte)| *sum += i32::from(byte) * weight);
            }
            self.line.iter_mut().zip(&self.sums).for_each(|(byte, &sum)| *byte = weighted_byte(sum));
            let line = self.line.as_chunks::<3>().0;
            for ((first, weights), pixel) in self.columns.taps().zip(result.as_chunks_mut::<3>().0) {
                let mut sum = [WEIGHT_HALF; 3];
                for (source, &weight) in line[first..].iter().zip(weights) {
                    (0..3).for_each(|c| sum[c] += i32::from(source[c]) * weight);
                }
                *pixel = sum.map(weighted_byte);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Resizes an image of 9 x 6 pixels with the red channel (x * 37 + y * y * 11) % 256. Returns the red channel.
    fn red(width: usize, height: usize, filter: PillowFilter) -> Vec<u8> {
        let old: Vec<u8> = (0..54).flat_map(|i| [((i % 9 * 37 + (i / 9) * (i / 9) * 11) % 256) as u8, 1, 2]).collect();
        let mut resizer = PillowResizer::new(filter);
        // The first resize has another size, so the second resize must compute new weights.
        for (width, height) in [(5, 4), (width, height)] {
            let mut new = vec![7; width * height * 3];
            resizer.resize(&old, (6, 9), &mut new, (height, width));
            assert!(new.as_chunks::<3>().0.iter().all(|pixel| pixel[1..] == [1, 2]), "channels do not mix");
            if (width, height) != (5, 4) {
                return new.as_chunks::<3>().0.iter().map(|pixel| pixel[0]).collect();
            }
        }
        vec![]
    }

    #[test]
    fn bilinear_and_nearest_resizing_match_pillow() {
        // Image.fromarray(image).resize(size, Image.BILINEAR), then Image.NEAREST.
        for (width, height, expected) in BILINEAR {
            let found = red(*width, *height, PillowFilter::Triangle);
            assert!(found.iter().zip(*expected).all(|(a, b)| a.abs_diff(*b) <= 1), "{width} x {height}: {found:?}");
        }
        for (width, height, expected) in NEAREST {
            assert_eq!(red(*width, *height, PillowFilter::Nearest), *expected, "{width} x {height}");
        }
    }

    const BILINEAR: &[(usize, usize, &[u8])] = &[
        (4, 3, &[42, 117, 173, 65, 108, 159, 128, 93, 129, 130, 143, 129]),
        (9, 2, &[28, 65, 102, 139, 176, 181, 154, 31, 68, 101, 138, 175, 116, 153, 126, 131, 104, 141]),
        (
            13,
            4,
            &[
                4, 24, 50, 75, 101, 126, 152, 178, 203, 209, 58, 24, 44, 39, 59, 85, 110, 136, 161, 187, 193, 155, 86,
                53, 59, 79, 119, 139, 165, 190, 163, 155, 181, 108, 79, 88, 113, 139, 159, 78, 98, 124, 149, 116, 104,
                130, 156, 181, 195, 109, 98, 118,
            ],
        ),
        (2, 8, &[81, 121, 88, 128, 103, 122, 126, 105, 153, 111, 157, 129, 135, 139, 100, 140]),
    ];

    const NEAREST: &[(usize, usize, &[u8])] = &[
        (4, 3, &[48, 122, 196, 14, 136, 210, 28, 102, 56, 130, 204, 22]),
        (9, 2, &[11, 48, 85, 122, 159, 196, 233, 14, 51, 176, 213, 250, 31, 68, 105, 142, 179, 216]),
        (
            13,
            4,
            &[
                0, 37, 37, 74, 111, 111, 148, 185, 185, 222, 3, 3, 40, 44, 81, 81, 118, 155, 155, 192, 229, 229, 10,
                47, 47, 84, 99, 136, 136, 173, 210, 210, 247, 28, 28, 65, 102, 102, 139, 19, 56, 56, 93, 130, 130, 167,
                204, 204, 241, 22, 22, 59,
            ],
        ),
        (2, 8, &[74, 222, 85, 233, 85, 233, 118, 10, 173, 65, 250, 142, 250, 142, 93, 241]),
    ];
}
