//! [`AreaResizer`]: OpenCV's area interpolation (`INTER_AREA`), in which every pixel is the mean of the area that it
//! covers in the source.

/// The source pixels and the weights of every pixel along one side of the result.
#[derive(Clone)]
struct Taps {
    /// The largest number of source pixels per pixel of the result.
    span: usize,
    /// For each pixel of the result, its first source pixel.
    first: Vec<usize>,
    /// The weights, `span` per pixel of the result, which sum to 1.
    weights: Vec<f32>,
}

impl Taps {
    /// Builds the taps from the first pixel and the weights of each pixel of the result. The source has `from` pixels.
    fn new(from: usize, taps: &[(usize, Vec<f32>)]) -> Self {
        let span = taps.iter().map(|(_, weights)| weights.len()).max().unwrap_or(1);
        let first: Vec<usize> = taps.iter().map(|(first, _)| (*first).min(from - span)).collect();
        let mut padded = vec![0.0; span * taps.len()];
        for (((requested_first, weights), first), padded) in taps.iter().zip(&first).zip(padded.chunks_exact_mut(span))
        {
            padded[requested_first - first..][..weights.len()].copy_from_slice(weights);
        }
        Self { span, first, weights: padded }
    }

    /// Iterates over the pixels of the result: the first pixel of the source and the weights.
    fn iter(&self) -> impl Iterator<Item = (usize, &[f32])> {
        self.first.iter().copied().zip(self.weights.chunks_exact(self.span))
    }
}

/// Resizes images of one size to another size. Shrinking averages the covered area. Enlarging blends the two pixels
/// that a pixel of the result overlaps, weighted by the overlap.
#[derive(Clone)]
pub struct AreaResizer {
    from: [usize; 2],
    to: [usize; 2],
    columns: Taps,
    rows: Taps,
    /// One row of the result before it is resized along x.
    line: Vec<f32>,
}

impl AreaResizer {
    /// Makes a resizer between two sizes, `[width, height]`, none of them 0.
    pub fn new(from: [usize; 2], to: [usize; 2]) -> Self {
        let taps = if (0..2).all(|side| from[side] >= to[side]) { shrinking } else { growing };
        let [columns, rows] = [0, 1].map(|side| Taps::new(from[side], &taps(from[side], to[side])));
        Self { from, to, columns, rows, line: vec![0.0; 3 * from[0]] }
    }

    /// Returns whether the resizer is for these sizes.
    pub fn is_for(&self, from: [usize; 2], to: [usize; 2]) -> bool {
        self.from == from && self.to == to
    }

    /// Resizes an RGB image, `[height, width, 3]` bytes.
    pub fn resize(&mut self, source: &[u8], result: &mut [u8]) {
        let stride = self.line.len();
        for ((first, weights), result) in self.rows.iter().zip(result.chunks_exact_mut(3 * self.to[0])) {
            self.line.fill(0.0);
            for (source, weight) in source[stride * first..].chunks_exact(stride).zip(weights) {
                for (sum, &channel) in self.line.iter_mut().zip(source) {
                    *sum += weight * f32::from(channel);
                }
            }
            let line = self.line.as_chunks::<3>().0;
            for ((first, weights), pixel) in self.columns.iter().zip(result.as_chunks_mut::<3>().0) {
                let mut sum = [0.5; 3];
                for (source, weight) in line[first..].iter().zip(weights) {
                    for (sum, channel) in sum.iter_mut().zip(source) {
                        *sum += weight * channel;
                    }
                }
                *pixel = sum.map(|channel| channel as u8);
            }
        }
    }
}

fn shrinking(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = from as f64 / to as f64;
    let tap = |i: usize| {
        let (start, end) = (i as f64 * scale, ((i + 1) as f64 * scale).min(from as f64));
        let first = start as usize;
        // An overlap of less than 1e-3 with the next pixel is due to rounding and is ignored.
        let last = ((end - 1e-3).ceil() as usize).clamp(first + 1, from);
        let covered = |pixel: usize| (end.min((pixel + 1) as f64) - start.max(pixel as f64)) / (end - start);
        (first, (first..last).map(|pixel| covered(pixel) as f32).collect())
    };
    (0..to).map(tap).collect()
}

fn growing(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = from as f64 / to as f64;
    let tap = |i: usize| {
        let first = ((i as f64 * scale) as usize).min(from - 1);
        let reach = (i + 1) as f64 - (first + 1) as f64 / scale;
        let fraction = if reach <= 0.0 { 0.0 } else { reach.fract() as f32 };
        (first, if fraction > 0.0 && first + 1 < from { vec![1.0 - fraction, fraction] } else { vec![1.0] })
    };
    (0..to).map(tap).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resized(red: &[u8], from: [usize; 2], to: [usize; 2]) -> Vec<u8> {
        let source: Vec<u8> = red.iter().flat_map(|&v| [v, 0, 9]).collect();
        let mut result = vec![0; 3 * to[0] * to[1]];
        AreaResizer::new(from, to).resize(&source, &mut result);
        result.as_chunks::<3>().0.iter().map(|&[r, _, b]| if b == 9 { r } else { panic!("mixed channels") }).collect()
    }

    #[test]
    fn shrinking_averages_the_covered_area() {
        assert_eq!(resized(&[0, 100, 200, 40], [4, 1], [2, 1]), [50, 120]);
        assert_eq!(resized(&[0, 90, 240], [3, 1], [2, 1]), [30, 190]);
        assert_eq!(resized(&[10, 30, 50, 110], [2, 2], [1, 1]), [50]);
    }

    #[test]
    fn enlarging_by_integers_repeats_pixels() {
        assert_eq!(resized(&[7, 9], [1, 2], [3, 2]), [7, 7, 7, 9, 9, 9]);
        assert_eq!(resized(&[0, 200], [2, 1], [4, 1]), [0, 0, 200, 200]);
    }
}
