//! [`Gaussian`]: the sampling distribution of CEM, iCEM, MPPI and predictive sampling.

use super::coloured_noise::ColouredNoise;
use super::normal_noise::{self, RUN};
use super::population::Population;
use super::problem::Bounds;
use rayon::prelude::*;
use swm_core::{Plan, PlanProblem, PlanTrace};

/// A diagonal Gaussian over the plans of one environment.
pub struct Gaussian {
    /// The mean, `[horizon, dim]`.
    pub mean: Vec<f32>,
    /// The standard deviation, `[horizon, dim]`.
    pub std: Vec<f32>,
    /// The trace of the search, one entry for each iteration.
    pub trace: PlanTrace,
    /// Scratch memory for the selection of elites.
    pub order: Vec<usize>,
}

impl Gaussian {
    /// The initial distribution of every environment: the mean is the initial guess (zeros without one), clipped to the
    /// bounds; the standard deviation is `sigma`.
    pub fn initial(problem: &PlanProblem<'_>, bounds: Bounds<'_>, sigma: f32) -> Vec<Self> {
        let len = problem.horizon * problem.space.dim();
        let initial = |env| {
            let mut mean = problem.init.map_or_else(|| vec![0.0; len], |init| init[env * len..][..len].to_vec());
            bounds.clip(&mut mean);
            Self { mean, std: vec![sigma; len], trace: PlanTrace::default(), order: vec![] }
        };
        (0..problem.keys.len()).map(initial).collect()
    }

    /// Draws the population of an iteration: `clip(mean + std ξ)` with standard normal ξ, filtered by `colour` if
    /// it is given. The first candidate of every environment is the mean.
    ///
    /// The noise of an environment and an iteration is one keyed sequence, in which every candidate has a fixed
    /// position: it does not depend on threads or on other environments.
    pub fn draw(
        distributions: &[Self],
        iteration: usize,
        bounds: Bounds<'_>,
        colour: Option<&ColouredNoise>,
        population: &mut Population,
    ) {
        let (len, all, min_len) = (population.len(), population.samples() * population.len(), population.min_len());
        let Population { actions, keys, .. } = population;
        let envs = actions.par_chunks_exact_mut(all).zip(distributions).enumerate().with_min_len(min_len);
        envs.for_each(|(env, (candidates, gaussian))| {
            let key = keys[env].at(iteration as u64);
            // The noise of `RUN` candidates is a whole number of runs, so the noise of every task begins at a run.
            let tasks = candidates.par_chunks_mut(RUN * len).enumerate().with_min_len(min_len);
            tasks.for_each_init(Vec::new, |scratch, (task, candidates)| {
                normal_noise::fill(key, task * len, candidates);
                for candidate in candidates.chunks_exact_mut(len) {
                    if let Some(colour) = colour {
                        colour.apply(candidate, scratch);
                    }
                    gaussian.scale(candidate);
                    bounds.clip(candidate);
                }
            });
            candidates[..len].copy_from_slice(&gaussian.mean);
        });
    }

    /// Turns standard normal noise into a candidate, both `[horizon, dim]`.
    pub fn scale(&self, noise: &mut [f32]) {
        for ((value, mean), std) in noise.iter_mut().zip(&self.mean).zip(&self.std) {
            *value = mean + std * *value;
        }
    }

    /// Returns the means as plans. The cost of a plan is the lowest of the last iteration.
    pub fn into_plan(distributions: Vec<Self>) -> Plan {
        let actions = distributions.iter().flat_map(|gaussian| &gaussian.mean).copied().collect();
        let trace: Vec<PlanTrace> = distributions.into_iter().map(|gaussian| gaussian.trace).collect();
        let costs = trace.iter().filter_map(|trace| trace.best.last().copied()).collect();
        Plan { actions, costs, trace }
    }
}
