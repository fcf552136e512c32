//! [`CategoricalCem`]: the cross-entropy method for discrete actions.
//!
//! Rubinstein and Kroese, *The Cross-Entropy Method* (2004), as algorithm "Categorical Cross-Entropy Method Solver" of
//! the stable-worldmodel paper. Every choice of a plan has a categorical distribution over its options. Each iteration
//! draws candidates and sets the probability of an option to its frequency among the elites. The first candidate of
//! every iteration is the mode (the most probable option of every choice); the last mode is the plan.
//!
//! A model step makes several choices, one after another: the actions of an action block, or the parts of a
//! multi-discrete action. Candidates and the plan are `[envs, samples, horizon, dim]` with a one-hot vector for each
//! choice, where `dim` is the number of options of all choices. The defaults are those of the reference
//! (`solver/categorical_cem.py`); the paper gives none.
//!
//! Intended differences from the paper and the reference:
//! - An option is drawn by inverting the distribution function, with one random number per choice instead of one Gumbel
//!   number per option. The distribution of the draws is the same.
//! - An option of probability 0 is never drawn again; the reference leaves it a probability of 10⁻¹⁰.
//! - An initial guess, which the paper does not have and the reference ignores, gets half of the probability; the other
//!   half is uniform.
//! - As in [`Cem`](crate::Cem): draws are keyed, equal costs are ordered by index (equal probabilities too), costs that
//!   are not finite are errors, and [`Plan::costs`] is the lowest cost of the last iteration.
//!
//! The spread in the trace is the probability that two draws of a choice differ, `1 - Σ π²`, averaged over the choices.

use crate::entry::{ActionKind, Family, SolverEntry, defaults, make};
use crate::search::{Elites, Population, Settings, discrete, iterate};
use rand::RngCore as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use swm_core::{CostModel, Key, Plan, PlanProblem, PlanTrace, Result, Solver};

const ID: &str = "categorical_cem";

/// The part of an initial distribution's probability that is given to the initial guess.
const GUESS: f32 = 0.5;

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "refits the probability of every option to the cheapest samples",
    family: Family::Sampling,
    actions: ActionKind::Discrete,
    needs: &[],
    paper: "Rubinstein and Kroese, The Cross-Entropy Method, 2004",
    defaults: defaults::<CategoricalCem>,
    make: make::<CategoricalCem>,
};

/// Settings of the cross-entropy method for discrete actions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CategoricalCem {
    /// Candidates per iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that the distributions are refitted to, E.
    pub elites: usize,
    /// Added to the frequency of every option among the elites, δ; above 0, every option keeps a positive probability.
    pub smoothing: f32,
    /// The weight of the previous distributions, α.
    pub momentum: f32,
}

impl Default for CategoricalCem {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, smoothing: 0.0, momentum: 0.0 }
    }
}

/// The sampling distribution over the plans of one environment.
struct Categorical {
    /// The probability of every option, `[horizon, dim]`.
    probabilities: Vec<f32>,
    /// The most probable option of every choice, one-hot, `[horizon, dim]`.
    mode: Vec<f32>,
    trace: PlanTrace,
    /// Scratch memory for the selection of elites.
    order: Vec<usize>,
}

impl Solver for CategoricalCem {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let choices = discrete(&ENTRY, cost, &problem)?;
        let mut distributions = Categorical::initial(&problem, choices);
        let mut population = Population::new(ID, &problem, self.samples)?;

        iterate(self.iterations, &problem, |iteration| {
            population.write(iteration, |env, sample, key, candidate| match sample {
                0 => candidate.copy_from_slice(&distributions[env].mode),
                _ => draw(&distributions[env].probabilities, choices, key, sample, candidate),
            });
            population.evaluate(cost, iteration)?;
            distributions.par_iter_mut().enumerate().for_each(|(env, distribution)| {
                let Categorical { probabilities, mode, trace, order } = distribution;
                let elites = population.elites(env, self.elites, order);
                self.refit(elites, choices, probabilities);
                write_mode(probabilities, choices, mode);
                elites.record(trace, spread(probabilities, choices));
            });
            population.observed(&problem, iteration, distributions.iter().map(|it| &it.order[..self.elites]))
        })?;
        let (modes, trace): (Vec<_>, Vec<_>) = distributions.into_iter().map(|it| (it.mode, it.trace)).unzip();
        let costs = trace.iter().filter_map(|trace| trace.best.last().copied()).collect();
        Ok(Plan { actions: modes.concat(), costs, trace })
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.iterations("iterations", self.iterations)?;
        settings.samples(self.samples)?;
        settings.elites(self.elites, 1, self.samples)?;
        settings.not_negative("smoothing", self.smoothing)?;
        settings.momentum("momentum", self.momentum)
    }
}

impl CategoricalCem {
    /// Moves the probabilities towards the smoothed frequencies of the options among the elites.
    fn refit(&self, elites: Elites<'_>, choices: &[usize], probabilities: &mut [f32]) {
        for choice in ranges(choices, probabilities.len()) {
            let options = choice.len() as f32;
            for j in choice {
                let chosen = elites.actions().filter(|actions| actions[j] > 0.0).count();
                let frequency = chosen as f32 / elites.count() as f32;
                let smoothed = (frequency + self.smoothing) / (1.0 + options * self.smoothing);
                probabilities[j] = self.momentum * probabilities[j] + (1.0 - self.momentum) * smoothed;
            }
        }
    }
}

