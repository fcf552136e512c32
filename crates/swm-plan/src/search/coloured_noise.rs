//! [`ColouredNoise`]: noise that is correlated along the steps of a plan.

use std::f64::consts::TAU;

/// A filter that turns white Gaussian noise into noise whose power falls with the frequency as `f^-β`: β = 0 is white,
/// 1 pink, 2 red (a random walk).
///
/// White noise of H steps is weighted by `f^(-β/2)` in the frequency domain; frequency 0 has the weight of the lowest
/// frequency above it, `1/H` (Timmer and König, *On generating power law noise*, 1995, as in Pinneri et al., 2021).
/// Weights in the frequency domain are a circular convolution in time, whose kernel is computed once: for the short
/// horizons of a plan this is faster than a Fourier transform. The squares of the kernel add up to 1, so the variance
/// stays 1.
pub struct ColouredNoise {
    /// The weight of the white noise t steps earlier (circular), `[horizon]`.
    kernel: Vec<f32>,
}

impl ColouredNoise {
    /// Creates the filter with the exponent β for `horizon` steps.
    pub fn new(beta: f32, horizon: usize) -> Self {
        let weight = |f: usize| (f.min(horizon - f).max(1) as f64 / horizon as f64).powf(-f64::from(beta) / 2.0);
        let phase = |f: usize, t: usize| TAU * (f * t % horizon) as f64 / horizon as f64;
        let kernel: Vec<f64> =
            (0..horizon).map(|t| (0..horizon).map(|f| weight(f) * phase(f, t).cos()).sum()).collect();
        let norm = kernel.iter().map(|k| k * k).sum::<f64>().sqrt();
        Self { kernel: kernel.iter().map(|k| (k / norm) as f32).collect() }
    }

    /// Filters the white noise of one candidate along the steps, in place. `scratch` is memory that is
    /// reused between calls.
    ///
    /// # Shapes
    /// `noise` is `[horizon, dim]`.
    pub fn apply(&self, noise: &mut [f32], scratch: &mut Vec<f32>) {
        let horizon = self.kernel.len();
        let dim = noise.len() / horizon;
        scratch.clear();
        scratch.extend_from_slice(noise);
        noise.fill(0.0);
        for (t, coloured) in noise.chunks_exact_mut(dim).enumerate() {
            for (from, white) in scratch.chunks_exact(dim).enumerate() {
                let weight = self.kernel[(t + horizon - from) % horizon];
                coloured.iter_mut().zip(white).for_each(|(coloured, white)| *coloured += weight * white);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::normal_noise;
    use swm_core::Key;

    #[test]
    fn exponent_zero_is_white_noise() {
        let colour = ColouredNoise::new(0.0, 7);
        assert!((colour.kernel[0] - 1.0).abs() < 1e-6 && colour.kernel[1..].iter().all(|k| k.abs() < 1e-6));
        assert_eq!(ColouredNoise::new(2.0, 1).kernel, [1.0]);
    }

    #[test]
    fn noise_power_falls_with_frequency_by_the_exponent() {
        // The spectrum over many candidates follows f^-β, and the variance of every value is 1.
        let (horizon, dim, n) = (8, 2, 40_000);
        let colour = ColouredNoise::new(2.0, horizon);
        let (mut power, mut variance, mut scratch) = (vec![0.0; horizon], vec![0.0; horizon], vec![]);
        let mut noise = vec![0.0; n * horizon * dim];
        normal_noise::fill(Key::new(1), 0, &mut noise);
        for candidate in noise.chunks_exact_mut(horizon * dim) {
            colour.apply(candidate, &mut scratch);
            let value = |t: usize| f64::from(candidate[t * dim + 1]);
            (0..horizon).for_each(|t| variance[t] += value(t).powi(2) / n as f64);
            for (f, power) in power.iter_mut().enumerate() {
                let angle = |t: usize| TAU * (f * t) as f64 / horizon as f64;
                let cos: f64 = (0..horizon).map(|t| value(t) * angle(t).cos()).sum();
                let sin: f64 = (0..horizon).map(|t| value(t) * angle(t).sin()).sum();
                *power += (cos * cos + sin * sin) / n as f64;
            }
        }
        for variance in variance {
            assert!((variance - 1.0).abs() < 0.04, "{variance}");
        }
        for (f, expected) in [(0, 1.0), (2, 1.0 / 4.0), (3, 1.0 / 9.0), (4, 1.0 / 16.0)] {
            assert!((power[f] / power[1] / expected - 1.0).abs() < 0.06, "{f}: {power:?}");
        }
    }
}
