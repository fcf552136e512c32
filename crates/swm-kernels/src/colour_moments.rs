//! [`ColourMoments`]: where the pixels of each of a few colours lie in an image, and how they are spread.

use crate::functions::exp;
use swm_simd::{Kernel, Level, dispatch};

/// The factor of squared distances of colours: at a distance of 0.1, the weight is 1 / e.
const SHARPNESS: f32 = 100.0;
/// Weight without a colour, at the centre of the image, that is added to every colour: the moments of an invisible colour are 0.
const PRIOR: f32 = 0.1;

/// The colours, and the size of the images.
#[derive(Clone, Debug)]
pub struct ColourMoments {
    side: usize,
    colours: Vec<[f32; 3]>,
}

/// Memory for the features of an image.
#[derive(Clone, Debug, Default)]
pub struct ColourScratch {
    /// The weight of every pixel for every colour, `[colours, side * side]`.
    weights: Vec<f32>,
}

impl ColourMoments {
    /// The features of a colour: its fraction of the image, the mean x and y, three central moments of second and four of third order.
    pub const FEATURES: usize = 10;

    /// Creates the kernels for images with a side of `side` pixels. The colours have the units of the pixels.
    pub fn new(side: usize, colours: &[[f32; 3]]) -> Self {
        Self { side, colours: colours.to_vec() }
    }

    /// The number of features of an image: ten for each colour.
    pub fn features(&self) -> usize {
        Self::FEATURES * self.colours.len()
    }

    /// Computes the features of an image. A pixel belongs to the colours by the softmax of its negative squared distances. For each
    /// colour: its fraction of the image, the mean x and y of its pixels, from -1 to 1, and their central moments xx, xy, yy, xxx, xxy,
    /// xyy, yyy.
    ///
    /// # Shapes
    /// `pixels` is `[side, side, 3]`, `features` is `[`[`ColourMoments::features`]`]`.
    pub fn features_of(&self, pixels: &[f32], scratch: &mut ColourScratch, features: &mut [f32]) {
        dispatch(Moments { of: self, pixels, scratch, features });
    }
}

/// Computes the features of an image.
struct Moments<'a> {
    of: &'a ColourMoments,
    pixels: &'a [f32],
    scratch: &'a mut ColourScratch,
    features: &'a mut [f32],
}

