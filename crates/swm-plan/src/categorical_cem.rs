//! [`CategoricalCem`]: the cross-entropy method for discrete actions.
//!
//! Rubinstein and Kroese, *The Cross-Entropy Method* (2004), as algorithm "Categorical Cross-Entropy Method Solver" of the
//! stable-worldmodel paper: every choice of a plan has its own distribution over its options, candidates are drawn from
//! all of them, and how often the elites chose an option becomes its probability. The first candidate of every
//! iteration is the mode, the most probable option of every choice; the last mode is the plan.
//!
//! A model step makes several choices, one after another: the B actions of an action block, or the parts of a
//! multi-discrete action. Candidates and the plan are `[envs, samples, horizon, dim]` with a one-hot vector for each
//! choice, `dim` options in all. The defaults are the reference's (`solver/categorical_cem.py`); the paper names none.
//!
//! Deviations from the paper and the reference, on purpose:
//! - An option is drawn by inverting the distribution function, with one random number a choice, instead of with one
//!   Gumbel number an option; the draws have the same distribution.
//! - An option of probability 0 is never drawn again; the reference leaves it a chance of 10⁻¹⁰.
//! - A first guess, which the paper does not have and the reference ignores, gets half of the probability, and all
//!   options share the other half.
//! - As in [`Cem`](crate::Cem): draws are keyed, equal costs are ordered by index (equal probabilities too), costs that are
//!   not finite are errors, and [`Plan::costs`] is the lowest cost of the last iteration.
//!
//! The spread in the trace is the chance that two draws of a choice differ, `1 - Σ π²`, averaged over the choices.

use crate::problem::discrete;
use crate::sampling::{Elites, Samples, Settings, finish, search};
use rand::RngCore as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use swm_core::{CostModel, Key, Plan, PlanProblem, PlanTrace, Result, Solver};

const ID: &str = "categorical_cem";

/// The probability of the first guess.
const GUESS: f32 = 0.5;

/// The cross-entropy method for discrete actions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CategoricalCem {
    /// Candidates an iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that refit the distributions, E.
    pub elites: usize,
    /// What is added to the share of elites of every option, δ; above 0, no option dies out.
    pub smoothing: f32,
    /// How much of the last distributions is kept, α.
    pub momentum: f32,
}

impl Default for CategoricalCem {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, smoothing: 0.0, momentum: 0.0 }
    }
}

/// What is believed of the plan of one environment.
struct Belief {
    /// The probability of every option, `[horizon, dim]`.
    odds: Vec<f32>,
    /// The most probable option of every choice, one-hot.
    mode: Vec<f32>,
    trace: PlanTrace,
    order: Vec<usize>,
}

impl Solver for CategoricalCem {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let choices = discrete(ID, cost, &problem)?;
        let mut beliefs = start(&problem, choices);
        let mut samples = Samples::new(ID, &problem, self.samples);

        search(self.iterations, &problem, |iteration| {
            samples.write(iteration, |env, sample, key, candidate| match sample {
                0 => candidate.copy_from_slice(&beliefs[env].mode),
                _ => draw(&beliefs[env].odds, choices, key, sample, candidate),
            });
            samples.score(cost, iteration)?;
            beliefs.par_iter_mut().enumerate().for_each(|(env, Belief { odds, mode, trace, order })| {
                let elites = samples.of(env).elites(self.elites, order);
                self.refit(elites, choices, odds);
                choose_likeliest(odds, choices, mode);
                elites.note(trace, spread(odds, choices));
            });
            Ok(())
        })?;
        let (modes, traces): (Vec<_>, Vec<_>) = beliefs.into_iter().map(|belief| (belief.mode, belief.trace)).unzip();
        Ok(finish(modes.concat(), traces))
    }
}

impl CategoricalCem {
    /// The elites' frequencies, smoothed, become the probabilities, as far as momentum lets them.
    #[allow(clippy::cast_precision_loss)]
    fn refit(&self, elites: Elites<'_>, choices: &[usize], odds: &mut [f32]) {
        for choice in places(choices, odds.len()) {
            let options = choice.len() as f32;
            for j in choice {
                let chosen = elites.actions().filter(|actions| actions[j] > 0.0).count();
                let share = chosen as f32 / elites.len() as f32;
                let smoothed = (share + self.smoothing) / (1.0 + options * self.smoothing);
                odds[j] = self.momentum * odds[j] + (1.0 - self.momentum) * smoothed;
            }
        }
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.some("iterations", self.iterations)?;
        settings.elites(self.elites, 1, self.samples)?;
        settings.not_negative("smoothing", self.smoothing)?;
        settings.momentum(self.momentum)
    }
}

/// Where the options of every choice of a plan stand among its numbers.
fn places(choices: &[usize], len: usize) -> impl Iterator<Item = Range<usize>> {
    let mut end = 0;
    choices.iter().cycle().map_while(move |&options| {
        let start = end;
        end += options;
        (end <= len).then_some(start..end)
    })
}

