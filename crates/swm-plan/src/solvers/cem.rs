//! [`Cem`]: the cross-entropy method.
//!
//! Rubinstein and Kroese, *The Cross-Entropy Method* (2004), as algorithm "CEM solver" of the stable-worldmodel paper.
//! Each iteration samples a diagonal Gaussian over action sequences and refits it to the cheapest samples (the elites);
//! the last mean is the plan. The first candidate of every iteration is the mean itself. Candidates are
//! `[envs, samples, horizon, dim]`. The defaults are those of the paper's experiments and of the reference
//! implementation.
//!
//! The paper leaves two points open:
//! - The standard deviation of the elites is the unbiased one (divided by `elites - 1`), as in the reference
//!   (`solver/cem.py` calls `std` with its default). Therefore at least two elites are required.
//! - `sigma` is the initial standard deviation σ₀; the reference calls it `var_scale` and uses it in the same way.
//!
//! Intended differences from the paper and the reference:
//! - Candidates are clipped to the bounds of the problem, the first one included. Without clipping, the model would
//!   evaluate actions that differ from the executed ones, which the environment clips. Infinite bounds give the paper's
//!   algorithm.
//! - Every candidate has a fixed position in a random stream keyed by (plan key, iteration); the reference draws all
//!   environments from one generator. A plan has the same bytes for any set of environments planned in the same call
//!   and any number of threads.
//! - Equal costs are ordered by index; costs that are not finite are errors.
//! - [`Plan::costs`] is the lowest cost of the last iteration; the reference reports the mean cost of the elites, which
//!   is in the trace here.

use crate::entry::{ActionKind, Family, SolverEntry, defaults, make};
use crate::search::{Gaussian, Population, Settings, average, continuous, iterate};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "cem";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "refits a Gaussian to the cheapest samples",
    family: Family::Sampling,
    actions: ActionKind::Continuous,
    needs: &[],
    paper: "Rubinstein and Kroese, The Cross-Entropy Method, 2004",
    defaults: defaults::<Cem>,
    make: make::<Cem>,
};

/// Settings of the cross-entropy method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Cem {
    /// Candidates per iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that the distribution is refitted to, E.
    pub elites: usize,
    /// The initial standard deviation, σ₀, in model action units.
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
        let bounds = continuous(&ENTRY, cost, &problem)?;
        let mut gaussians = Gaussian::initial(&problem, bounds, self.sigma);
        let mut population = Population::new(ID, &problem, self.samples)?;

        iterate(self.iterations, &problem, |iteration| {
            Gaussian::draw(&gaussians, iteration, bounds, None, &mut population);
            population.evaluate(cost, iteration)?;
            gaussians.par_iter_mut().enumerate().for_each(|(env, Gaussian { mean, std, trace, order })| {
                let elites = population.elites(env, self.elites, order);
                elites.refit(0.0, mean, std);
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
        settings.elites(self.elites, 2, self.samples)?;
        settings.positive("sigma", self.sigma)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::golden;

    #[test]
    fn updates_equal_the_reference() {
        let mut gaussian = golden::initial();
        for update in golden::updates(ID) {
            golden::assert_near(&golden::candidates(&update, &gaussian, f32::INFINITY), &update.candidates);
            update.elites(&mut gaussian.order).refit(0.0, &mut gaussian.mean, &mut gaussian.std);
            golden::assert_near(&gaussian.mean, &update.mean);
            golden::assert_near(&gaussian.std, &update.var);
        }
    }
}
