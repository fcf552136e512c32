//! [`Population`]: the candidates that a gradient solver moves, what they cost, and where the gradient points.

use crate::problem::{UNWRITTEN, check_costs, differentiable, score};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use swm_core::{Candidates, CostModel, Error, Key, Plan, PlanProblem, PlanTrace, Result};

/// Candidates of several environments.
///
/// # Shapes
/// `actions` and `gradient` are `[envs, samples, horizon, dim]`, `costs` is `[envs, samples]`.
pub struct Population {
    /// The candidates.
    pub actions: Vec<f32>,
    /// The gradient of each one's cost.
    pub gradient: Vec<f32>,
    /// What each costs.
    pub costs: Vec<f32>,
    /// One stream an environment, from which the draws of the solver derive.
    streams: Vec<Key>,
    /// Candidates of one environment.
    pub samples: usize,
    horizon: usize,
    dim: usize,
}

impl Population {
    /// `samples` candidates an environment: the first is where the problem says to start, the others lie around it with
    /// the standard deviation `sigma`. `solver` keeps the draws apart from those of other solvers.
    pub fn around(problem: &PlanProblem<'_>, samples: usize, sigma: f32, solver: &str) -> Self {
        let (horizon, dim) = (problem.horizon, problem.space.dim());
        let len = horizon * dim;
        let streams: Vec<Key> = problem.keys.iter().map(|key| key.with(solver)).collect();
        let mut actions = vec![0.0; streams.len() * samples * len];
        actions.par_chunks_exact_mut(len).enumerate().for_each(|(i, candidate)| {
            let (env, sample) = (i / samples, i % samples);
            if let Some(init) = problem.init {
                candidate.copy_from_slice(&init[env * len..][..len]);
            }
            if sample > 0 {
                add_noise(candidate, sigma, streams[env].with("start").at(sample as u64));
            }
        });
        let (gradient, costs) = (vec![0.0; actions.len()], vec![0.0; streams.len() * samples]);
        Self { actions, gradient, costs, streams, samples, horizon, dim }
    }

    /// Numbers of one candidate.
    pub fn len(&self) -> usize {
        self.horizon * self.dim
    }

    /// The candidates as a model sees them, and where it writes their costs and gradients.
    pub fn split(&mut self) -> (Candidates<'_>, &mut [f32], &mut [f32]) {
        let (envs, samples, horizon, dim) = (self.streams.len(), self.samples, self.horizon, self.dim);
        let candidates = Candidates { actions: &self.actions, envs, samples, horizon, dim };
        (candidates, &mut self.costs, &mut self.gradient)
    }

    /// Asks the model what every candidate costs.
    ///
    /// # Errors
    /// When the model fails or a cost is not finite.
    pub fn evaluate(&mut self, cost: &mut dyn CostModel, iteration: usize) -> Result<()> {
        let (candidates, costs, _) = self.split();
        score(cost, candidates, iteration, costs)
    }

    /// Asks the model for the gradients too.
    ///
    /// # Errors
    /// As [`Population::evaluate`], and when a number of a gradient is not finite.
    pub fn differentiate(&mut self, solver: &str, cost: &mut dyn CostModel, iteration: usize) -> Result<()> {
        let (candidates, costs, gradient) = self.split();
        costs.fill(UNWRITTEN);
        gradient.fill(UNWRITTEN);
        differentiable(solver, cost)?.cost_and_gradient(candidates, costs, gradient)?;
        check_costs(&self.costs, self.samples, iteration)?;
        self.check_gradient(iteration)
    }

    /// Checks that the gradient is finite.
    ///
    /// # Errors
    /// When it is not; says where.
    pub fn check_gradient(&self, iteration: usize) -> Result<()> {
        let Some(i) = self.gradient.iter().position(|g| !g.is_finite()) else {
            return Ok(());
        };
        let (step, candidate) = (i / self.dim % self.horizon, i / self.len());
        Err(Error::NotFinite {
            what: "the gradient of a candidate's cost".to_owned(),
            given: format!(
                "{} at step {step} for candidate {} of planned environment {} in iteration {iteration}",
                self.gradient[i],
                candidate % self.samples,
                candidate / self.samples
            ),
            fix: "the gradient explodes over this horizon or was not written: shorten the horizon, clip the gradient, take \
                  smaller steps, or check the checkpoint"
                .to_owned(),
        })
    }

