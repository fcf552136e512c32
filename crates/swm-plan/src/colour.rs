//! [`Colour`]: noise whose neighbouring steps resemble each other.

use std::f64::consts::TAU;

/// Gaussian noise whose power falls with the frequency as `f^-β`: β = 0 is white, 1 pink, 2 red (a random walk).
///
/// White noise of H steps is weighted by `f^(-β/2)` in the frequency domain; frequency 0 weighs as much as the lowest
/// one above it, `1/H` (Timmer and König, *On generating power law noise*, 1995, as in Pinneri et al., 2021). For the
/// short horizons of a plan this is done without a Fourier transform: a weight on frequencies is a circular convolution
/// in time, and its kernel is computed once. The kernel's squares add up to 1, so that every number is standard normal
/// again.
pub struct Colour {
    /// What each of the H steps owes to the step t before it, around the end.
    kernel: Vec<f32>,
}

impl Colour {
    /// The colour β over `horizon` steps.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub fn new(beta: f32, horizon: usize) -> Self {
        let weight = |f: usize| (f.min(horizon - f).max(1) as f64 / horizon as f64).powf(-f64::from(beta) / 2.0);
        let phase = |f: usize, t: usize| TAU * (f * t % horizon) as f64 / horizon as f64;
        let kernel: Vec<f64> =
            (0..horizon).map(|t| (0..horizon).map(|f| weight(f) * phase(f, t).cos()).sum()).collect();
        let norm = kernel.iter().map(|k| k * k).sum::<f64>().sqrt();
        Self { kernel: kernel.iter().map(|k| (k / norm) as f32).collect() }
    }

    /// Colours the white noise of one candidate, `[horizon, dim]`, each of the `dim` numbers along the steps.
    pub fn paint(&self, noise: &mut [f32], scratch: &mut Vec<f32>) {
        let horizon = self.kernel.len();
        let dim = noise.len() / horizon;
        scratch.clear();
        scratch.extend_from_slice(noise);
        noise.fill(0.0);
        for (t, coloured) in noise.chunks_exact_mut(dim).enumerate() {
            for (from, white) in scratch.chunks_exact(dim).enumerate() {
                let share = self.kernel[(t + horizon - from) % horizon];
                coloured.iter_mut().zip(white).for_each(|(coloured, white)| *coloured += share * white);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussian;
    use swm_core::Key;

    #[test]
    fn without_an_exponent_noise_stays_white() {
        let colour = Colour::new(0.0, 7);
        assert!((colour.kernel[0] - 1.0).abs() < 1e-6 && colour.kernel[1..].iter().all(|k| k.abs() < 1e-6));
        assert_eq!(Colour::new(2.0, 1).kernel, [1.0]);
    }

    #[test]
    fn power_falls_as_the_exponent_says() {
        // The spectrum over many candidates, against f^-β; every number keeps the variance 1.
        let (horizon, dim, n) = (8, 2, 40_000);
        let colour = Colour::new(2.0, horizon);
        let (mut power, mut variance, mut scratch) = (vec![0.0; horizon], vec![0.0; horizon], vec![]);
        let mut noise = vec![0.0; n * horizon * dim];
        gaussian::fill(Key::new(1), 0, &mut noise);
        for candidate in noise.chunks_exact_mut(horizon * dim) {
            colour.paint(candidate, &mut scratch);
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
