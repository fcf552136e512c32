//! [`EppsPulley`]: how far projections of samples are from a standard normal distribution, and the gradient of that.
//!
//! Sixteen directions are computed at once, one in each lane of a SIMD vector. Every lane adds its terms in the order of the samples,
//! so a direction has the same bytes among any others.

use crate::panels::LANES;
use swm_simd::{Kernel, Level, dispatch};

/// The largest argument of the characteristic functions.
const LAST_KNOT: f32 = 3.0;

/// The Epps-Pulley statistic, `n ∫ |φ_n(t) - exp(-t²/2)|² exp(-t²/2) dt`, by the trapezoidal rule at equidistant arguments (knots)
/// up to 3 (LeJEPA, arXiv 2511.08544). The characteristic functions at the knots are powers of one complex number, so
/// a projection costs one sine and one cosine.
pub struct EppsPulley {
    /// The distance between neighbouring knots.
    spacing: f32,
    /// The characteristic function of the standard normal distribution at each knot.
    target: Vec<f32>,
    /// The weight of each knot: the trapezoidal weights of the knot and of the negated knot, times the Gaussian window.
    weights: Vec<f32>,
}

/// Statistics and gradients of at most [`EppsPulley::DIRECTIONS`] directions; lanes without a direction are 0.
pub struct Statistics {
    /// The statistic of each direction.
    pub values: [f64; LANES],
    /// The derivatives of the statistics with respect to the projections of each sample.
    pub slopes: Vec<[f32; LANES]>,
}

impl EppsPulley {
    /// The largest number of directions of one call.
    pub const DIRECTIONS: usize = LANES;

    /// Creates the rule with `knots` knots, at least 2.
    pub fn new(knots: usize) -> Self {
        let spacing = LAST_KNOT / (knots as f32 - 1.0);
        let target: Vec<f32> = (0..knots).map(|k| (-(k as f32 * spacing).powi(2) / 2.0).exp()).collect();
        let weights =
            (0..knots).map(|k| target[k] * spacing * if k == 0 || k == knots - 1 { 1.0 } else { 2.0 }).collect();
        Self { spacing, target, weights }
    }

    /// Computes the statistics of the projections of samples on some directions.
    ///
    /// # Shapes
    /// A sample is the first `dim` elements of a row of `stride` elements of `samples`; `directions` is `[count, dim]` with at most
    /// [`EppsPulley::DIRECTIONS`] directions.
    pub fn statistics(&self, samples: &[f32], stride: usize, directions: &[f32], dim: usize) -> Statistics {
        let mut transposed = vec![[0.0; LANES]; dim];
        for (lane, direction) in directions.chunks_exact(dim).enumerate() {
            transposed.iter_mut().zip(direction).for_each(|(to, from)| to[lane] = *from);
        }
        let mut statistics = dispatch(Directions { rule: self, samples, stride, directions: &transposed });
        statistics.values[directions.len() / dim..].fill(0.0);
        statistics
    }
}

/// The statistics of sixteen directions, `[dim]`.
struct Directions<'a> {
    rule: &'a EppsPulley,
    samples: &'a [f32],
    stride: usize,
    directions: &'a [[f32; LANES]],
}

/// Complex numbers, one in each lane.
#[derive(Clone, Copy)]
struct Complex {
    re: [f32; LANES],
    im: [f32; LANES],
}

impl Complex {
    const ZERO: Self = Self { re: [0.0; LANES], im: [0.0; LANES] };
    const ONE: Self = Self { re: [1.0; LANES], im: [0.0; LANES] };

    #[inline(always)]
    fn times(self, other: Self) -> Self {
        let mut product = Self::ZERO;
        for lane in 0..LANES {
            product.re[lane] = self.re[lane] * other.re[lane] - self.im[lane] * other.im[lane];
            product.im[lane] = self.re[lane] * other.im[lane] + self.im[lane] * other.re[lane];
        }
        product
    }

    #[inline(always)]
    fn add(&mut self, other: Self) {
        for lane in 0..LANES {
            self.re[lane] += other.re[lane];
            self.im[lane] += other.im[lane];
        }
    }
}

