//! [`Mppi`]: model-predictive path integral control.
//!
//! Williams et al., *Aggressive Driving with Model Predictive Path Integral Control* (ICRA 2016), as algorithm "Model
//! Predictive Path Integral Solver" of the stable-worldmodel paper. The new mean is the weighted mean of the
//! candidates, with the weights `exp(-(cost - lowest cost) / λ)`; the standard deviation of the samples stays constant.
//! Only the cheapest `elites` are averaged; as many elites as samples give the original method. Candidates are
//! `[envs, samples, horizon, dim]`. The defaults are those of the reference (`solver/mppi.py`); the paper gives none.
//!
//! λ is in units of the cost. If λ is far below the differences of the costs, the cheapest candidate dominates the
//! mean; if λ is far above them, the mean hardly moves.
//!
//! Intended differences from the paper and the reference, all as in [`Cem`](crate::Cem): candidates are clipped to the
//! bounds, draws are keyed, equal costs are ordered by index, costs that are not finite are errors, and [`Plan::costs`]
//! is the lowest cost of the last iteration.

use crate::entry::{ActionKind, Family, SolverEntry, defaults, make};
use crate::search::{Elites, Gaussian, Population, Settings, average, continuous, iterate};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "mppi";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "averages the cheapest samples with weights that fall with the cost",
    family: Family::Sampling,
    actions: ActionKind::Continuous,
    needs: &[],
    paper: "Williams et al., Aggressive Driving with Model Predictive Path Integral Control, 2016",
    defaults: defaults::<Mppi>,
    make: make::<Mppi>,
};

/// Settings of model-predictive path integral control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Mppi {
    /// Candidates per iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that are averaged, E.
    pub elites: usize,
    /// The standard deviation of the candidates, σ₀, in model action units.
    pub sigma: f32,
    /// The temperature, λ, in units of the cost.
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
        let bounds = continuous(&ENTRY, cost, &problem)?;
        let mut gaussians = Gaussian::initial(&problem, bounds, self.sigma);
        let mut population = Population::new(ID, &problem, self.samples)?;
        let mut weights = vec![vec![]; gaussians.len()];

        iterate(self.iterations, &problem, |iteration| {
            Gaussian::draw(&gaussians, iteration, bounds, None, &mut population);
            population.evaluate(cost, iteration)?;
            let envs = gaussians.par_iter_mut().zip(&mut weights).enumerate();
            envs.for_each(|(env, (Gaussian { mean, std, trace, order }, weights))| {
                let elites = population.elites(env, self.elites, order);
                self.weigh(elites, weights);
                elites.weighted_mean(weights, mean);
                elites.record(trace, average(std));
            });
            population.observed(&problem, iteration, gaussians.iter().map(|gaussian| &gaussian.order[..self.elites]))
        })?;
        Ok(Gaussian::into_plan(gaussians))
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.iterations("iterations", self.iterations)?;
        settings.samples(self.samples)?;
        settings.elites(self.elites, 1, self.samples)?;
        settings.positive("sigma", self.sigma)?;
        settings.positive("temperature", self.temperature)
    }
}

impl Mppi {
    /// Writes the weights of the elites: they fall exponentially with the cost and add up to 1.
    fn weigh(&self, elites: Elites<'_>, weights: &mut Vec<f64>) {
        let cost = |i| f64::from(elites.cost(i));
        weights.clear();
        weights.extend((0..elites.count()).map(|i| (-(cost(i) - cost(0)) / f64::from(self.temperature)).exp()));
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::golden;

    #[test]
    fn updates_equal_the_reference() {
        let mut gaussian = golden::initial();
        let (mppi, mut weights) = (Mppi { temperature: 0.5, ..Mppi::default() }, vec![]);
        for update in golden::updates(ID) {
            golden::assert_near(&golden::candidates(&update, &gaussian, f32::INFINITY), &update.candidates);
            let elites = update.elites(&mut gaussian.order);
            mppi.weigh(elites, &mut weights);
            elites.weighted_mean(&weights, &mut gaussian.mean);
            golden::assert_near(&gaussian.mean, &update.mean);
        }
    }
}
