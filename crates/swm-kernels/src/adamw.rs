//! [`AdamWStep`]: one step of AdamW in one pass over parameters, gradients and moments.

use rayon::prelude::*;
use swm_simd::{Kernel, Level, dispatch};

/// The number of elements that a thread updates at once.
const PART: usize = 1 << 14;

/// The coefficients of a step (Loshchilov and Hutter 2019, algorithm 2).
#[derive(Clone, Copy, Debug)]
pub struct AdamWStep {
    /// The factor of the gradient, below 1 if the gradient is clipped.
    pub gradient: f32,
    /// The decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// The weights of the gradient in the first moment and of its square in the second.
    pub weights: [f32; 2],
    /// The square root of the bias correction of the second moment.
    pub root_bias: f32,
    /// The value added to the square root of the second moment.
    pub epsilon: f32,
    /// The factor of the old value.
    pub keep: f32,
    /// The learning rate divided by the bias correction of the first moment.
    pub rate: f32,
}

impl AdamWStep {
    /// Updates values, first and second moments, which have as many elements as the gradient.
    pub fn apply(&self, values: &mut [f32], gradient: &[f32], first: &mut [f32], second: &mut [f32]) {
        let moments = first.par_chunks_mut(PART).zip(second.par_chunks_mut(PART));
        let parts = values.par_chunks_mut(PART).zip(gradient.par_chunks(PART)).zip(moments);
        parts.for_each(|((values, gradient), (first, second))| {
            dispatch(Update { step: *self, values, gradient, first, second });
        });
    }
}

struct Update<'a> {
    step: AdamWStep,
    values: &'a mut [f32],
    gradient: &'a [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
}

impl Kernel for Update<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let AdamWStep { gradient: factor, betas, weights, root_bias, epsilon, keep, rate } = self.step;
        let moments = self.first.iter_mut().zip(self.second.iter_mut());
        for ((value, gradient), (first, second)) in self.values.iter_mut().zip(self.gradient).zip(moments) {
            let gradient = gradient * factor;
            *first = normal_or_zero(*first * betas[0] + gradient * weights[0]);
            *second = normal_or_zero(*second * betas[1] + gradient * gradient * weights[1]);
            *value = *value * keep - *first / (second.sqrt() / root_bias + epsilon) * rate;
        }
    }
}

/// Returns the value, or zero if it is below the smallest normal number. The moments of a unit that is never active would stay there for
/// ever: 0.9 times the smallest number of all is rounded to itself. Processors compute with such numbers many times slower.
#[inline(always)]
fn normal_or_zero(value: f32) -> f32 {
    if value.abs() < f32::MIN_POSITIVE { 0.0 } else { value }
}

/// Returns the sum of the squares. The elements are added in the same order on any number of threads.
pub fn sum_of_squares(values: &[f32]) -> f64 {
    let parts: Vec<f64> = values.par_chunks(PART).map(|part| f64::from(dispatch(Squares(part)))).collect();
    parts.iter().sum()
}

struct Squares<'a>(&'a [f32]);

impl Kernel for Squares<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<L: Level>(self) -> f32 {
        crate::functions::dot::<L>(self.0, self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_a_dead_unit_end_at_zero() {
        let step = AdamWStep {
            gradient: 1.0,
            betas: [0.9, 0.99],
            weights: [0.1, 0.01],
            root_bias: 1.0,
            epsilon: 1e-8,
            keep: 1.0,
            rate: 0.01,
        };
        let (mut values, mut first, mut second) = ([0.5, 0.5], [1e-3, f32::NAN], [1e-6, 1e-6]);
        for _ in 0..10_000 {
            step.apply(&mut values, &[0.0; 2], &mut first, &mut second);
        }
        assert_eq!((first[0], second), (0.0, [0.0; 2]));
        assert!(first[1].is_nan() && values[1].is_nan() && values[0].is_finite());
    }

    #[test]
    fn steps_match_the_definition_in_double_precision() {
        let values = |seed: usize, count: usize| -> Vec<f32> {
            (0..count).map(|i| ((i * 37 + seed * 11) % 101) as f32 / 50.0 - 1.0).collect()
        };
        for count in [0, 1, 17, PART + 5] {
            let (betas, lr, decay, epsilon, clip) = ([0.9f64, 0.99], 0.01f64, 0.1f64, 1e-8f64, 0.5f64);
            let (mut actual, mut first, mut second) = (values(1, count), vec![0.0; count], vec![0.0; count]);
            let mut expected: Vec<[f64; 3]> = actual.iter().map(|value| [f64::from(*value), 0.0, 0.0]).collect();
            for t in 1..=3 {
                let gradient = values(t + 2, count);
                let bias = betas.map(|beta| 1.0 - beta.powi(t as i32));
                let step = AdamWStep {
                    gradient: clip as f32,
                    betas: betas.map(|beta| beta as f32),
                    weights: betas.map(|beta| (1.0 - beta) as f32),
                    root_bias: bias[1].sqrt() as f32,
                    epsilon: epsilon as f32,
                    keep: (1.0 - lr * decay) as f32,
                    rate: (lr / bias[0]) as f32,
                };
                step.apply(&mut actual, &gradient, &mut first, &mut second);
                for ([value, first, second], gradient) in expected.iter_mut().zip(&gradient) {
                    let gradient = f64::from(*gradient) * clip;
                    *first = *first * betas[0] + gradient * (1.0 - betas[0]);
                    *second = *second * betas[1] + gradient * gradient * (1.0 - betas[1]);
                    *value -= lr * decay * *value + lr * (*first / bias[0]) / ((*second / bias[1]).sqrt() + epsilon);
                }
            }
            for (actual, [expected, ..]) in actual.iter().zip(&expected) {
                assert!((f64::from(*actual) - expected).abs() < 1e-6, "{actual}, expected {expected}");
            }
            let squares: f64 = actual.iter().map(|value| f64::from(*value).powi(2)).sum();
            assert!((sum_of_squares(&actual) - squares).abs() <= 1e-6 * squares);
        }
    }
}
