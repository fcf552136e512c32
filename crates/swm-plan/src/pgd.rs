//! [`Pgd`]: projected gradient descent on probabilities of discrete actions.
//!
//! Algorithm "Projected Gradient Descent Solver" of the stable-worldmodel paper, after Henaff, Whitney and `LeCun`,
//! *Model-Based Planning with Discrete and Continuous Actions* (2017). A choice among n options is relaxed to n
//! probabilities. Several candidates, the first at the nominal plan and the others at random around it, take K steps
//! against the gradient of their cost, each followed by the projection of every choice onto its simplex (Duchi et al.,
//! *Efficient Projections onto the ℓ₁-Ball for Learning in High Dimensions*, 2008, figure 1). Then the likeliest options
//! are chosen. Candidates are `[envs, samples, horizon, dim]`, where `dim` counts the options of all choices of a step.
//!
//! The paper names no settings. Step size, spread and noise are the reference's (`solver/pgd.py`: 1, 1 and 0); as many
//! steps and candidates as in gradient descent.
//!
//! Deviations from the paper and the reference, on purpose:
//! - All candidates are turned into choices and priced as such, and the cheapest is the plan, so [`Plan::costs`] is what
//!   the plan costs. The paper picks a candidate by its relaxed cost, which no plan has, and the reference by the relaxed
//!   cost before the last step.
//! - First candidates are projected, as in the paper; the reference begins outside the simplex, at zeros.
//! - A model step may hold several choices of different sizes, each on a simplex of its own.
//! - Every candidate draws from its own stream, keyed by (plan key, candidate), and noise by (plan key, step,
//!   candidate); options that are equally likely are told apart by index; numbers that are not finite are errors.
//!
//! Entry k of the trace is of the relaxed candidates after k steps; the last is of the choices they end in, which may
//! cost more.

use crate::optimizer::{Memory, Optimizer, Sgd};
use crate::population::{Population, check_settings};
use crate::problem::discrete;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, PlanTrace, Result, Solver};

const ID: &str = "pgd";

/// Projected gradient descent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Pgd {
    /// Candidates, N.
    pub samples: usize,
    /// Steps, K.
    pub iterations: usize,
    /// The step size, η.
    pub step: f32,
    /// The standard deviation of the first candidates around the nominal one, σ₀, before projection.
    pub sigma: f32,
    /// The standard deviation of noise added in every step, before projection, `σ_act`.
    pub action_noise: f32,
}

impl Default for Pgd {
    fn default() -> Self {
        Self { samples: 100, iterations: 30, step: 1.0, sigma: 1.0, action_noise: 0.0 }
    }
}

impl Solver for Pgd {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        let descent = Optimizer::Sgd(Sgd { step: self.step, momentum: 0.0 });
        check_settings(
            ID,
            self.samples,
            self.iterations,
            &[("sigma", self.sigma), ("action_noise", self.action_noise)],
        )?;
        descent.check(ID)?;
        let choices = discrete(ID, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }

        let mut population = Population::around(&problem, self.samples, self.sigma, ID);
        let mut memory = Memory::new(population.actions.len());
        let mut trace = vec![PlanTrace::default(); problem.keys.len()];
        project(&mut population.actions, choices);

        for iteration in 0..self.iterations {
            population.differentiate(ID, cost, iteration)?;
            population.record(&mut trace, &population.cheapest());
            descent.step(&mut memory, &mut population.actions, &population.gradient);
            population.perturb(self.action_noise, iteration);
            project(&mut population.actions, choices);
            if problem.is_late() {
                break;
            }
        }
        choose(&mut population.actions, choices);
        population.evaluate(cost, self.iterations)?;
        let best = population.cheapest();
        population.record(&mut trace, &best);
        Ok(population.plan(&best, trace))
    }
}

