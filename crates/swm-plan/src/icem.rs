//! [`ICem`]: the improved cross-entropy method.
//!
//! Pinneri et al., *Sample-efficient Cross-Entropy Method for Real-time Planning* (CoRL 2020), as algorithm "Improved
//! Cross-Entropy Method Solver" of the stable-worldmodel paper: [`Cem`](crate::Cem) with noise that is coloured along the
//! model steps (`colour.rs`), the best elites of one iteration among the candidates of the next, and momentum
//! on both moments. Candidates are `[envs, samples, horizon, dim]` and clipped to the bounds. The defaults are the
//! reference's (`solver/icem.py`); the paper names none.
//!
//! The colour runs along the model steps; the actions of an action block are numbers of one step, each with noise of its
//! own, as in the reference.
//!
//! Of the original publication, the stable-worldmodel paper leaves out that the population shrinks from iteration to
//! iteration, that elites outlive a replan, and that the best action ever seen is executed; so does this file.
//!
//! Deviations from the paper and the reference, on purpose:
//! - Coloured noise has the variance 1, as in the original publication. The reference divides the noise of every
//!   candidate by its own deviation along the steps, which makes a candidate the larger the more constant it is.
//! - As in CEM: the standard deviation of elites is unbiased, draws are keyed, equal costs are ordered by index, costs
//!   that are not finite are errors, and [`Plan::costs`] is the lowest cost of the last iteration.

use crate::colour::Colour;
use crate::problem::continuous;
use crate::sampling::{Belief, Samples, Settings, average, search};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "icem";

/// The improved cross-entropy method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ICem {
    /// Candidates an iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that refit the distribution, E.
    pub elites: usize,
    /// The first standard deviation, σ₀, in model action units.
    pub sigma: f32,
    /// The exponent of the noise's colour, β: 0 is white, 1 pink, 2 red.
    pub beta: f32,
    /// How much of the last distribution is kept, α.
    pub momentum: f32,
    /// Elites that are candidates of the next iteration too.
    pub keep: usize,
}

impl Default for ICem {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, sigma: 1.0, beta: 2.0, momentum: 0.1, keep: 5 }
    }
}

impl Solver for ICem {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(ID, cost, &problem)?;
        let colour = Colour::new(self.beta, problem.horizon);
        let mut beliefs = Belief::start(&problem, bounds, self.sigma);
        let mut samples = Samples::new(ID, &problem, self.samples);
        let mut kept = vec![vec![]; beliefs.len()];

        search(self.iterations, &problem, |iteration| {
            samples.draw(iteration, &beliefs, bounds, Some(&colour));
            samples.replace(&kept);
            samples.score(cost, iteration)?;
            let states = beliefs.par_iter_mut().zip(&mut kept).enumerate();
            states.for_each(|(env, (Belief { mean, std, trace, order }, kept))| {
                let elites = samples.of(env).elites(self.elites, order);
                kept.clear();
                kept.extend(elites.actions().take(self.keep).flatten());
                elites.refit(self.momentum, mean, std);
                elites.note(trace, average(std));
            });
            Ok(())
        })?;
        Ok(Belief::plan(beliefs))
    }
}

impl ICem {
    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.some("iterations", self.iterations)?;
        settings.elites(self.elites, 2, self.samples)?;
        settings.positive("sigma", self.sigma)?;
        settings.not_negative("beta", self.beta)?;
        settings.momentum(self.momentum)?;
        // The mean is a candidate too, so not all of them can be kept ones.
        settings.at_most("keep", self.keep, self.elites.min(self.samples - 1), "elites and candidates beside the mean")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{self, DIM, ELITES, HORIZON};

    #[test]
    fn updates_are_the_references() {
        let (momentum, keep, len) = (0.25, 2, HORIZON * DIM);
        let (mut belief, mut kept) = (golden::begin(), Vec::<f32>::new());
        for update in golden::updates(ID) {
            // Their noise of a candidate is divided by its deviation along the steps; white noise enters ours.
            let mut ours = update.noise.clone();
            let colour = Colour::new(2.0, HORIZON);
            ours.chunks_exact_mut(len).for_each(|noise| {
                colour.paint(noise, &mut vec![]);
                divide_by_deviation(noise);
            });
            let coloured = golden::Update { noise: ours, ..golden::Update::default() };
            let mut candidates = golden::candidates(&coloured, &belief, 1.0);
            candidates[len..][..kept.len()].copy_from_slice(&kept);
            golden::assert_near(&candidates, &update.candidates);

            let elites = update.population().elites(ELITES, &mut belief.order);
            kept = elites.actions().take(keep).flatten().copied().collect();
            elites.refit(momentum, &mut belief.mean, &mut belief.std);
            golden::assert_near(&belief.mean, &update.mean);
            golden::assert_near(&belief.std, &update.var);
        }
    }

    fn divide_by_deviation(noise: &mut [f32]) {
        for j in 0..DIM {
            let steps = || noise[j..].iter().step_by(DIM);
            let mean = steps().sum::<f32>() / HORIZON as f32;
            let deviation = (steps().map(|v| (v - mean).powi(2)).sum::<f32>() / (HORIZON - 1) as f32).sqrt();
            noise[j..].iter_mut().step_by(DIM).for_each(|v| *v /= deviation);
        }
    }
}
