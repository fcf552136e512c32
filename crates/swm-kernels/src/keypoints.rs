//! [`Keypoints`]: where the filters of a convolution respond in an image, by the expectation of a softmax over its
//! positions (Finn et al. 2016, arXiv 1509.06113).

use crate::functions::exp;
use crate::panels::Panels;
use crate::product::{Rows, Segment, multiply};
use swm_simd::{Kernel, Level, dispatch};

/// The features of a filter: the expected x and y, and the largest response.
const FEATURES: usize = 3;
/// The factor of the largest response, in standard deviations, which brings it into the range of the positions.
const RESPONSE: f32 = 0.25;
/// Added to the standard deviation of the responses.
const EPSILON: f32 = 1e-4;

/// Filters with equal sizes.
#[derive(Clone, Debug)]
pub struct FilterBank {
    /// The side of the filters, in pixels; odd.
    pub kernel: usize,
    /// The distance of two positions, in pixels.
    pub stride: usize,
    /// The weights, `[filters, 3, kernel, kernel]`.
    pub weight: Vec<f32>,
}

/// The filters of an encoder for images of one size, and the memory layout of their products.
#[derive(Clone, Debug)]
pub struct Keypoints {
    side: usize,
    sharpness: f32,
    banks: Vec<Bank>,
}

/// A filter bank for images of one size.
#[derive(Clone, Debug)]
struct Bank {
    /// The positions along a side.
    positions: usize,
    /// Pixels of zeros before the first row and the first column.
    margin: usize,
    /// The side of the image with its margin.
    padded: usize,
    panels: Panels,
    /// The start of the patch of each position in the padded image.
    starts: Vec<usize>,
    segments: Vec<Segment>,
}

/// Memory for the features of an image.
#[derive(Clone, Debug, Default)]
pub struct KeypointScratch {
    padded: Vec<f32>,
    responses: Vec<f32>,
    sums: Vec<f32>,
}

impl Keypoints {
    /// Creates the kernels for images with a side of `side` pixels. `sharpness` is the factor of the responses, in standard
    /// deviations, before the softmax.
    pub fn new(side: usize, sharpness: f32, banks: &[FilterBank]) -> Self {
        Self { side, sharpness, banks: banks.iter().map(|bank| Bank::new(side, bank)).collect() }
    }

    /// The number of features of an image: three for each filter.
    pub fn features(&self) -> usize {
        FEATURES * self.banks.iter().map(|bank| bank.panels.outputs()).sum::<usize>()
    }

    /// Computes the features of an image: for each bank, the expected x of each filter, then the expected y, from -1 to 1,
    /// then the largest response. The responses of a filter have mean 0 and variance 1 over the positions of the image.
    ///
    /// # Shapes
    /// `pixels` is `[side, side, 3]`, `features` is `[`[`Keypoints::features`]`]`.
    pub fn features_of(&self, pixels: &[f32], scratch: &mut KeypointScratch, features: &mut [f32]) {
        let mut features = features;
        for bank in &self.banks {
            let (of_bank, rest) = features.split_at_mut(FEATURES * bank.panels.outputs());
            bank.respond(pixels, self.side, scratch);
            dispatch(Expectation { bank, sharpness: self.sharpness, scratch, features: of_bank });
            features = rest;
        }
    }
}

impl Bank {
    fn new(side: usize, bank: &FilterBank) -> Self {
        let FilterBank { kernel, stride, weight } = bank;
        let (kernel, stride) = (*kernel, *stride);
        let positions = side.div_ceil(stride);
        let padded = (stride * (positions - 1) + kernel).max(kernel / 2 + side);
        let inputs = 3 * kernel * kernel;
        // A patch is ordered by row, column and channel, the weights by channel, row and column.
        let at = |input: usize, filter: usize| {
            let (pixel, channel) = (input / 3, input % 3);
            weight[filter * inputs + channel * kernel * kernel + pixel]
        };
        let position = |y: usize, x: usize| (y * stride * padded + x * stride) * 3;
        Self {
            positions,
            margin: kernel / 2,
            padded,
            panels: Panels::new(inputs, weight.len() / inputs, at),
            starts: (0..positions * positions).map(|index| position(index / positions, index % positions)).collect(),
            segments: (0..kernel).map(|row| Segment { offset: row * padded * 3, length: kernel * 3 }).collect(),
        }
    }

    /// Computes the responses, `[positions, positions, filters]`.
    fn respond(&self, pixels: &[f32], side: usize, scratch: &mut KeypointScratch) {
        let row = self.padded * 3;
        scratch.padded.clear();
        scratch.padded.resize(self.padded * row, 0.0);
        for (y, from) in pixels.chunks_exact(side * 3).enumerate() {
            scratch.padded[(y + self.margin) * row + self.margin * 3..][..side * 3].copy_from_slice(from);
        }
        let filters = self.panels.outputs();
        scratch.responses.resize(self.starts.len() * filters, 0.0);
        let patches = Rows { values: &scratch.padded, starts: &self.starts[..], segments: &self.segments };
        multiply(self.starts.len(), patches, &self.panels, (&mut scratch.responses, filters));
    }
}

/// Computes the features of a bank from its responses.
struct Expectation<'a> {
    bank: &'a Bank,
    sharpness: f32,
    scratch: &'a mut KeypointScratch,
    features: &'a mut [f32],
}

