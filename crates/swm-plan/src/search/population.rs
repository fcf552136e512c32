//! [`Population`]: the candidates of all environments that are planned together, and their costs.

use super::elites::Elites;
use super::normal_noise::RUN;
use super::problem::{count_values, evaluate, sizes};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use std::time::{Duration, Instant};
use swm_core::{Candidates, CostModel, Iteration, Key, Plan, PlanProblem, PlanTrace, Result};

/// Candidate action sequences of several environments, and their costs.
pub struct Population {
    /// The candidates, `[envs, samples, horizon, dim]`.
    pub actions: Vec<f32>,
    /// The cost of every candidate, `[envs, samples]`.
    pub costs: Vec<f32>,
    /// A key for each environment, from which all draws of the solver derive.
    pub(super) keys: Vec<Key>,
    samples: usize,
    horizon: usize,
    dim: usize,
    /// Whether the other threads of the pool sleep, or soon do: before the first evaluation, and after one that took long.
    asleep: bool,
}

/// The number of values that one thread draws in less time (30 to 50 µs) than it takes to wake others.
const SMALL: usize = 1 << 14;

/// The time for which threads without work stay awake at least.
const AWAKE: Duration = Duration::from_micros(5);

impl Population {
    /// Creates a population of zeros with `samples` candidates for each environment. Draws are keyed by `solver`, so
    /// they differ from the draws of other solvers.
    ///
    /// # Errors
    /// When the candidates have more values than `limits::CANDIDATE_VALUES`.
    pub fn new(solver: &str, problem: &PlanProblem<'_>, samples: usize) -> Result<Self> {
        let values = count_values(format!("candidates of {solver}"), sizes(problem), Some(samples))?;
        let keys: Vec<Key> = problem.keys.iter().map(|key| key.with(solver)).collect();
        let (horizon, dim) = (problem.horizon, problem.space.dim());
        let (actions, costs) = (vec![0.0; values], vec![0.0; keys.len() * samples]);
        Ok(Self { keys, samples, horizon, dim, actions, costs, asleep: true })
    }

    /// Creates a population around the initial guess: the first candidate is the guess, and every other candidate is
    /// drawn around the guess with the standard deviation `sigma` and its own key.
    ///
    /// # Errors
    /// As [`Population::new`].
    pub fn around(solver: &str, problem: &PlanProblem<'_>, samples: usize, sigma: f32) -> Result<Self> {
        let mut population = Self::new(solver, problem, samples)?;
        let (len, keys) = (population.len(), &population.keys);
        population.actions.par_chunks_exact_mut(len).enumerate().for_each(|(i, candidate)| {
            let (env, sample) = (i / samples, i % samples);
            if let Some(init) = problem.init {
                candidate.copy_from_slice(&init[env * len..][..len]);
            }
            if sample > 0 {
                add_noise(candidate, sigma, keys[env].with("start").at(sample as u64));
            }
        });
        Ok(population)
    }

    /// The number of values of one candidate, `horizon * dim`.
    #[allow(clippy::len_without_is_empty, reason = "the length of a candidate, which is never empty")]
    pub fn len(&self) -> usize {
        self.horizon * self.dim
    }

    /// The number of candidates of each environment.
    pub fn samples(&self) -> usize {
        self.samples
    }