/// Moves the numbers of every choice to the nearest probabilities. `actions` is `[steps, dim]`.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
fn project(actions: &mut [f32], choices: &[usize]) {
    let mut sorted = Vec::with_capacity(choices.iter().copied().max().unwrap_or(0));
    each(actions, choices, |options| {
        sorted.clear();
        sorted.extend(options.iter().map(|&v| f64::from(v)));
        sorted.sort_unstable_by(|a, b| b.total_cmp(a));
        // The ρ largest stay above 0 when θ is taken from each so that they add up to 1.
        let (mut sum, mut theta) = (0.0, 0.0);
        for (j, &largest) in sorted.iter().enumerate() {
            sum += largest;
            let shift = (sum - 1.0) / (j + 1) as f64;
            if largest > shift {
                theta = shift;
            }
        }
        options.iter_mut().for_each(|v| *v = (f64::from(*v) - theta).max(0.0) as f32);
    });
}

/// Turns the probabilities of every choice into a one-hot vector at the likeliest option; the first of equals.
fn choose(actions: &mut [f32], choices: &[usize]) {
    each(actions, choices, |options| {
        let likeliest = (1..options.len()).fold(0, |best, i| if options[i] > options[best] { i } else { best });
        options.fill(0.0);
        options[likeliest] = 1.0;
    });
}

/// Every choice of every step.
fn each(actions: &mut [f32], choices: &[usize], mut act: impl FnMut(&mut [f32])) {
    let mut rest = actions;
    while !rest.is_empty() {
        for &options in choices {
            let (choice, tail) = rest.split_at_mut(options);
            act(choice);
            rest = tail;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The nearest point of the simplex among those whose support is one of all subsets: the point itself, shifted by
    /// what is missing to 1, is nearest on each.
    fn brute_force(v: &[f32]) -> Vec<f64> {
        let n = v.len();
        let candidates = (1..1u32 << n).filter_map(|support| {
            let chosen = |i: usize| support >> i & 1 == 1;
            let sum: f64 = (0..n).filter(|&i| chosen(i)).map(|i| f64::from(v[i])).sum();
            let shift = (sum - 1.0) / f64::from(support.count_ones());
            let point: Vec<f64> = (0..n).map(|i| if chosen(i) { f64::from(v[i]) - shift } else { 0.0 }).collect();
            point.iter().all(|&p| p >= 0.0).then_some(point)
        });
        let distance = |p: &[f64]| p.iter().zip(v).map(|(p, &v)| (p - f64::from(v)).powi(2)).sum::<f64>();
        candidates.min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("a point")
    }

    proptest! {
        #[test]
        fn projections_are_the_nearest_probabilities(v in prop::collection::vec(-3.0f32..3.0, 1..7)) {
            let mut p = v.clone();
            project(&mut p, &[v.len()]);
            prop_assert!(p.iter().all(|&p| p >= 0.0));
            prop_assert!((p.iter().map(|&p| f64::from(p)).sum::<f64>() - 1.0).abs() < 1e-6);
            for (p, best) in p.iter().zip(brute_force(&v)) {
                prop_assert!((f64::from(*p) - best).abs() < 1e-6, "{p} {best}");
            }
            let mut again = p.clone();
            project(&mut again, &[v.len()]);
            prop_assert!(p.iter().zip(&again).all(|(p, again)| (p - again).abs() < 1e-6));
        }
    }

    #[test]
    fn every_choice_has_a_simplex_of_its_own() {
        let mut p = [5.0, 0.0, 0.3, 0.3, 0.0, 0.0, 1.0, 0.5, -0.5, 0.5];
        project(&mut p, &[2, 3]);
        assert_eq!(p[..2], [1.0, 0.0]);
        assert!(p[2..5].iter().zip([0.43333, 0.43333, 0.13333]).all(|(p, expected)| (p - expected).abs() < 1e-4));
        assert_eq!(p[5..], [0.0, 1.0, 0.5, 0.0, 0.5]);
        choose(&mut p, &[2, 3]);
        assert_eq!(p, [1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]);
    }
}
