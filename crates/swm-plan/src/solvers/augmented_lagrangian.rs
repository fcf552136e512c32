//! [`AugmentedLagrangian`]: gradient descent under differentiable inequality constraints `g_j(A) ≤ 0`.
//!
//! Algorithm "Lagrangian Solver" of the stable-worldmodel paper. Several candidates (the initial guess, and random
//! candidates around the guess) descend `J(A) + λ·g(A) + ρ ‖[g(A)]₊‖²` for K steps with fixed multipliers λ and penalty
//! ρ. Then `λ ← [λ + ρ ḡ]₊`, with ḡ the mean over the candidates, and ρ grows up to a limit. Both steps are repeated
//! L times. Candidates are `[envs, samples, horizon, dim]`, values of constraints `[envs, samples, constraints]`, and
//! every environment has its own multipliers, `[envs, constraints]`.
//!
//! Outer iterations, penalties, standard deviation and noise are those of the reference (`solver/lagrangian.py`). The
//! number of candidates and Adam's step size (1 in the reference) are those of gradient descent. The reference leaves
//! the number of steps open; with 50 steps, the cost of the tests' constrained problem is within 0.003 of the lowest.
//! The penalty term has the gradient 2ρ\[g\]₊, so an update of the multipliers halves the violation at best. A penalty
//! that is too large for the step size makes plans worse.
//!
//! Intended differences from the paper and the reference:
//! - The plan is the cheapest candidate among those whose constraints all hold within `tolerance`. If there is no
//!   such candidate, the plan is the candidate whose largest violation is smallest, and the last entry of
//!   [`PlanTrace::violation`](swm_core::PlanTrace::violation) exceeds the tolerance. The paper and the reference return
//!   the cheapest candidate, feasible or not.
//! - Candidates are clipped to the bounds of the problem after every step; with infinite bounds, the algorithm is that
//!   of the paper.
//! - Multipliers start at zero for every plan. The reference can reuse the multipliers for the next plan; here a
//!   plan depends on its problem and its key only.
//! - Every candidate draws from its own stream, keyed by (plan key, candidate), and noise by (plan key, step,
//!   candidate); values that are not finite are errors.
//!
//! As in the reference, the optimizer's memory is cleared whenever the multipliers change. The trace has an entry
//! before every step and one for the plan: the cost and the violation of the candidate that is the best at this step, and
//! the last multipliers.

use crate::entry::{ActionKind, Family, Need, SolverEntry, defaults, make};
use crate::search::{Adam, Descent, Optimizer, Settings, Step, UNWRITTEN, constrained, continuous, misfit};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Error, Plan, PlanProblem, Result, Solver};

const ID: &str = "lagrangian";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "follows the gradient, with growing penalties on violated constraints",
    family: Family::Gradient,
    actions: ActionKind::Continuous,
    needs: &[Need::Gradient, Need::Constraints],
    paper: "Maes et al., stable-worldmodel, 2026, algorithm \"Lagrangian Solver\"",
    defaults: defaults::<AugmentedLagrangian>,
    make: make::<AugmentedLagrangian>,
};

/// Settings of the augmented Lagrangian method.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AugmentedLagrangian {
    /// Candidates, N.
    pub samples: usize,
    /// Updates of the multipliers, L.
    pub outer_iterations: usize,
    /// Steps between two updates of the multipliers, K.
    pub iterations: usize,
    /// The standard deviation of the initial candidates around the initial guess, σ₀, in model action units.
    pub sigma: f32,
    /// Turns a gradient into a step.
    pub optimizer: Optimizer,
    /// The first penalty, ρ₀.
    pub penalty: f32,
    /// The factor by which the penalty grows with every update of the multipliers.
    pub penalty_growth: f32,
    /// The largest penalty.
    pub penalty_limit: f32,
    /// The largest value at which a constraint counts as satisfied.
    pub tolerance: f32,
    /// The standard deviation of the noise added to the actions after every step, `σ_act`.
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
        let bounds = continuous(&ENTRY, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }
        let mut descent = Descent::new(ID, &problem, self.samples, self.sigma, move |actions| bounds.clip(actions))?;
        let step = Step { optimizer: &self.optimizer, action_noise: self.action_noise };
        let mut duals = Duals::new(cost, self.samples, &problem)?;

        let mut rho = self.penalty;
        for _ in 0..self.outer_iterations {
            descent.forget();
            let in_time = descent.run(cost, self.iterations, step, |descent, cost| {
                duals.evaluate(cost, descent)?;
                duals.record(descent, self.tolerance);
                duals.add_gradient(cost, descent, rho)?;
                descent.check_gradient()
            })?;
            if !in_time {
                break;
            }
            duals.evaluate(cost, &descent)?;
            duals.ascend(rho);
            rho = self.penalty_limit.min(self.penalty_growth * rho);
        }
        descent.population.evaluate(cost, descent.steps)?;
        duals.evaluate(cost, &descent)?;
        let best = duals.record(&mut descent, self.tolerance);
        for (trace, multipliers) in descent.trace.iter_mut().zip(duals.multipliers.chunks_exact(duals.constraints)) {
            trace.multipliers.extend_from_slice(multipliers);
        }
        Ok(descent.population.plan(&best, descent.trace))
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.samples(self.samples)?;
        settings.iterations("outer_iterations", self.outer_iterations)?;
        settings.iterations("iterations", self.iterations)?;
        settings.not_negative("sigma", self.sigma)?;
        settings.not_negative("action_noise", self.action_noise)?;
        settings.not_negative("tolerance", self.tolerance)?;
        settings.positive("penalty", self.penalty)?;
        settings.at_least("penalty_growth", self.penalty_growth, 1.0)?;
        settings.check(
            self.penalty_limit.is_finite() && self.penalty_limit >= self.penalty,
            "penalty_limit",
            format!("{}, below the first penalty {}", self.penalty_limit, self.penalty),
            "choose a finite number, at least the first penalty",
        )?;
        self.optimizer.check(ID)
    }
}

