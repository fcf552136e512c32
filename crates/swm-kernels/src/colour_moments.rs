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
    /// The channels of the image, `[3, columns, rows]`.
    planes: Vec<f32>,
    /// The weight of every pixel for every colour, `[colours, columns, rows]`.
    weights: Vec<f32>,
    /// The largest negative squared distance of every pixel, and the sum of its weights before the normalisation, `[columns, rows]`.
    largest: Vec<f32>,
    total: Vec<f32>,
    /// Sums over the pixels of each row, `[4, rows]`.
    rows: Vec<f32>,
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
        let ColourScratch { planes, weights, largest, total, rows } = scratch;
        for (memory, values) in [
            (&mut *planes, 3 * count),
            (&mut *weights, colours.len() * count),
            (&mut *largest, count),
            (&mut *total, count),
            (&mut *rows, 4 * side),
        ] {
            memory.resize(values, 0.0);
        }
        // Planes hold the columns of the image one after the other, so that the sums over a row, of which each has the order of its
        // pixels, are taken for all rows at once.
        for (row, pixels) in pixels.chunks_exact(3 * side).enumerate() {
            for (column, pixel) in pixels.chunks_exact(3).enumerate() {
                for (channel, value) in pixel.iter().enumerate() {
                    planes[channel * count + column * side + row] = *value;
                }
            }
        }
        softmax::<L>(colours, planes, weights, largest, total);
        for (plane, features) in weights.chunks_exact(count).zip(features.chunks_exact_mut(ColourMoments::FEATURES)) {
            moments::<L>(side, plane, rows, features);
        }
    }
}

/// Computes the weights of all pixels for each colour, `[colours, pixels]`: the softmax over the colours of negative squared distances.
#[inline(always)]
fn softmax<L: Level>(
    colours: &[[f32; 3]],
    planes: &[f32],
    weights: &mut [f32],
    largest: &mut [f32],
    total: &mut [f32],
) {
    let count = largest.len();
    let (red, others) = planes.split_at(count);
    let (green, blue) = others.split_at(count);
    largest.fill(f32::NEG_INFINITY);
    for (colour, plane) in colours.iter().zip(weights.chunks_exact_mut(count)) {
        for ((((weight, largest), r), g), b) in plane.iter_mut().zip(&mut *largest).zip(red).zip(green).zip(blue) {
            let [r, g, b] = [r - colour[0], g - colour[1], b - colour[2]];
            *weight = -SHARPNESS * L::fma(r, r, L::fma(g, g, b * b));
            *largest = if *weight > *largest { *weight } else { *largest };
        }
    }
    total.fill(0.0);
    for plane in weights.chunks_exact_mut(count) {
        for ((weight, largest), total) in plane.iter_mut().zip(&*largest).zip(&mut *total) {
            *weight = exp::<L>(*weight - largest);
            *total += *weight;
        }
    }
    for plane in weights.chunks_exact_mut(count) {
        plane.iter_mut().zip(&*total).for_each(|(weight, total)| *weight /= total);
    }
}

/// Computes the features of a colour from its weights, which are stored column by column. `rows` is memory for four values of each row.
#[inline(always)]
fn moments<L: Level>(side: usize, plane: &[f32], rows: &mut [f32], features: &mut [f32]) {
    let coordinate = |index: usize| 2.0 * index as f32 / (side - 1).max(1) as f32 - 1.0;
    let (zero, others) = rows.split_at_mut(side);
    let (one, others) = others.split_at_mut(side);
    let (two, three) = others.split_at_mut(side);
    zero.fill(0.0);
    one.fill(0.0);
    for (column, weights) in plane.chunks_exact(side).enumerate() {
        let x = coordinate(column);
        for ((weight, zero), one) in weights.iter().zip(&mut *zero).zip(&mut *one) {
            *zero += weight;
            *one = L::fma(*weight, x, *one);
        }
    }
    // A power of y is the same for the pixels of a row.
    let (mut mass, mut x, mut y) = (0.0, 0.0, 0.0);
    for (row, (zero, one)) in zero.iter().zip(&*one).enumerate() {
        mass += zero;
        x += one;
        y = L::fma(*zero, coordinate(row), y);
    }
    let all = mass + PRIOR;
    let (x, y) = (x / all, y / all);
    one.fill(0.0);
    two.fill(0.0);
    three.fill(0.0);
    for (column, weights) in plane.chunks_exact(side).enumerate() {
        let dx = coordinate(column) - x;
        for (((weight, one), two), three) in weights.iter().zip(&mut *one).zip(&mut *two).zip(&mut *three) {
            let second = weight * dx * dx;
            *one += weight * dx;
            *two += second;
            *three = L::fma(second, dx, *three);
        }
    }
    let mut moments = [0.0_f32; 7];
    for (row, (((zero, one), two), three)) in zero.iter().zip(&*one).zip(&*two).zip(&*three).enumerate() {
        let dy = coordinate(row) - y;
        let of_row = [*two, one * dy, zero * dy * dy, *three, two * dy, one * dy * dy, zero * dy * dy * dy];
        moments.iter_mut().zip(of_row).for_each(|(moment, value)| *moment += value);
    }
    let count = side * side;
    features[..3].copy_from_slice(&[mass / count as f32, x, y]);
    features[3..].iter_mut().zip(moments).for_each(|(feature, moment)| *feature = moment / all);
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
