//! [`AugmentedLagrangian`]: gradient descent that keeps differentiable inequalities `g_j(A) ≤ 0`.
//!
//! Algorithm "Lagrangian Solver" of the stable-worldmodel paper. Several candidates, the first at the nominal sequence and
//! the others at random around it, descend `J(A) + λ·g(A) + ρ ‖[g(A)]₊‖²` for K steps with fixed multipliers λ and
//! penalty ρ; then `λ ← [λ + ρ ḡ]₊`, with ḡ the mean over the candidates, and ρ grows up to a limit; L times. Candidates
//! are `[envs, samples, horizon, dim]`, values of constraints `[envs, samples, constraints]`, and every environment has its
//! own multipliers, `[envs, constraints]`.
//!
//! Outer iterations, penalties, spread and noise are the reference's (`solver/lagrangian.py`); candidates and Adam's step
//! size, which it has at 1, are those of gradient descent, and the 50 steps, which it leaves open, bring the tests'
//! constrained problem within 0.003 of its lowest cost. The penalty term counts ρ once and its slope is 2ρ, so every update of the multipliers
//! halves the violation at best; a penalty that grows beyond what the step size can follow makes plans worse, not more
//! exact.
//!
//! Deviations from the paper and the reference, on purpose:
//! - The plan is the cheapest candidate among those whose constraints all hold within `tolerance`. Where none does, it is
//!   the one whose largest violation is smallest, and the last entry of [`PlanTrace::violation`] exceeds the tolerance.
//!   The paper and the reference return the cheapest candidate whether or not it keeps the constraints.
//! - Candidates are moved into the bounds of the problem after every step; infinite bounds give their algorithm.
//! - Multipliers begin at zero for every plan. The reference can carry them to the next plan; here a plan depends on its
//!   problem and its key only.
//! - Every candidate draws from its own stream, keyed by (plan key, candidate), and noise by (plan key, step,
//!   candidate); numbers that are not finite are errors.
//!
//! As in the reference, the optimizer forgets its momentum whenever the multipliers change. The trace has an entry for
//! every step, before it, and one for the plan: the cost and the violation of the candidate that would be the plan.

use crate::optimizer::{Adam, Memory, Optimizer};
use crate::population::{Population, check_settings};
use crate::problem::{UNWRITTEN, constrained, continuous};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Error, Plan, PlanProblem, PlanTrace, Result, Solver};

const ID: &str = "lagrangian";

/// The augmented Lagrangian method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AugmentedLagrangian {
    /// Candidates, N.
    pub samples: usize,
    /// Updates of the multipliers, L.
    pub outer_iterations: usize,
    /// Steps between them, K.
    pub iterations: usize,
    /// The standard deviation of the first candidates around the nominal one, σ₀, in model action units.
    pub sigma: f32,
    /// How a gradient becomes a step.
    pub optimizer: Optimizer,
    /// The first penalty, ρ₀.
    pub penalty: f32,
    /// By how much the penalty grows with every update of the multipliers.
    pub penalty_growth: f32,
    /// Where it stops growing.
    pub penalty_limit: f32,
    /// Up to which value a constraint counts as satisfied.
    pub tolerance: f32,
    /// The standard deviation of noise added to the actions after every step, `σ_act`.
    pub action_noise: f32,
}

impl Default for AugmentedLagrangian {
    fn default() -> Self {
        Self {
            samples: 100,
            outer_iterations: 5,
            iterations: 50,
            sigma: 1.0,
            optimizer: Optimizer::Adam(Adam::default()),
            penalty: 1.0,
            penalty_growth: 2.0,
            penalty_limit: 1e4,
            tolerance: 1e-3,
            action_noise: 0.0,
        }
    }
}

impl Solver for AugmentedLagrangian {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(ID, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }

        let mut population = Population::around(&problem, self.samples, self.sigma, ID);
        let mut memory = Memory::new(population.actions.len());
        let mut duals = Duals::new(cost, &population, &problem)?;
        let mut trace = vec![PlanTrace::default(); problem.keys.len()];
        bounds.clip(&mut population.actions);

        let mut rho = self.penalty;
        let mut step = 0;
        'search: for _ in 0..self.outer_iterations {
            memory.clear();
            for _ in 0..self.iterations {
                population.differentiate(ID, cost, step)?;
                duals.constrain(cost, &mut population, step)?;
                duals.record(&population, &mut trace, self.tolerance);
                duals.add_gradient(cost, &mut population, rho)?;
                population.check_gradient(step)?;
                self.optimizer.step(&mut memory, &mut population.actions, &population.gradient);
                population.perturb(self.action_noise, step);
                bounds.clip(&mut population.actions);
                step += 1;
                if problem.is_late() {
                    break 'search;
                }
            }
            duals.constrain(cost, &mut population, step)?;
            duals.ascend(rho);
            rho = self.penalty_limit.min(self.penalty_growth * rho);
        }
        population.evaluate(cost, step)?;
        duals.constrain(cost, &mut population, step)?;
        let best = duals.record(&population, &mut trace, self.tolerance);
        Ok(population.plan(&best, trace))
    }
}

/// The constraints of all candidates and their multipliers.
struct Duals {
    /// What the constraints are, `[envs, samples, constraints]`.
    values: Vec<f32>,
    /// The slope of the Lagrangian in each, of the same shape.
    slopes: Vec<f32>,
    /// The multipliers λ, `[envs, constraints]`.
    multipliers: Vec<f32>,
    samples: usize,
    constraints: usize,
}