/// The constraints of all candidates and their multipliers.
struct Duals {
    /// The values of the constraints, `[envs, samples, constraints]`.
    values: Vec<f32>,
    /// The derivative of the Lagrangian with respect to each value, `[envs, samples, constraints]`.
    slopes: Vec<f32>,
    /// The multipliers λ, `[envs, constraints]`.
    multipliers: Vec<f32>,
    samples: usize,
    constraints: usize,
}

impl Duals {
    fn new(cost: &mut dyn CostModel, samples: usize, problem: &PlanProblem<'_>) -> Result<Self> {
        let constraints = constrained(ID, cost)?.constraints(problem.horizon);
        if constraints == 0 {
            let obstacle = format!("the model has no constraints on {} model steps", problem.horizon);
            return Err(misfit(ID, &obstacle, "choose the solver gd"));
        }
        let len = problem.keys.len() * samples * constraints;
        let multipliers = vec![0.0; problem.keys.len() * constraints];
        Ok(Self { values: vec![0.0; len], slopes: vec![0.0; len], multipliers, samples, constraints })
    }

    /// Computes the constraints of all candidates.
    fn evaluate(&mut self, cost: &mut dyn CostModel, descent: &Descent<'_>) -> Result<()> {
        self.values.fill(UNWRITTEN);
        constrained(ID, cost)?.constrain(descent.population.candidates(), &mut self.values)?;
        let Some(i) = self.values.iter().position(|value| !value.is_finite()) else {
            return Ok(());
        };
        let (constraint, candidate) = (i % self.constraints, i / self.constraints);
        Err(Error::NotFinite {
            what: format!("the value of constraint {constraint}"),
            given: format!(
                "{} for candidate {} of planned environment {} in iteration {}",
                self.values[i],
                candidate % self.samples,
                candidate / self.samples,
                descent.steps
            ),
            fix: "the model diverges on these actions, or the constraint was not written".to_owned(),
        })
    }

    /// Adds the gradient of `λ·g + ρ ‖[g]₊‖²` to the gradient of the cost.
    fn add_gradient(&mut self, cost: &mut dyn CostModel, descent: &mut Descent<'_>, rho: f32) -> Result<()> {
        let values = self.values.chunks_exact(self.constraints).enumerate();
        for ((i, values), slopes) in values.zip(self.slopes.chunks_exact_mut(self.constraints)) {
            let multipliers = &self.multipliers[i / self.samples * self.constraints..][..self.constraints];
            for ((slope, lambda), value) in slopes.iter_mut().zip(multipliers).zip(values) {
                *slope = lambda + 2.0 * rho * value.max(0.0);
            }
        }
        let Descent { population, gradient, .. } = descent;
        constrained(ID, cost)?.constrain_vjp(population.candidates(), &self.slopes, gradient)
    }

    /// Increases the multipliers of constraints that are violated on average, and decreases all other multipliers.
    fn ascend(&mut self, rho: f32) {
        for (i, lambda) in self.multipliers.iter_mut().enumerate() {
            let (env, constraint) = (i / self.constraints, i % self.constraints);
            let values = &self.values[env * self.samples * self.constraints..][..self.samples * self.constraints];
            let values = values[constraint..].iter().step_by(self.constraints);
            let mean = values.map(|&value| f64::from(value)).sum::<f64>() / self.samples as f64;
            *lambda = (*lambda + rho * mean as f32).max(0.0);
        }
    }

    /// Appends to the trace; returns the best candidate of every environment: the cheapest that satisfies the
    /// constraints, or the one with the smallest violation.
    fn record(&self, descent: &mut Descent<'_>, tolerance: f32) -> Vec<usize> {
        let Descent { population, trace, .. } = descent;
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