    /// The number of values of one model step.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// The candidates as a model receives them.
    pub fn candidates(&self) -> Candidates<'_> {
        let Self { samples, horizon, dim, .. } = *self;
        Candidates { actions: &self.actions, envs: self.keys.len(), samples, horizon, dim }
    }

    /// The candidates, and the costs to write.
    pub(super) fn split(&mut self) -> (Candidates<'_>, &mut [f32]) {
        let Self { samples, horizon, dim, .. } = *self;
        (Candidates { actions: &self.actions, envs: self.keys.len(), samples, horizon, dim }, &mut self.costs)
    }

    /// Computes the cost of every candidate.
    ///
    /// # Errors
    /// When the model fails, or a cost is missing or not finite.
    pub fn evaluate(&mut self, cost: &mut dyn CostModel, iteration: usize) -> Result<()> {
        let (candidates, costs) = self.split();
        let begun = Instant::now();
        evaluate(cost, candidates, iteration, costs)?;
        self.asleep = begun.elapsed() > AWAKE;
        Ok(())
    }

    /// The fewest elements of a parallel iterator over the candidates that a thread takes: all of them if waking other threads takes
    /// longer than drawing the candidates. This decides who draws a candidate, not its values.
    pub(super) fn min_len(&self) -> usize {
        if self.asleep && self.actions.len() <= SMALL { usize::MAX } else { 1 }
    }

    /// Calls `write(env, sample, key, candidate)` for every candidate, in parallel. `key` is derived from the
    /// environment's key and the iteration.
    pub fn write(&mut self, iteration: usize, write: impl Fn(usize, usize, Key, &mut [f32]) + Sync) {
        let (len, all, min_len) = (self.len(), self.samples * self.len(), self.min_len());
        let keys = &self.keys;
        self.actions.par_chunks_exact_mut(all).with_min_len(min_len).enumerate().for_each(|(env, candidates)| {
            let key = keys[env].at(iteration as u64);
            let candidates = candidates.par_chunks_exact_mut(len).enumerate().with_min_len(min_len.max(RUN));
            candidates.for_each(|(sample, candidate)| write(env, sample, key, candidate));
        });
    }

    /// Replaces the candidates after the first one of every environment by `candidates`, `[n, horizon, dim]` for each
    /// environment.
    pub fn replace(&mut self, candidates: &[Vec<f32>]) {
        let (len, all) = (self.len(), self.samples * self.len());
        for (population, candidates) in self.actions.chunks_exact_mut(all).zip(candidates) {
            population[len..][..candidates.len()].copy_from_slice(candidates);
        }
    }

    /// Adds Gaussian noise with the standard deviation `sigma` to every candidate; each `round` has its own draws.
    pub fn perturb(&mut self, sigma: f32, round: usize) {
        if sigma > 0.0 {
            let (len, samples, keys) = (self.len(), self.samples, &self.keys);
            self.actions.par_chunks_exact_mut(len).enumerate().for_each(|(i, candidate)| {
                let (env, sample) = (i / samples, i % samples);
                add_noise(candidate, sigma, keys[env].with("noise").at(round as u64).at(sample as u64));
            });
        }
    }

    /// The `k` cheapest candidates of an environment. `order` is scratch memory.
    pub fn elites<'a>(&'a self, env: usize, k: usize, order: &'a mut Vec<usize>) -> Elites<'a> {
        let (len, n) = (self.len(), self.samples);
        Elites::select(&self.actions[env * n * len..][..n * len], &self.costs[env * n..][..n], k, order)
    }

    /// Shows an iteration to the observer of the problem; returns whether the search goes on. `elites` are the indices of
    /// each environment's elites, cheapest first.
    ///
    /// # Errors
    /// The error of the observer.
    pub fn observed<'a>(
        &self,
        problem: &PlanProblem<'_>,
        index: usize,
        elites: impl Iterator<Item = &'a [usize]>,
    ) -> Result<bool> {
        problem.observed(|| Iteration {
            index,
            candidates: self.candidates(),
            costs: &self.costs,
            elites: elites.flatten().copied().collect(),
            gradient: None,
        })
    }

    /// The index of the cheapest candidate of every environment; the first of several with the same cost.
    pub fn cheapest(&self) -> Vec<usize> {
        let lowest = |costs: &[f32]| (1..costs.len()).fold(0, |best, i| if costs[i] < costs[best] { i } else { best });
        self.costs.chunks_exact(self.samples).map(lowest).collect()
    }

    /// Appends an entry to the trace of every environment: the cost of its candidate `best`, the mean cost and the
    /// spread of its candidates.
    pub fn record(&self, trace: &mut [PlanTrace], best: &[usize]) {
        let len = self.len();
        let envs = self.costs.chunks_exact(self.samples).zip(self.actions.chunks_exact(self.samples * len));
        for ((trace, &best), (costs, actions)) in trace.iter_mut().zip(best).zip(envs) {
            trace.best.push(costs[best]);
            trace.mean.push(average(costs));
            trace.spread.push(spread(actions, len));
        }
    }

    /// Returns candidate `best` of every environment as its plan.
    pub fn plan(&self, best: &[usize], trace: Vec<PlanTrace>) -> Plan {
        let rows = || best.iter().enumerate().map(|(env, &sample)| env * self.samples + sample);
        let actions = rows().flat_map(|row| &self.actions[row * self.len()..][..self.len()]).copied().collect();
        Plan { actions, costs: rows().map(|row| self.costs[row]).collect(), trace }
    }
}

/// Calls `iteration` for 0, 1, … until all iterations are done, it returns false, or the deadline has passed, but at
/// least once.
///
/// The function enters the thread pool once for each plan, because every entry from outside the pool takes as long as
/// drawing a population.
///
/// # Errors
/// When an iteration fails.
pub fn iterate(
    iterations: usize,
    problem: &PlanProblem<'_>,
    mut iteration: impl FnMut(usize) -> Result<bool> + Send,
) -> Result<()> {
    if problem.keys.is_empty() {
        return Ok(());
    }
    rayon::scope(|_| {
        for i in 0..iterations {
            if !iteration(i)? || problem.is_late() {
                break;
            }
        }
        Ok(())
    })
}

/// Adds Gaussian noise with the standard deviation `sigma`, drawn from `key`.
pub fn add_noise(values: &mut [f32], sigma: f32, key: Key) {
    let mut rng = key.rng();
    values.iter_mut().for_each(|value| *value += sigma * rng.sample::<f32, _>(StandardNormal));
}

/// Returns the mean of `values`, summed in double precision.
pub fn average(values: &[f32]) -> f32 {
    (values.iter().map(|&value| f64::from(value)).sum::<f64>() / values.len() as f64) as f32
}

/// The standard deviation over candidates `[samples, len]`, averaged over the values of a candidate.
fn spread(candidates: &[f32], len: usize) -> f32 {
    let samples = (candidates.len() / len) as f64;
    let deviation = |j: usize| {
        let values = || candidates[j..].iter().step_by(len).map(|&v| f64::from(v));
        let mean = values().sum::<f64>() / samples;
        (values().map(|v| (v - mean).powi(2)).sum::<f64>() / samples).sqrt()
    };
    ((0..len).map(deviation).sum::<f64>() / len as f64) as f32
}
