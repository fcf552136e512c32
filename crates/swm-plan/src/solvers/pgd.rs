//! [`Pgd`]: projected gradient descent on the probabilities of discrete actions.
//!
//! Algorithm "Projected Gradient Descent Solver" of the stable-worldmodel paper, after Henaff, Whitney and `LeCun`,
//! *Model-Based Planning with Discrete and Continuous Actions* (2017). A choice among n options is relaxed to n
//! probabilities. Several candidates (the initial guess, and random candidates around the guess) take K steps
//! against the gradient of their cost. After each step, every choice is projected onto its simplex (Duchi et al.,
//! *Efficient Projections onto the ℓ₁-Ball for Learning in High Dimensions*, 2008, figure 1). In the end the most
//! probable options are chosen. Candidates are `[envs, samples, horizon, dim]`, where `dim` is the number of options of
//! all choices of a step.
//!
//! The paper gives no settings. Step size, standard deviation and noise are those of the reference (`solver/pgd.py`: 1,
//! 1 and 0); the numbers of steps and candidates are those of gradient descent.
//!
//! Intended differences from the paper and the reference:
//! - All candidates are rounded to choices, these choices are evaluated, and the cheapest is the plan, so
//!   [`Plan::costs`] is the cost of the plan. The paper selects a candidate by its relaxed cost, and the reference by
//!   the relaxed cost before the last step; a relaxed cost is not the cost of a plan.
//! - Initial candidates are projected, as in the paper; the reference starts outside the simplex, at zeros.
//! - A model step may hold several choices of different sizes, each with its own simplex.
//! - Every candidate draws from its own stream, keyed by (plan key, candidate), and noise by (plan key, step,
//!   candidate); equally probable options are ordered by index; values that are not finite are errors.
//!
//! Entry k of the trace describes the relaxed candidates after k steps. The last entry describes the final choices,
//! which may cost more.

use crate::entry::{ActionKind, Family, Need, SolverEntry, defaults, make};
use crate::search::{Descent, Optimizer, Settings, Sgd, Step, discrete};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "pgd";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "follows the gradient on probabilities of the options, then takes the likeliest",
    family: Family::Gradient,
    actions: ActionKind::Discrete,
    needs: &[Need::Gradient],
    paper: "Henaff, Whitney and LeCun, Model-Based Planning with Discrete and Continuous Actions, 2017",
    defaults: defaults::<Pgd>,
    make: make::<Pgd>,
};

/// Settings of projected gradient descent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Pgd {
    /// Candidates, N.
    pub samples: usize,
    /// Steps, K.
    pub iterations: usize,
    /// The step size, η.
    pub step: f32,
    /// The standard deviation of the initial candidates around the initial guess, σ₀, before projection.
    pub sigma: f32,
    /// The standard deviation of the noise added in every step, before projection, `σ_act`.
    pub action_noise: f32,
}

impl Default for Pgd {
    fn default() -> Self {
        Self { samples: 100, iterations: 30, step: 1.0, sigma: 1.0, action_noise: 0.0 }
    }
}

impl Solver for Pgd {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let optimizer = self.optimizer();
        let choices = discrete(&ENTRY, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }
        let mut descent =
            Descent::new(ID, &problem, self.samples, self.sigma, move |actions| project(actions, choices))?;
        let step = Step { optimizer: &optimizer, action_noise: self.action_noise };
        descent.run(cost, self.iterations, step, |descent, _| {
            descent.record();
            Ok(())
        })?;
        choose(&mut descent.population.actions, choices);
        descent.finish(cost)
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.samples(self.samples)?;
        settings.iterations("iterations", self.iterations)?;
        settings.not_negative("sigma", self.sigma)?;
        settings.not_negative("action_noise", self.action_noise)?;
        self.optimizer().check(ID)
    }
}

impl Pgd {
    fn optimizer(&self) -> Optimizer {
        Optimizer::Sgd(Sgd { step: self.step, momentum: 0.0 })
    }
}

/// Projects every choice onto its probability simplex. `actions` is `[steps, dim]`.
fn project(actions: &mut [f32], choices: &[usize]) {
    let mut sorted = Vec::with_capacity(choices.iter().copied().max().unwrap_or(0));
    for_each_choice(actions, choices, |options| {
        sorted.clear();
        sorted.extend(options.iter().map(|&v| f64::from(v)));
        sorted.sort_unstable_by(|a, b| b.total_cmp(a));
        // θ is the shift with which the values that stay positive after the subtraction add up to 1.
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

/// Replaces the probabilities of every choice by a one-hot vector at the first of the most probable options.
fn choose(actions: &mut [f32], choices: &[usize]) {
    for_each_choice(actions, choices, |options| {
        let best = (1..options.len()).fold(0, |best, i| if options[i] > options[best] { i } else { best });
        options.fill(0.0);
        options[best] = 1.0;
    });
}

/// Calls `change` with the options of every choice of every step.
fn for_each_choice(actions: &mut [f32], choices: &[usize], mut change: impl FnMut(&mut [f32])) {
    let mut rest = actions;
    while !rest.is_empty() {
        for &options in choices {
            let (choice, tail) = rest.split_at_mut(options);
            change(choice);
            rest = tail;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Finds the nearest point of the simplex by trying every support. For one support, the nearest point is `v` plus a
    /// constant on the supported coordinates and zero elsewhere.
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
        candidates.min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("the simplex is not empty")
    }

    proptest! {
        #[test]
        fn projection_finds_the_nearest_point(v in prop::collection::vec(-3.0f32..3.0, 1..7)) {
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
    fn every_choice_is_projected_separately() {
        let mut p = [5.0, 0.0, 0.3, 0.3, 0.0, 0.0, 1.0, 0.5, -0.5, 0.5];
        project(&mut p, &[2, 3]);
        assert_eq!(p[..2], [1.0, 0.0]);
        assert!(p[2..5].iter().zip([0.43333, 0.43333, 0.13333]).all(|(p, expected)| (p - expected).abs() < 1e-4));
        assert_eq!(p[5..], [0.0, 1.0, 0.5, 0.0, 0.5]);
        choose(&mut p, &[2, 3]);
        assert_eq!(p, [1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]);
    }
}
