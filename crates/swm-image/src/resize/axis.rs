//! The weights of a resizing filter in one direction.

use std::ops::Range;

/// Fraction bits of integer weights, as in Pillow.
pub const WEIGHT_BITS: u32 = 22;
/// The weight 1/2. Callers add it to a sum of weighted bytes, so that [`weighted_byte`] rounds to the nearest byte.
pub const WEIGHT_HALF: i32 = 1 << (WEIGHT_BITS - 1);

/// Returns a sum of bytes with integer weights as a byte. Weights may sum to slightly more than 1.
#[inline(always)]
pub fn weighted_byte(sum: i32) -> u8 {
    (sum >> WEIGHT_BITS).min(255) as u8
}

/// The source pixels and the weights of every pixel along one side of the result.
#[derive(Clone, Debug, Default)]
pub struct FilterAxis<W> {
    /// For each pixel of the result, its first source pixel.
    first: Vec<usize>,
    /// For each pixel of the result, the index after its last source pixel.
    end: Vec<usize>,
    /// For each pixel of the result, the index of its first weight.
    start: Vec<usize>,
    weights: Vec<W>,
}

impl FilterAxis<i32> {
    /// Pillow's triangle filter with weights of [`WEIGHT_BITS`] fraction bits. The filter averages when it shrinks and
    /// interpolates linearly when it enlarges.
    pub fn triangle(from: usize, to: usize) -> Self {
        Self::from_triangle(from, to, |weight| (weight * f64::from(1 << WEIGHT_BITS) + 0.5) as i32)
    }

    /// Pillow's `NEAREST`: for each pixel of the result, the source pixel under its centre, with weight 1.
    pub fn nearest(from: usize, to: usize) -> Self {
        let mut axis = Self::default();
        let scale = from as f64 / to as f64;
        for i in 0..to {
            let source = (((i as f64 + 0.5) * scale) as usize).min(from - 1);
            axis.push(source..source + 1, [1 << WEIGHT_BITS]);
        }
        axis
    }
}

impl FilterAxis<f32> {
    /// The triangle filter with `f32` weights.
    pub fn triangle(from: usize, to: usize) -> Self {
        Self::from_triangle(from, to, |weight| weight as f32)
    }

    /// Returns pixel `i` of the result for source values that begin at pixel `start` and are 0 elsewhere.
    pub fn mean(&self, i: usize, values: &[f32], start: usize) -> f32 {
        let weighted = self.source(i).zip(self.weights(i));
        weighted.map(|(j, weight)| weight * j.checked_sub(start).and_then(|j| values.get(j)).unwrap_or(&0.0)).sum()
    }
}

impl<W> FilterAxis<W> {
    fn push(&mut self, source: Range<usize>, weights: impl IntoIterator<Item = W>) {
        self.first.push(source.start);
        self.end.push(source.end);
        self.start.push(self.weights.len());
        self.weights.extend(weights);
    }

    fn from_triangle(from: usize, to: usize, weight: impl Fn(f64) -> W) -> Self {
        let mut axis = Self { first: vec![], end: vec![], start: vec![], weights: vec![] };
        let scale = from as f64 / to as f64;
        let support = scale.max(1.0);
        for i in 0..to {
            let centre = (i as f64 + 0.5) * scale;
            let source = (centre - support + 0.5).max(0.0) as usize..((centre + support + 0.5) as usize).min(from);
            let height = |x: usize| (1.0 - ((x as f64 - centre + 0.5) / support).abs()).max(0.0);
            let total: f64 = source.clone().map(height).sum();
            axis.push(source.clone(), source.map(|x| weight(height(x) / total)));
        }
        axis
    }

    /// The number of pixels of the result.
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// Returns whether the result has no pixels.
    pub fn is_empty(&self) -> bool {
        self.first.is_empty()
    }

    /// The pixels of the source that pixel `i` of the result averages.
    #[inline]
    pub fn source(&self, i: usize) -> Range<usize> {
        self.first[i]..self.end[i]
    }

    /// The weights of [`FilterAxis::source`].
    #[inline]
    pub fn weights(&self, i: usize) -> &[W] {
        &self.weights[self.start[i]..][..self.end[i] - self.first[i]]
    }

    /// For each pixel of the result, the first pixel of the source and the weights.
    #[inline]
    pub fn taps(&self) -> impl Iterator<Item = (usize, &[W])> {
        (0..self.len()).map(|i| (self.first[i], self.weights(i)))
    }

    /// The pixels of the result that depend on some pixels of the source.
    pub fn touched(&self, source: &Range<usize>) -> Range<usize> {
        let from = self.end.partition_point(|&end| end <= source.start);
        from..self.first.partition_point(|&first| first < source.end).max(from)
    }
}
