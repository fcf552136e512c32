//! [`Cem`]: the cross-entropy method.
//!
//! Rubinstein and Kroese, *The Cross-Entropy Method* (2004), as algorithm "CEM solver" of the
//! stable-worldmodel paper: a diagonal Gaussian over action sequences is sampled, its cheapest samples (the
//! elites) refit it, and the last mean is the plan. The first candidate of every iteration is the mean itself.
//! Candidates are `[envs, samples, horizon, dim]`. The defaults are those of the paper's experiments and the reference's.
//!
//! What the paper leaves open, and how it is decided here:
//! - The standard deviation of the elites is the unbiased one (divided by `elites - 1`), as in the reference
//!   implementation (`solver/cem.py` calls `std` with its default). So there must be at least two elites.
//! - `sigma` is the first standard deviation, as in the paper's σ₀; the reference calls it `var_scale` and uses
//!   it in the same way.
//!
//! Deviations from the paper and the reference, on purpose:
//! - Candidates are clipped to the bounds of the problem, the first one included. Neither the paper's algorithm
//!   nor the reference clips here: their model then judges actions that the environment would clip before
//!   executing, so the plan's cost is not the cost of what happens. Infinite bounds give their algorithm.
//! - Every candidate has its own place in a stream keyed by (plan key, iteration), where the reference draws all
//!   environments from one generator. A plan is the same bytes whichever other environments are planned
//!   in the call, and for any number of threads.
//! - Equal costs are ordered by index; costs that are not finite are errors.
//! - [`Plan::costs`] is the lowest cost of the last iteration; the reference reports the elites' mean, which
//!   is in the trace here.

use crate::problem::continuous;
use crate::sampling::{Belief, Samples, Settings, average, search};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "cem";

/// The cross-entropy method; the defaults are those of the paper's experiments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Cem {
    /// Candidates an iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that refit the distribution, E.
    pub elites: usize,
    /// The first standard deviation, σ₀, in model action units.
    pub sigma: f32,
}

impl Default for Cem {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, sigma: 1.0 }
    }
}

impl Solver for Cem {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(ID, cost, &problem)?;
        let mut beliefs = Belief::start(&problem, bounds, self.sigma);
        let mut samples = Samples::new(ID, &problem, self.samples);

        search(self.iterations, &problem, |iteration| {
            samples.draw(iteration, &beliefs, bounds, None);
            samples.score(cost, iteration)?;
            beliefs.par_iter_mut().enumerate().for_each(|(env, Belief { mean, std, trace, order })| {
                let elites = samples.of(env).elites(self.elites, order);
                elites.refit(0.0, mean, std);
                elites.note(trace, average(std));
            });
            Ok(())
        })?;
        Ok(Belief::plan(beliefs))
    }
}

impl Cem {
    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.some("iterations", self.iterations)?;
        settings.elites(self.elites, 2, self.samples)?;
        settings.positive("sigma", self.sigma)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;

    #[test]
    fn updates_are_the_references() {
        let mut belief = golden::begin();
        for update in golden::updates(ID) {
            golden::assert_near(&golden::candidates(&update, &belief, f32::INFINITY), &update.candidates);
            let elites = update.population().elites(golden::ELITES, &mut belief.order);
            elites.refit(0.0, &mut belief.mean, &mut belief.std);
            golden::assert_near(&belief.mean, &update.mean);
            golden::assert_near(&belief.std, &update.var);
        }
    }
}