/// The index ranges of all choices of a plan of length `len`.
fn ranges(choices: &[usize], len: usize) -> impl Iterator<Item = Range<usize>> {
    let mut end = 0;
    choices.iter().cycle().map_while(move |&options| {
        let start = end;
        end += options;
        (end <= len).then_some(start..end)
    })
}

impl Categorical {
    /// The initial distribution of every environment: uniform, or half uniform and half the initial guess.
    fn initial(problem: &PlanProblem<'_>, choices: &[usize]) -> Vec<Self> {
        let len = problem.horizon * problem.space.dim();
        let initial = |env: usize| {
            let (mut probabilities, mut mode) = (vec![0.0; len], vec![0.0; len]);
            for choice in ranges(choices, len) {
                let uniform = 1.0 / choice.len() as f32;
                let guess = problem.init.map_or(&[][..], |init| &init[env * len..][choice.clone()]);
                let sum: f32 = guess.iter().sum();
                for (option, probability) in probabilities[choice].iter_mut().enumerate() {
                    *probability =
                        if sum > 0.0 { GUESS * guess[option] / sum + (1.0 - GUESS) * uniform } else { uniform };
                }
            }
            write_mode(&probabilities, choices, &mut mode);
            Self { probabilities, mode, trace: PlanTrace::default(), order: vec![] }
        };
        (0..problem.keys.len()).map(initial).collect()
    }
}

/// Draws one candidate, `[horizon, dim]`, from stream `sample` of the key.
fn draw(probabilities: &[f32], choices: &[usize], key: Key, sample: usize, candidate: &mut [f32]) {
    let mut rng = key.rng();
    rng.set_stream(sample as u64);
    candidate.fill(0.0);
    for choice in ranges(choices, probabilities.len()) {
        let mut left = (rng.next_u32() >> 8) as f32 / (1 << 24) as f32;
        let probabilities = &probabilities[choice.clone()];
        let drawn = probabilities.iter().position(|probability| {
            left -= probability;
            left < 0.0
        });
        // Rounded probabilities may add up to less than 1; the remainder goes to the last option that can be drawn.
        let drawn = drawn.or_else(|| probabilities.iter().rposition(|&p| p > 0.0)).unwrap_or(0);
        candidate[choice.start + drawn] = 1.0;
    }
}

/// Writes the first of the most probable options of every choice, as one-hot vectors `[horizon, dim]`.
fn write_mode(probabilities: &[f32], choices: &[usize], mode: &mut [f32]) {
    mode.fill(0.0);
    for choice in ranges(choices, probabilities.len()) {
        let best = |best: usize, j| if probabilities[j] > probabilities[best] { j } else { best };
        mode[choice.clone().fold(choice.start, best)] = 1.0;
    }
}

/// The probability that two draws of a choice differ, averaged over the choices.
fn spread(probabilities: &[f32], choices: &[usize]) -> f32 {
    let count = ranges(choices, probabilities.len()).count();
    1.0 - probabilities.iter().map(|p| p * p).sum::<f32>() / count as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::golden;
    use swm_core::PlanSpace;

    #[test]
    fn updates_equal_the_reference() {
        let solver = CategoricalCem { smoothing: 0.05, momentum: 0.25, ..CategoricalCem::default() };
        let (choices, mut probabilities, mut order) = ([3, 3], vec![1.0 / 3.0; golden::HORIZON * 6], vec![]);
        let mut mode = probabilities.clone();
        for update in golden::updates(ID) {
            write_mode(&probabilities, &choices, &mut mode);
            golden::assert_near(&mode, &update.candidates[..mode.len()]);
            solver.refit(update.elites(&mut order), &choices, &mut probabilities);
            golden::assert_near(&probabilities, &update.probs);
        }
    }

    #[test]
    fn draws_follow_the_probabilities() {
        let (probabilities, n) = ([0.5, 0.2, 0.3, 0.0, 1.0], 20_000);
        let (mut counts, mut candidate) = ([0.0; 5], [0.0; 5]);
        for sample in 0..n {
            draw(&probabilities, &[3, 2], Key::new(1), sample, &mut candidate);
            assert_eq!((candidate[..3].iter().sum::<f32>(), candidate[3..].iter().sum::<f32>()), (1.0, 1.0));
            counts.iter_mut().zip(candidate).for_each(|(count, drawn)| *count += drawn);
        }
        for (count, probabilities) in counts.iter().zip(probabilities) {
            assert!((count / n as f32 - probabilities).abs() < 0.02, "{counts:?}");
        }
    }

    #[test]
    fn initial_guess_gets_half_of_the_probability() {
        let space = PlanSpace::Discrete { choices: &[2, 2] };
        let init = [1.0, 0.0, 0.0, 0.0, 0.5, 1.5, 0.0, 1.0];
        let problem =
            PlanProblem { horizon: 2, space, keys: &[Key::new(0)], init: Some(&init), deadline: None, observer: None };
        let distribution = &Categorical::initial(&problem, &[2, 2])[0];
        assert_eq!(distribution.probabilities, [0.75, 0.25, 0.5, 0.5, 0.375, 0.625, 0.25, 0.75]);
        assert_eq!(distribution.mode, [1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
        assert_eq!(Categorical::initial(&PlanProblem { init: None, ..problem }, &[2, 2])[0].probabilities, [0.5; 8]);
    }
}