impl Duals {
    fn new(cost: &mut dyn CostModel, population: &Population, problem: &PlanProblem<'_>) -> Result<Self> {
        let (samples, constraints) = (population.samples, constrained(ID, cost)?.constraints(problem.horizon));
        if constraints == 0 {
            let given = format!("the model has no constraints on {} model steps", problem.horizon);
            return Err(Error::config(format!("solver {ID}"), given, "choose gd"));
        }
        let len = problem.keys.len() * samples * constraints;
        let multipliers = vec![0.0; problem.keys.len() * constraints];
        Ok(Self { values: vec![0.0; len], slopes: vec![0.0; len], multipliers, samples, constraints })
    }

    /// Asks the model by how much the candidates violate the constraints.
    fn constrain(&mut self, cost: &mut dyn CostModel, population: &mut Population, step: usize) -> Result<()> {
        self.values.fill(UNWRITTEN);
        constrained(ID, cost)?.constrain(population.split().0, &mut self.values)?;
        let Some(i) = self.values.iter().position(|value| !value.is_finite()) else {
            return Ok(());
        };
        let (constraint, candidate) = (i % self.constraints, i / self.constraints);
        Err(Error::NotFinite {
            what: format!("the value of constraint {constraint}"),
            given: format!(
                "{} for candidate {} of planned environment {} in iteration {step}",
                self.values[i],
                candidate % self.samples,
                candidate / self.samples
            ),
            fix: "the model diverges on these actions, or the constraint was not written".to_owned(),
        })
    }

    /// Adds the gradient of `λ·g + ρ ‖[g]₊‖²` to that of the cost.
    fn add_gradient(&mut self, cost: &mut dyn CostModel, population: &mut Population, rho: f32) -> Result<()> {
        let values = self.values.chunks_exact(self.constraints).enumerate();
        for ((i, values), slopes) in values.zip(self.slopes.chunks_exact_mut(self.constraints)) {
            let multipliers = &self.multipliers[i / self.samples * self.constraints..][..self.constraints];
            for ((slope, lambda), value) in slopes.iter_mut().zip(multipliers).zip(values) {
                *slope = lambda + 2.0 * rho * value.max(0.0);
            }
        }
        let (candidates, _, gradient) = population.split();
        constrained(ID, cost)?.constrain_vjp(candidates, &self.slopes, gradient)
    }

    /// Raises the multipliers of constraints that are violated on average, and lowers the others.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    fn ascend(&mut self, rho: f32) {
        for (i, lambda) in self.multipliers.iter_mut().enumerate() {
            let (env, constraint) = (i / self.constraints, i % self.constraints);
            let values = &self.values[env * self.samples * self.constraints..][..self.samples * self.constraints];
            let values = values[constraint..].iter().step_by(self.constraints);
            let mean = values.map(|&value| f64::from(value)).sum::<f64>() / self.samples as f64;
            *lambda = (*lambda + rho * mean as f32).max(0.0);
        }
    }

    /// Notes how the search stands; returns the best candidate of every environment: the cheapest that keeps the
    /// constraints, or the one that violates them least.
    fn record(&self, population: &Population, trace: &mut [PlanTrace], tolerance: f32) -> Vec<usize> {
        let violation = |i: usize| {
            let values = &self.values[i * self.constraints..][..self.constraints];
            values.iter().copied().fold(f32::NEG_INFINITY, f32::max)
        };
        let rank = |i: usize| {
            let violation = violation(i).max(tolerance);
            (violation, if violation > tolerance { 0.0 } else { population.costs[i] })
        };
        let best: Vec<usize> = (0..trace.len())
            .map(|env| env * self.samples)
            .map(|first| {
                (1..self.samples).fold(0, |best, i| if rank(first + i) < rank(first + best) { i } else { best })
            })
            .collect();
        population.record(trace, &best);
        for (env, (trace, best)) in trace.iter_mut().zip(&best).enumerate() {
            trace.violation.push(violation(env * self.samples + best));
        }
        best
    }
}

impl AugmentedLagrangian {
    fn check(&self) -> Result<()> {
        let wrong = |what: &str, given: String, fix: &str| Err(Error::config(format!("{ID} {what}"), given, fix));
        let spreads = [("sigma", self.sigma), ("action_noise", self.action_noise), ("tolerance", self.tolerance)];
        check_settings(ID, self.samples, self.iterations, &spreads)?;
        if self.outer_iterations == 0 {
            return wrong("outer_iterations", "0".to_owned(), "ask for at least 1");
        }
        if !(self.penalty.is_finite() && self.penalty > 0.0) {
            return wrong("penalty", self.penalty.to_string(), "choose a finite number above 0");
        }
        if !(self.penalty_growth.is_finite() && self.penalty_growth >= 1.0) {
            return wrong("penalty_growth", self.penalty_growth.to_string(), "choose a finite factor of at least 1");
        }
        if !(self.penalty_limit.is_finite() && self.penalty_limit >= self.penalty) {
            let given = format!("{}, below the first penalty {}", self.penalty_limit, self.penalty);
            return wrong("penalty_limit", given, "choose a finite number, at least the first penalty");
        }
        self.optimizer.check(ID)
    }
}