impl Kernel for Moments<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let Self { of: ColourMoments { side, colours }, pixels, scratch, features } = self;
        let (side, count) = (*side, side * side);
        let weights = &mut scratch.weights;
        weights.resize(colours.len() * count, 0.0);
        // Distances, then the softmax over the colours of every pixel, then moments: one plane of pixels for each colour.
        for (colour, plane) in colours.iter().zip(weights.chunks_exact_mut(count)) {
            for (weight, pixel) in plane.iter_mut().zip(pixels.chunks_exact(3)) {
                let [r, g, b] = [pixel[0] - colour[0], pixel[1] - colour[1], pixel[2] - colour[2]];
                *weight = -SHARPNESS * L::fma(r, r, L::fma(g, g, b * b));
            }
        }
        for pixel in 0..count {
            let mut largest = f32::NEG_INFINITY;
            for colour in 0..colours.len() {
                largest = largest.max(weights[colour * count + pixel]);
            }
            let mut total = 0.0;
            for colour in 0..colours.len() {
                let weight = exp::<L>(weights[colour * count + pixel] - largest);
                weights[colour * count + pixel] = weight;
                total += weight;
            }
            for colour in 0..colours.len() {
                weights[colour * count + pixel] /= total;
            }
        }
        let coordinate = |index: usize| 2.0 * index as f32 / (side - 1).max(1) as f32 - 1.0;
        for (plane, features) in weights.chunks_exact(count).zip(features.chunks_exact_mut(ColourMoments::FEATURES)) {
            // Sums over a row first: a power of y is the same for its pixels.
            let (mut mass, mut x, mut y) = (0.0, 0.0, 0.0);
            for (row, weights) in plane.chunks_exact(side).enumerate() {
                let (mut of_row, mut x_of_row) = (0.0, 0.0);
                for (column, weight) in weights.iter().enumerate() {
                    of_row += weight;
                    x_of_row = L::fma(*weight, coordinate(column), x_of_row);
                }
                mass += of_row;
                x += x_of_row;
                y = L::fma(of_row, coordinate(row), y);
            }
            let total = mass + PRIOR;
            let (x, y) = (x / total, y / total);
            let mut moments = [0.0_f32; 7];
            for (row, weights) in plane.chunks_exact(side).enumerate() {
                let mut powers = [0.0_f32; 4];
                for (column, weight) in weights.iter().enumerate() {
                    let dx = coordinate(column) - x;
                    let (first, second) = (weight * dx, weight * dx * dx);
                    powers[0] += weight;
                    powers[1] += first;
                    powers[2] += second;
                    powers[3] = L::fma(second, dx, powers[3]);
                }
                let dy = coordinate(row) - y;
                let [zero, one, two, three] = powers;
                let of_row = [two, one * dy, zero * dy * dy, three, two * dy, one * dy * dy, zero * dy * dy * dy];
                moments.iter_mut().zip(of_row).for_each(|(moment, value)| *moment += value);
            }
            features[..3].copy_from_slice(&[mass / count as f32, x, y]);
            features[3..].iter_mut().zip(moments).for_each(|(feature, moment)| *feature = moment / total);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_match_their_definition() {
        let side = 9;
        let colours = [[0.0, 0.1, 0.2], [0.9, 0.8, 0.9], [0.4, 0.9, 0.1]];
        let pixels: Vec<f32> = (0..side * side * 3).map(|i| (i * 37 % 101) as f32 / 101.0).collect();
        let kernels = ColourMoments::new(side, &colours);
        let mut features = vec![f32::NAN; kernels.features()];
        let mut scratch = ColourScratch::default();
        kernels.features_of(&pixels, &mut scratch, &mut features);
        let membership = |pixel: &[f32], colour: &[f32; 3]| {
            let distance = |of: &[f32; 3]| pixel.iter().zip(of).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
            let all: f64 = colours.iter().map(|other| (-100.0 * distance(other)).exp()).sum();
            (-100.0 * distance(colour)).exp() / all
        };
        let at = |index: usize| 2.0 * index as f64 / (side - 1) as f64 - 1.0;
        for (colour, features) in colours.iter().zip(features.chunks_exact(10)) {
            let weights: Vec<f64> = pixels.chunks_exact(3).map(|pixel| membership(pixel, colour)).collect();
            let sum = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
                weights.iter().enumerate().map(|(i, weight)| weight * of(at(i % side), at(i / side))).sum()
            };
            let mass = sum(&|_, _| 1.0);
            let (x, y) = (sum(&|x, _| x) / (mass + 0.1), sum(&|_, y| y) / (mass + 0.1));
            let central = |i: i32, j: i32| sum(&|px, py| (px - x).powi(i) * (py - y).powi(j)) / (mass + 0.1);
            let expected = [
                mass / (side * side) as f64,
                x,
                y,
                central(2, 0),
                central(1, 1),
                central(0, 2),
                central(3, 0),
                central(2, 1),
                central(1, 2),
                central(0, 3),
            ];
            for (feature, expected) in features.iter().zip(expected) {
                assert!((f64::from(*feature) - expected).abs() < 1e-4, "{feature}, expected {expected}");
            }
        }
        // Memory of another image changes no byte.
        let mut again = vec![0.0; features.len()];
        kernels.features_of(&pixels, &mut scratch, &mut again);
        assert_eq!(again, features);
    }

    #[test]
    fn an_invisible_colour_has_finite_moments() {
        let kernels = ColourMoments::new(4, &[[1.0; 3], [0.0; 3]]);
        let mut features = vec![f32::NAN; 20];
        kernels.features_of(&[1.0; 48], &mut ColourScratch::default(), &mut features);
        assert!(features[10..].iter().all(|feature| feature.abs() < 1e-6), "{features:?}");
        assert!((features[0] - 1.0).abs() < 1e-6);
    }
}