    /// Moves every candidate at random by the standard deviation `scale`; draws differ between rounds.
    pub fn perturb(&mut self, scale: f32, round: usize) {
        if scale > 0.0 {
            let (len, samples, streams) = (self.len(), self.samples, &self.streams);
            self.actions.par_chunks_exact_mut(len).enumerate().for_each(|(i, candidate)| {
                let (env, sample) = (i / samples, i % samples);
                add_noise(candidate, scale, streams[env].with("noise").at(round as u64).at(sample as u64));
            });
        }
    }

    /// Notes how the search stands, and what the best candidate of every environment costs.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub fn record(&self, trace: &mut [PlanTrace], best: &[usize]) {
        let len = self.len();
        let sets = self.costs.chunks_exact(self.samples).zip(self.actions.chunks_exact(self.samples * len));
        for ((trace, &best), (costs, actions)) in trace.iter_mut().zip(best).zip(sets) {
            trace.best.push(costs[best]);
            trace.mean.push((costs.iter().map(|&c| f64::from(c)).sum::<f64>() / costs.len() as f64) as f32);
            trace.spread.push(spread(actions, len));
        }
    }

    /// One candidate of every environment as its plan.
    pub fn plan(&self, of: &[usize], trace: Vec<PlanTrace>) -> Plan {
        let rows = || of.iter().enumerate().map(|(env, &sample)| env * self.samples + sample);
        let actions = rows().flat_map(|row| &self.actions[row * self.len()..][..self.len()]).copied().collect();
        Plan { actions, costs: rows().map(|row| self.costs[row]).collect(), trace }
    }

    /// The cheapest candidate of every environment.
    pub fn cheapest(&self) -> Vec<usize> {
        self.costs.chunks_exact(self.samples).map(lowest).collect()
    }
}

/// Adds Gaussian noise of the standard deviation `scale`, drawn from `key`.
pub fn add_noise(numbers: &mut [f32], scale: f32, key: Key) {
    let mut rng = key.rng();
    numbers.iter_mut().for_each(|number| *number += scale * rng.sample::<f32, _>(StandardNormal));
}

/// Where the lowest cost stands; the first of equals.
pub fn lowest(costs: &[f32]) -> usize {
    (1..costs.len()).fold(0, |best, i| if costs[i] < costs[best] { i } else { best })
}

/// The standard deviation of the candidates `[samples, len]`, averaged over their numbers.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
fn spread(candidates: &[f32], len: usize) -> f32 {
    let samples = (candidates.len() / len) as f64;
    let deviation = |j: usize| {
        let values = || candidates[j..].iter().step_by(len).map(|&v| f64::from(v));
        let mean = values().sum::<f64>() / samples;
        (values().map(|v| (v - mean).powi(2)).sum::<f64>() / samples).sqrt()
    };
    ((0..len).map(deviation).sum::<f64>() / len as f64) as f32
}

/// What every gradient solver asks of its settings: something to do, and spreads that are finite and not negative.
///
/// # Errors
/// When a setting makes no sense; says which.
pub fn check_settings(solver: &str, samples: usize, iterations: usize, spreads: &[(&str, f32)]) -> Result<()> {
    for (name, value) in [("samples", samples), ("iterations", iterations)] {
        if value == 0 {
            return Err(Error::config(format!("{solver} {name}"), "0", "ask for at least 1"));
        }
    }
    match spreads.iter().find(|(_, value)| !(value.is_finite() && *value >= 0.0)) {
        None => Ok(()),
        Some((name, value)) => {
            let fix = "choose a finite number of at least 0";
            Err(Error::config(format!("{solver} {name}"), value.to_string(), fix))
        }
    }
}