impl Kernel for Directions<'_> {
    type Output = Statistics;

    #[inline(always)]
    fn run<L: Level>(self) -> Statistics {
        let Self { rule: EppsPulley { spacing, target, weights }, samples, stride, directions } = self;
        let mut sums = vec![Complex::ZERO; target.len()];
        let mut turns = Vec::with_capacity(samples.len().div_ceil(stride));
        for sample in samples.chunks(stride) {
            let mut projections = [-0.0f32; LANES];
            for (value, direction) in sample.iter().zip(directions) {
                for lane in 0..LANES {
                    projections[lane] += value * direction[lane];
                }
            }
            let mut turn = Complex::ZERO;
            for lane in 0..LANES {
                (turn.im[lane], turn.re[lane]) = (projections[lane] * spacing).sin_cos();
            }
            let mut power = Complex::ONE;
            for sum in &mut sums {
                sum.add(power);
                power = power.times(turn);
            }
            turns.push(turn);
        }
        let n = turns.len() as f32;
        let mut values = [0.0f64; LANES];
        for (k, sum) in sums.iter_mut().enumerate() {
            let knot = k as f32 * spacing;
            for lane in 0..LANES {
                let (real, imaginary) = (sum.re[lane] / n - target[k], sum.im[lane] / n);
                values[lane] += f64::from(weights[k] * (real * real + imaginary * imaginary) * n);
                // From here on the derivatives of the statistic with respect to the sums, times the knot.
                sum.re[lane] = 2.0 * weights[k] * real * knot;
                sum.im[lane] = 2.0 * weights[k] * imaginary * knot;
            }
        }
        let mut slopes = Vec::with_capacity(turns.len());
        for turn in turns {
            let (mut power, mut slope) = (Complex::ONE, [0.0f32; LANES]);
            for by in &sums {
                for lane in 0..LANES {
                    slope[lane] += by.im[lane] * power.re[lane] - by.re[lane] * power.im[lane];
                }
                power = power.times(turn);
            }
            slopes.push(slope);
        }
        Statistics { values, slopes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The statistic of one direction by its definition, in double precision.
    fn statistic(projections: &[f64], knots: usize) -> f64 {
        let (n, spacing) = (projections.len() as f64, f64::from(LAST_KNOT) / (knots as f64 - 1.0));
        (0..knots)
            .map(|k| {
                let t = k as f64 * spacing;
                let [real, imaginary] =
                    [f64::cos, f64::sin].map(|part| projections.iter().map(|x| part(x * t)).sum::<f64>() / n);
                let normal = (-t * t / 2.0).exp();
                let weight = normal * spacing * if k == 0 || k == knots - 1 { 1.0 } else { 2.0 };
                weight * ((real - normal).powi(2) + imaginary.powi(2)) * n
            })
            .sum()
    }

    #[test]
    fn statistics_and_slopes_match_the_definition_for_any_number_of_directions() {
        let (rows, stride, dim, knots) = (23, 11, 5, 9);
        let value = |i: usize| (i * 37 % 101) as f32 / 50.0 - 1.0;
        let samples: Vec<f32> = (0..rows * stride).map(value).collect();
        let directions: Vec<f32> = (0..LANES * dim).map(|i| value(i * 3 + 1)).collect();
        let rule = EppsPulley::new(knots);
        let all = rule.statistics(&samples, stride, &directions, dim);
        for (lane, direction) in directions.chunks_exact(dim).enumerate() {
            let project = |row: &[f32]| -> f64 { (row.iter().zip(direction)).map(|(a, b)| f64::from(a * b)).sum() };
            let projections: Vec<f64> = samples.chunks(stride).map(project).collect();
            let expected = statistic(&projections, knots);
            assert!((all.values[lane] - expected).abs() < 1e-5 * expected.max(1.0), "lane {lane}");
            for (row, slopes) in all.slopes.iter().enumerate() {
                let moved = |by: f64| {
                    let mut moved = projections.clone();
                    moved[row] += by;
                    statistic(&moved, knots)
                };
                let expected = (moved(1e-4) - moved(-1e-4)) / 2e-4;
                assert!((f64::from(slopes[lane]) - expected).abs() < 1e-5, "row {row}, lane {lane}");
            }
        }
        // Fewer directions have the same bytes, whatever the other lanes hold.
        let some = rule.statistics(&samples, stride, &directions[..3 * dim], dim);
        assert_eq!(some.values[..3], all.values[..3]);
        assert_eq!(some.values[3..], [0.0; LANES - 3]);
        assert!(some.slopes.iter().zip(&all.slopes).all(|(some, all)| some[..3] == all[..3]));
    }
}
