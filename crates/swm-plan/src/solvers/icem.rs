//! [`ICem`]: the improved cross-entropy method.
//!
//! Pinneri et al., *Sample-efficient Cross-Entropy Method for Real-time Planning* (CoRL 2020), as algorithm "Improved
//! Cross-Entropy Method Solver" of the stable-worldmodel paper. The method extends [`Cem`](crate::Cem) by noise that is
//! coloured along the model steps ([`ColouredNoise`]), by elites that stay among the candidates of the next iteration,
//! and by momentum on both moments. Candidates are `[envs, samples, horizon, dim]` and clipped to the bounds. The
//! defaults are those of the reference (`solver/icem.py`); the paper gives none.
//!
//! The actions of an action block are dimensions of one step, with independent noise, as in the reference, unless `block`
//! says how many there are: then the noise is coloured from action to action. A block of five independent actions moves
//! on average by 1/√5 of what a block of equal actions does, and demonstrations of Push-T change direction slowly.
//!
//! The stable-worldmodel paper omits three features of the original publication, and so does this solver: a population
//! that shrinks from iteration to iteration, elites that are reused after a replan, and executing the best action ever
//! found.
//!
//! Intended differences from the paper and the reference:
//! - Coloured noise has the variance 1, as in the original publication. The reference divides the noise of every
//!   candidate by its own standard deviation along the steps, which makes nearly constant candidates larger.
//! - As in CEM: the standard deviation of the elites is unbiased, draws are keyed, equal costs are ordered by index,
//!   costs that are not finite are errors, and [`Plan::costs`] is the lowest cost of the last iteration.

use crate::entry::{ActionKind, Family, SolverEntry, defaults, make};
use crate::search::{ColouredNoise, Gaussian, Population, Settings, average, continuous, iterate};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, PlanSpace, Result, Solver};

const ID: &str = "icem";

/// The largest exponent of the noise's spectrum. The noise hardly changes above it, and the weights of long plans would become
/// infinite.
const MAX_BETA: f32 = 10.0;

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "CEM with coloured noise, kept elites and momentum",
    family: Family::Sampling,
    actions: ActionKind::Continuous,
    needs: &[],
    paper: "Pinneri et al., Sample-efficient Cross-Entropy Method for Real-time Planning, 2020",
    defaults: defaults::<ICem>,
    make: make::<ICem>,
};

/// Settings of the improved cross-entropy method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ICem {
    /// Candidates per iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that the distribution is refitted to, E.
    pub elites: usize,
    /// The initial standard deviation, σ₀, in model action units.
    pub sigma: f32,
    /// The exponent of the noise's spectrum, β, at most 10: 0 is white, 1 pink, 2 red.
    pub beta: f32,
    /// The number of actions in a model step, the action block, from one to the next of which the noise is coloured; 1
    /// draws the actions of a step independently, as the reference does.
    pub block: usize,
    /// The weight of the previous distribution, α.
    pub momentum: f32,
    /// The number of elites that are also candidates of the next iteration.
    pub keep: usize,
}

impl Default for ICem {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, sigma: 1.0, beta: 2.0, block: 1, momentum: 0.1, keep: 5 }
    }
}

impl Solver for ICem {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(&ENTRY, cost, &problem)?;
        self.check_space(problem.space)?;
        // `[horizon, block * action]` is `[horizon * block, action]`.
        let colour = ColouredNoise::new(self.beta, problem.horizon * self.block);
        let mut gaussians = Gaussian::initial(&problem, bounds, self.sigma);
        let mut population = Population::new(ID, &problem, self.samples)?;
        let mut kept = vec![vec![]; gaussians.len()];

        iterate(self.iterations, &problem, |iteration| {
            Gaussian::draw(&gaussians, iteration, bounds, Some(&colour), &mut population);
            population.replace(&kept);
            population.evaluate(cost, iteration)?;
            let envs = gaussians.par_iter_mut().zip(&mut kept).enumerate();
            envs.for_each(|(env, (Gaussian { mean, std, trace, order }, kept))| {
                let elites = population.elites(env, self.elites, order);
                kept.clear();
                kept.extend(elites.actions().take(self.keep).flatten());
                elites.refit(self.momentum, mean, std);
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
        settings.positive("sigma", self.sigma)?;
        let fix = format!("choose a number of 0 to {MAX_BETA}: 0 is white noise, 1 pink, 2 red");
        settings.check((0.0..=MAX_BETA).contains(&self.beta), "beta", self.beta, &fix)?;
        settings.at_least_one("block", self.block)?;
        settings.momentum("momentum", self.momentum)?;
        // The first candidate is always the mean, so at most `samples - 1` elites can be kept.
        settings.at_most(
            "keep",
            self.keep,
            self.elites.min(self.samples - 1),
            "elites and of candidates after the mean",
        )
    }

    fn check_space(&self, space: PlanSpace<'_>) -> Result<()> {
        let dim = space.dim();
        let block = format!("{} for {dim} dimensions of a model step", self.block);
        let fix = "give the action block of the model, or 1";
        Settings(ID).check(dim.is_multiple_of(self.block), "block", block, fix)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::golden::{self, DIM, HORIZON};

    #[test]
    fn updates_equal_the_reference() {
        let (momentum, keep, len) = (0.25, 2, HORIZON * DIM);
        let (mut gaussian, mut kept) = (golden::initial(), Vec::<f32>::new());
        for update in golden::updates(ID) {
            // The reference divides the noise of a candidate by its deviation along the steps; the recorded noise is
            // white.
            let mut ours = update.noise.clone();
            let colour = ColouredNoise::new(2.0, HORIZON);
            ours.chunks_exact_mut(len).for_each(|noise| {
                colour.apply(noise, &mut vec![]);
                divide_by_deviation(noise);
            });
            let coloured = golden::Update { noise: ours, ..golden::Update::default() };
            let mut candidates = golden::candidates(&coloured, &gaussian, 1.0);
            candidates[len..][..kept.len()].copy_from_slice(&kept);
            golden::assert_near(&candidates, &update.candidates);

            let elites = update.elites(&mut gaussian.order);
            kept = elites.actions().take(keep).flatten().copied().collect();
            elites.refit(momentum, &mut gaussian.mean, &mut gaussian.std);
            golden::assert_near(&gaussian.mean, &update.mean);
            golden::assert_near(&gaussian.std, &update.var);
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