impl Kernel for Expectation<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let Self { bank, sharpness, scratch, features } = self;
        let (filters, positions) = (bank.panels.outputs(), bank.positions);
        let count = (positions * positions) as f32;
        let KeypointScratch { responses, sums, .. } = scratch;
        sums.clear();
        sums.resize(3 * filters, 0.0);
        let (mean, rest) = sums.split_at_mut(filters);
        let (scale, total) = rest.split_at_mut(filters);
        let (x, rest) = features.split_at_mut(filters);
        let (y, largest) = rest.split_at_mut(filters);
        largest.fill(f32::NEG_INFINITY);
        for row in responses.chunks_exact(filters) {
            for filter in 0..filters {
                mean[filter] += row[filter];
                largest[filter] = largest[filter].max(row[filter]);
            }
        }
        mean.iter_mut().for_each(|mean| *mean /= count);
        for row in responses.chunks_exact(filters) {
            for filter in 0..filters {
                let centred = row[filter] - mean[filter];
                scale[filter] = L::fma(centred, centred, scale[filter]);
            }
        }
        scale.iter_mut().for_each(|sum| *sum = sharpness / ((*sum / count).sqrt() + EPSILON));
        x.fill(0.0);
        y.fill(0.0);
        let coordinate = |index: usize| 2.0 * index as f32 / (positions - 1).max(1) as f32 - 1.0;
        for (index, row) in responses.chunks_exact(filters).enumerate() {
            let (at_x, at_y) = (coordinate(index % positions), coordinate(index / positions));
            for filter in 0..filters {
                let weight = exp::<L>((row[filter] - largest[filter]) * scale[filter]);
                total[filter] += weight;
                x[filter] = L::fma(weight, at_x, x[filter]);
                y[filter] = L::fma(weight, at_y, y[filter]);
            }
        }
        for filter in 0..filters {
            x[filter] /= total[filter];
            y[filter] /= total[filter];
            largest[filter] = (largest[filter] - mean[filter]) * scale[filter] * (RESPONSE / sharpness);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_match_their_definition() {
        let (side, sharpness) = (10, 2.0);
        let weight = |count: usize| (0..count).map(|i| (i * 29 % 83) as f32 / 83.0 - 0.5).collect::<Vec<f32>>();
        let banks = [
            FilterBank { kernel: 3, stride: 2, weight: weight(5 * 27) },
            FilterBank { kernel: 5, stride: 3, weight: weight(2 * 75) },
        ];
        let pixels: Vec<f32> = (0..side * side * 3).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
        let keypoints = Keypoints::new(side, sharpness, &banks);
        let mut features = vec![f32::NAN; keypoints.features()];
        let mut scratch = KeypointScratch::default();
        keypoints.features_of(&pixels, &mut scratch, &mut features);
        let mut expected = vec![];
        for FilterBank { kernel, stride, weight } in &banks {
            let positions = side.div_ceil(*stride);
            let filters: Vec<[f64; 3]> = weight
                .chunks_exact(3 * kernel * kernel)
                .map(|weight| {
                    let response = |index: usize| {
                        let at = |of: usize, offset: usize| (of * stride + offset).checked_sub(kernel / 2);
                        let mut sum = 0.0;
                        for (i, weight) in weight.iter().enumerate() {
                            let (c, dy, dx) = (i / (kernel * kernel), i / kernel % kernel, i % kernel);
                            let (y, x) = (at(index / positions, dy), at(index % positions, dx));
                            if let (Some(y), Some(x)) = (y.filter(|y| *y < side), x.filter(|x| *x < side)) {
                                sum += f64::from(*weight) * f64::from(pixels[(y * side + x) * 3 + c]);
                            }
                        }
                        sum
                    };
                    let all: Vec<f64> = (0..positions * positions).map(response).collect();
                    let mean = all.iter().sum::<f64>() / all.len() as f64;
                    let std = (all.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / all.len() as f64).sqrt() + 1e-4;
                    let weights: Vec<f64> = all.iter().map(|r| (2.0 * (r - mean) / std).exp()).collect();
                    let total: f64 = weights.iter().sum();
                    let coordinate = |index: usize| 2.0 * index as f64 / (positions - 1) as f64 - 1.0;
                    let expect = |of: &dyn Fn(usize) -> usize| {
                        weights.iter().enumerate().map(|(i, w)| w * coordinate(of(i))).sum::<f64>() / total
                    };
                    let largest = all.iter().fold(f64::NEG_INFINITY, |a, b| a.max(*b));
                    [expect(&|i| i % positions), expect(&|i| i / positions), (largest - mean) / std / 4.0]
                })
                .collect();
            (0..3).for_each(|part| expected.extend(filters.iter().map(|filter| filter[part])));
        }
        assert_eq!(features.len(), expected.len());
        for (feature, expected) in features.iter().zip(&expected) {
            assert!((f64::from(*feature) - expected).abs() < 1e-4, "{feature}, expected {expected}");
        }
        // Memory of another image changes no byte.
        let mut again = vec![0.0; features.len()];
        keypoints.features_of(&pixels, &mut scratch, &mut again);
        assert_eq!(again, features);
    }
}
