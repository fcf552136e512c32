//! [`PredictiveSampling`]: evaluates many random candidates once and returns the cheapest.
//!
//! Howell et al., *Predictive Sampling: Real-time Behaviour Synthesis with `MuJoCo`* (2022), as algorithm "Predictive
//! Sampling Solver" of the stable-worldmodel paper: the nominal plan and N - 1 random candidates around it are
//! evaluated once, and the cheapest candidate is the plan. Plans improve because each replan starts from the last plan.
//! Candidates are `[envs, samples, horizon, dim]`. The defaults are those of the reference
//! (`solver/predictive_sampling.py`); the paper gives none.
//!
//! Intended differences from the paper and the reference, all as in [`Cem`](crate::Cem): candidates are clipped to the
//! bounds, draws are keyed, of equal costs the first is chosen, and costs that are not finite are errors.

use crate::entry::{ActionKind, Family, SolverEntry, defaults, make};
use crate::search::{Gaussian, Population, Settings, continuous, iterate};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "predictive_sampling";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "tries many guesses once and takes the cheapest",
    family: Family::Sampling,
    actions: ActionKind::Continuous,
    needs: &[],
    paper: "Howell et al., Predictive Sampling: Real-time Behaviour Synthesis with MuJoCo, 2022",
    defaults: defaults::<PredictiveSampling>,
    make: make::<PredictiveSampling>,
};

/// Settings of predictive sampling.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PredictiveSampling {
    /// Candidates, N.
    pub samples: usize,
    /// The standard deviation of the candidates, σ, in model action units.
    pub sigma: f32,
}

impl Default for PredictiveSampling {
    fn default() -> Self {
        Self { samples: 300, sigma: 1.0 }
    }
}

impl Solver for PredictiveSampling {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(&ENTRY, cost, &problem)?;
        let mut gaussians = Gaussian::initial(&problem, bounds, self.sigma);
        let mut population = Population::new(ID, &problem, self.samples)?;

        iterate(1, &problem, |iteration| {
            Gaussian::draw(&gaussians, iteration, bounds, None, &mut population);
            population.evaluate(cost, iteration)?;
            gaussians.par_iter_mut().enumerate().for_each(|(env, Gaussian { mean, trace, order, .. })| {
                let ranked = population.elites(env, self.samples, order);
                ranked.record(trace, self.sigma);
                mean.copy_from_slice(ranked.best());
            });
            population.observed(&problem, iteration, gaussians.iter().map(|gaussian| &gaussian.order[..self.samples]))
        })?;
        Ok(Gaussian::into_plan(gaussians))
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.samples(self.samples)?;
        settings.positive("sigma", self.sigma)
    }
}
