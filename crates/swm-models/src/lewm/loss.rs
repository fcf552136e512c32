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
use swm_kernels::{EppsPulley, Statistics};

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

/// Computes the Epps-Pulley statistic, `n ∫ |φ_n(t) - exp(-t²/2)|² exp(-t²/2) dt` averaged over steps and directions,
/// and the gradient of the average with respect to the latents.
///
/// # Shapes
/// `latents` is `[batch, steps, dim]`, `directions` is `[count, dim]`; the gradient has the shape of the latents.
pub fn sigreg(latents: &[f32], steps: usize, dim: usize, directions: &[f32], knots: usize) -> (f64, Vec<f32>) {
    let count = directions.len() / dim;
    let rule = EppsPulley::new(knots);
    let groups: Vec<&[f32]> = directions.chunks(EppsPulley::DIRECTIONS * dim).collect();

    // Every task returns the statistics of one step and some directions and the gradient of the projections, so that the sums
    // below have the same order on any number of threads.
    let tasks: Vec<Statistics> = (0..steps * groups.len())
        .into_par_iter()
        .map(|task| {
            let (step, group) = (task / groups.len(), groups[task % groups.len()]);
            rule.statistics(&latents[step * dim..], steps * dim, group, dim)
        })
        .collect();

    let factor = 1.0 / (steps * count) as f32;
    let value = tasks.iter().flat_map(|task| task.values).sum::<f64>() * f64::from(factor);
    let mut gradient = vec![0.0f32; latents.len()];
    gradient.par_chunks_mut(dim).enumerate().for_each(|(index, row)| {
        let (sample, step) = (index / steps, index % steps);
        for (task, group) in tasks[step * groups.len()..].iter().zip(&groups) {
            for (slope, direction) in task.slopes[sample].iter().zip(group.chunks_exact(dim)) {
                let slope = slope * factor;
                row.iter_mut().zip(direction).for_each(|(to, component)| *to += slope * component);
            }
        }
    });
    (value, gradient)
}
