//! SIGReg, the regulariser that keeps latents from collapsing (LeJEPA, arXiv 2511.08544; published settings: 17 knots
//! up to 3).
//!
//! The latents of a batch are projected on random directions, and the empirical characteristic function of each
//! projection is compared with that of a standard normal distribution by the Epps-Pulley statistic, integrated by the
//! trapezoid rule under a Gaussian window. Value and gradient are computed in one pass on the CPU. The characteristic
//! functions at equidistant knots are powers of one complex number, so a projection costs one sine and one cosine.

use burn::tensor::Tensor;
use rand_distr::{Distribution as _, StandardNormal};
use rayon::prelude::*;
use swm_core::Key;

/// The largest argument of the characteristic functions.
const LAST_KNOT: f32 = 3.0;

/// The lower bound of the length of a latent difference in [`straightening`].
const LENGTH_EPSILON: f64 = 1e-8;

/// Computes the temporal straightening loss (arXiv 2603.12231): the negative cosine between consecutive differences of
/// latents, averaged, from -1 for straight paths to 1.
///
/// # Shapes
/// `differences` is `[clips, steps - 1, latent]` with at least two differences; returns `[1]`.
pub fn straightening(differences: Tensor<3>) -> Tensor<1> {
    let [clips, count, latent] = differences.dims();
    let part = |from: usize, to: usize| differences.clone().slice([0..clips, from..to, 0..latent]);
    let (before, after) = (part(0, count - 1), part(1, count));
    let length = |difference: Tensor<3>| difference.square().sum_dim(2).clamp_min(LENGTH_EPSILON.powi(2)).sqrt();
    let cosine = (before.clone() * after.clone()).sum_dim(2) / (length(before) * length(after));
    cosine.mean().neg()
}

/// Draws random directions of unit length.
///
/// # Shapes
/// Returns `[count, dim]`.
pub fn directions(key: Key, dim: usize, count: usize) -> Vec<f32> {
    let mut rng = key.rng();
    let mut all = Vec::with_capacity(dim * count);
    for _ in 0..count {
        let direction: Vec<f32> = (0..dim).map(|_| StandardNormal.sample(&mut rng)).collect();
        let length = direction.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt().max(1e-12);
        all.extend(direction.iter().map(|v| (f64::from(*v) / length) as f32));
    }
    all
}

/// The trapezoidal rule over the arguments (knots) of the characteristic functions, from 0 to [`LAST_KNOT`].
struct Quadrature {
    /// The distance between neighbouring knots.
    spacing: f32,
    /// The characteristic function of the standard normal distribution at each knot.
    target: Vec<f32>,
    /// The weight of each knot: the trapezoidal weights of the knot and of the negated knot, times the Gaussian window.
    weights: Vec<f32>,
}

impl Quadrature {
    fn new(knots: usize) -> Self {
        let spacing = LAST_KNOT / (knots as f32 - 1.0);
        let target: Vec<f32> = (0..knots).map(|k| (-(k as f32 * spacing).powi(2) / 2.0).exp()).collect();
        let weights =
            (0..knots).map(|k| target[k] * spacing * if k == 0 || k == knots - 1 { 1.0 } else { 2.0 }).collect();
        Self { spacing, target, weights }
    }

    /// Returns the Epps-Pulley statistic of samples and the derivatives of the statistic with respect to the samples.
    fn statistic(&self, samples: impl ExactSizeIterator<Item = f32>) -> (f64, Vec<f32>) {
        let Self { spacing, target, weights } = self;
        let (knots, n) = (target.len(), samples.len() as f32);
        let (mut cos, mut sin) = (vec![0.0f32; knots], vec![0.0f32; knots]);
        let turns: Vec<(f32, f32)> = samples
            .map(|sample| {
                let (s, c) = (sample * spacing).sin_cos();
                let (mut re, mut im) = (1.0f32, 0.0f32);
                for k in 0..knots {
                    cos[k] += re;
                    sin[k] += im;
                    (re, im) = (re * c - im * s, re * s + im * c);
                }
                (c, s)
            })
            .collect();
        let mut statistic = 0.0f64;
        // Derivatives of the statistic with respect to the sums of cosines and sines, times the knot.
        let (mut by_cos, mut by_sin) = (vec![0.0f32; knots], vec![0.0f32; knots]);
        for k in 0..knots {
            let (real, imaginary) = (cos[k] / n - target[k], sin[k] / n);
            statistic += f64::from(weights[k] * (real * real + imaginary * imaginary) * n);
            let knot = k as f32 * spacing;
            by_cos[k] = 2.0 * weights[k] * real * knot;
            by_sin[k] = 2.0 * weights[k] * imaginary * knot;
        }
        let gradient = turns
            .iter()
            .map(|&(c, s)| {
                let (mut re, mut im, mut sum) = (1.0f32, 0.0f32, 0.0f32);
                for k in 0..knots {
                    sum += by_sin[k] * re - by_cos[k] * im;
                    (re, im) = (re * c - im * s, re * s + im * c);
                }
                sum
            })
            .collect();
        (statistic, gradient)
    }
}

/// Computes the Epps-Pulley statistic, `n ∫ |φ_n(t) - exp(-t²/2)|² exp(-t²/2) dt` averaged over steps and directions,
/// and the gradient of the average with respect to the latents.
///
/// # Shapes
/// `latents` is `[batch, steps, dim]`, `directions` is `[count, dim]`; the gradient has the shape of the latents.
pub fn sigreg(latents: &[f32], steps: usize, dim: usize, directions: &[f32], knots: usize) -> (f64, Vec<f32>) {
    let batch = latents.len() / (steps * dim);
    let count = directions.len() / dim;
    let quadrature = Quadrature::new(knots);

    // Every task returns the statistic of one step and direction and the gradient of the projections, so that the sums
    // below have the same order on any number of threads.
    let tasks: Vec<(f64, Vec<f32>)> = (0..steps * count)
        .into_par_iter()
        .map(|task| {
            let (step, direction) = (task / count, &directions[task % count * dim..][..dim]);
            quadrature.statistic((0..batch).map(|row| {
                let latent = &latents[(row * steps + step) * dim..][..dim];
                latent.iter().zip(direction).map(|(a, b)| a * b).sum()
            }))
        })
        .collect();

    let factor = 1.0 / (steps * count) as f32;
    let value = tasks.iter().map(|(statistic, _)| statistic).sum::<f64>() * f64::from(factor);
    let mut gradient = vec![0.0f32; latents.len()];
    gradient.par_chunks_mut(dim).enumerate().for_each(|(index, row)| {
        let (sample, step) = (index / steps, index % steps);
        for direction in 0..count {
            let slope = tasks[step * count + direction].1[sample] * factor;
            for (to, component) in row.iter_mut().zip(&directions[direction * dim..][..dim]) {
                *to += slope * component;
            }
        }
    });
    (value, gradient)
}