/// All options alike, or half alike and half as the first guess weighs them.
#[allow(clippy::cast_precision_loss)]
fn start(problem: &PlanProblem<'_>, choices: &[usize]) -> Vec<Belief> {
    let len = problem.horizon * problem.space.dim();
    let belief = |env: usize| {
        let (mut odds, mut mode) = (vec![0.0; len], vec![0.0; len]);
        for choice in places(choices, len) {
            let alike = 1.0 / choice.len() as f32;
            let guess = problem.init.map_or(&[][..], |init| &init[env * len..][choice.clone()]);
            let sum: f32 = guess.iter().sum();
            for (option, odds) in odds[choice].iter_mut().enumerate() {
                *odds = if sum > 0.0 { GUESS * guess[option] / sum + (1.0 - GUESS) * alike } else { alike };
            }
        }
        choose_likeliest(&odds, choices, &mut mode);
        Belief { odds, mode, trace: PlanTrace::default(), order: vec![] }
    };
    (0..problem.keys.len()).map(belief).collect()
}

/// Draws one candidate, from its own stream below the key.
#[allow(clippy::cast_precision_loss)]
fn draw(odds: &[f32], choices: &[usize], key: Key, sample: usize, candidate: &mut [f32]) {
    let mut rng = key.rng();
    rng.set_stream(sample as u64);
    candidate.fill(0.0);
    for choice in places(choices, odds.len()) {
        let mut left = (rng.next_u32() >> 8) as f32 / (1 << 24) as f32;
        let odds = &odds[choice.clone()];
        let drawn = odds.iter().position(|odds| {
            left -= odds;
            left < 0.0
        });
        // Probabilities may add up to a little less than 1: the rest belongs to the last option that has any.
        let drawn = drawn.or_else(|| odds.iter().rposition(|&odds| odds > 0.0)).unwrap_or(0);
        candidate[choice.start + drawn] = 1.0;
    }
}

/// Writes the most probable option of every choice, the first of equals, as one-hot vectors.
fn choose_likeliest(odds: &[f32], choices: &[usize], mode: &mut [f32]) {
    mode.fill(0.0);
    for choice in places(choices, odds.len()) {
        let likeliest = choice.clone().fold(choice.start, |best, j| if odds[j] > odds[best] { j } else { best });
        mode[likeliest] = 1.0;
    }
}

#[allow(clippy::cast_precision_loss)]
fn spread(odds: &[f32], choices: &[usize]) -> f32 {
    let count = places(choices, odds.len()).count();
    1.0 - odds.iter().map(|odds| odds * odds).sum::<f32>() / count as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;
    use swm_core::PlanSpace;

    #[test]
    fn updates_are_the_references() {
        let solver = CategoricalCem { smoothing: 0.05, momentum: 0.25, ..CategoricalCem::default() };
        let (choices, mut odds, mut order) = ([3, 3], vec![1.0 / 3.0; golden::HORIZON * 6], vec![]);
        let mut mode = odds.clone();
        for update in golden::updates(ID) {
            choose_likeliest(&odds, &choices, &mut mode);
            golden::assert_near(&mode, &update.candidates[..mode.len()]);
            solver.refit(update.population().elites(golden::ELITES, &mut order), &choices, &mut odds);
            golden::assert_near(&odds, &update.probs);
        }
    }

    #[test]
    fn options_are_drawn_as_often_as_they_are_probable() {
        let (odds, n) = ([0.5, 0.2, 0.3, 0.0, 1.0], 20_000);
        let (mut counts, mut candidate) = ([0.0; 5], [0.0; 5]);
        for sample in 0..n {
            draw(&odds, &[3, 2], Key::new(1), sample, &mut candidate);
            assert_eq!((candidate[..3].iter().sum::<f32>(), candidate[3..].iter().sum::<f32>()), (1.0, 1.0));
            counts.iter_mut().zip(candidate).for_each(|(count, drawn)| *count += drawn);
        }
        for (count, odds) in counts.iter().zip(odds) {
            assert!((count / n as f32 - odds).abs() < 0.02, "{counts:?}");
        }
    }

    #[test]
    fn a_first_guess_gets_half_of_the_probability() {
        let space = PlanSpace::Discrete { choices: &[2, 2] };
        let init = [1.0, 0.0, 0.0, 0.0, 0.5, 1.5, 0.0, 1.0];
        let problem = PlanProblem { horizon: 2, space, keys: &[Key::new(0)], init: Some(&init), deadline: None };
        let belief = &start(&problem, &[2, 2])[0];
        assert_eq!(belief.odds, [0.75, 0.25, 0.5, 0.5, 0.375, 0.625, 0.25, 0.75]);
        assert_eq!(belief.mode, [1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
        assert_eq!(start(&PlanProblem { init: None, ..problem }, &[2, 2])[0].odds, [0.5; 8]);
    }
}
