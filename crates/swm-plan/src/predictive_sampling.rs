//! [`PredictiveSampling`]: the best of many guesses.
//!
//! Howell et al., *Predictive Sampling: Real-time Behaviour Synthesis with `MuJoCo`* (2022), as algorithm "Predictive
//! Sampling Solver" of the stable-worldmodel paper: the nominal plan and N - 1 candidates at random around it are tried
//! once, and the cheapest is the plan. What improves it is planning again from the last plan. Candidates are `[envs,
//! samples, horizon, dim]`. The defaults are the reference's (`solver/predictive_sampling.py`); the paper names none.
//!
//! Deviations from the paper and the reference, on purpose, all as in [`Cem`](crate::Cem): candidates are clipped to the
//! bounds, draws are keyed, the first of equal costs wins, and costs that are not finite are errors.

use crate::problem::continuous;
use crate::sampling::{Belief, Samples, Settings, search};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "predictive_sampling";

/// Predictive sampling.
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
        let settings = Settings(ID);
        settings.some("samples", self.samples)?;
        settings.positive("sigma", self.sigma)?;
        let bounds = continuous(ID, cost, &problem)?;
        let mut nominal = Belief::start(&problem, bounds, self.sigma);
        let mut samples = Samples::new(ID, &problem, self.samples);

        search(1, &problem, |iteration| {
            samples.draw(iteration, &nominal, bounds, None);
            samples.score(cost, iteration)?;
            nominal.par_iter_mut().enumerate().for_each(|(env, Belief { mean, trace, order, .. })| {
                let ranked = samples.of(env).elites(self.samples, order);
                ranked.note(trace, self.sigma);
                mean.copy_from_slice(ranked.best());
            });
            Ok(())
        })?;
        Ok(Belief::plan(nominal))
    }
}
