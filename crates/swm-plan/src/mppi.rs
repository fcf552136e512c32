//! [`Mppi`]: model-predictive path integral control.
//!
//! Williams et al., *Aggressive Driving with Model Predictive Path Integral Control* (ICRA 2016), as algorithm "Model
//! Predictive Path Integral Solver" of the stable-worldmodel paper: candidates around a mean pull it towards themselves,
//! each with the weight `exp(-(cost - least) / λ)`; the spread of the samples stays what it was. Candidates are `[envs,
//! samples, horizon, dim]`. Only the cheapest `elites` weigh; as many as there are samples give the original method. The
//! defaults are the reference's (`solver/mppi.py`); the paper names none.
//!
//! λ is in units of the cost: with λ far below the costs' differences the cheapest candidate wins alone, far above them
//! the mean hardly moves.
//!
//! Deviations from the paper and the reference, on purpose, all as in [`Cem`](crate::Cem): candidates are clipped to the
//! bounds, draws are keyed, equal costs are ordered by index, costs that are not finite are errors, and [`Plan::costs`] is
//! the lowest cost of the last iteration.

use crate::problem::continuous;
use crate::sampling::{Belief, Elites, Samples, Settings, average, search};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "mppi";

/// Model-predictive path integral control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Mppi {
    /// Candidates an iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that weigh in the mean, E.
    pub elites: usize,
    /// The standard deviation of the candidates, σ₀, in model action units.
    pub sigma: f32,
    /// How much a cost above the least one is forgiven, λ, in units of the cost.
    pub temperature: f32,
}

impl Default for Mppi {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, sigma: 1.0, temperature: 0.5 }
    }
}

impl Solver for Mppi {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(ID, cost, &problem)?;
        let mut beliefs = Belief::start(&problem, bounds, self.sigma);
        let mut samples = Samples::new(ID, &problem, self.samples);
        let mut weights = vec![vec![]; beliefs.len()];

        search(self.iterations, &problem, |iteration| {
            samples.draw(iteration, &beliefs, bounds, None);
            samples.score(cost, iteration)?;
            let states = beliefs.par_iter_mut().zip(&mut weights).enumerate();
            states.for_each(|(env, (Belief { mean, std, trace, order }, weights))| {
                let elites = samples.of(env).elites(self.elites, order);
                self.weigh(elites, weights);
                elites.weighted_mean(weights, mean);
                elites.note(trace, average(std));
            });
            Ok(())
        })?;
        Ok(Belief::plan(beliefs))
    }
}

impl Mppi {
    /// The weights of the elites: they fall exponentially with the cost and add up to 1.
    fn weigh(&self, elites: Elites<'_>, weights: &mut Vec<f64>) {
        let cost = |i| f64::from(elites.cost(i));
        weights.clear();
        weights.extend((0..elites.len()).map(|i| (-(cost(i) - cost(0)) / f64::from(self.temperature)).exp()));
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.some("iterations", self.iterations)?;
        settings.elites(self.elites, 1, self.samples)?;
        settings.positive("sigma", self.sigma)?;
        settings.positive("temperature", self.temperature)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;

    #[test]
    fn updates_are_the_references() {
        let mut belief = golden::begin();
        let (mppi, mut weights) = (Mppi { temperature: 0.5, ..Mppi::default() }, vec![]);
        for update in golden::updates(ID) {
            golden::assert_near(&golden::candidates(&update, &belief, f32::INFINITY), &update.candidates);
            let elites = update.population().elites(golden::ELITES, &mut belief.order);
            mppi.weigh(elites, &mut weights);
            elites.weighted_mean(&weights, &mut belief.mean);
            golden::assert_near(&belief.mean, &update.mean);
        }
    }
}
