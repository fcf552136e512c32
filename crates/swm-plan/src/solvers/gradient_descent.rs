//! [`GradientDescent`]: gradient descent on the cost.
//!
//! Algorithm "Gradient Descent Solver" of the stable-worldmodel paper. Several candidates (the initial guess, and
//! random candidates around the guess) each take K steps against the gradient of their own cost; the candidate that is
//! cheapest after the last step is the plan. Candidates and gradients are `[envs, samples, horizon, dim]`.
//!
//! The paper gives no settings. The defaults are those of the reference's scripts (`scripts/eval` and `scripts/plan`):
//! 30 steps, 100 candidates, Adam with the step size 0.1. (The default of the reference's class, gradient descent with
//! the step size 1, only suits costs of one scale.)
//!
//! Intended differences from the paper and the reference:
//! - Candidates are clipped to the bounds of the problem before the first step and after every step. The paper's table
//!   of solvers states this; the paper's algorithm and the reference omit the clipping.
//! - The plan is the candidate that is cheapest after its last step, as in the paper; the reference compares the costs
//!   from before that step.
//! - The norm of gradients is clipped for each candidate. The reference clips by the norm over all candidates of all
//!   environments, so a plan depends on the environments planned in the same call.
//! - Every candidate draws from its own stream, keyed by (plan key, candidate), and noise by (plan key, step,
//!   candidate).
//! - Costs and gradients that are not finite are errors.
//!
//! Entry k of the trace is recorded after k steps, so there is one entry more than there are steps.

use crate::entry::{ActionKind, Family, Need, SolverEntry, defaults, make};
use crate::search::{Adam, Descent, Optimizer, Settings, Step, clip_norm, continuous};
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "gd";

/// The row of this solver in the registry.
pub const ENTRY: SolverEntry = SolverEntry {
    id: ID,
    summary: "follows the gradient of the cost from several starts",
    family: Family::Gradient,
    actions: ActionKind::Continuous,
    needs: &[Need::Gradient],
    paper: "Maes et al., stable-worldmodel, 2026, algorithm \"Gradient Descent Solver\"",
    defaults: defaults::<GradientDescent>,
    make: make::<GradientDescent>,
};

/// Settings of gradient descent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GradientDescent {
    /// Candidates, N.
    pub samples: usize,
    /// Steps, K.
    pub iterations: usize,
    /// The standard deviation of the initial candidates around the initial guess, in model action units.
    pub sigma: f32,
    /// Turns a gradient into a step.
    pub optimizer: Optimizer,
    /// The largest norm of a candidate's gradient; a longer gradient is scaled down to it.
    pub clip: Option<f32>,
    /// The standard deviation of the noise added to the actions after every step.
    pub action_noise: f32,
}

impl Default for GradientDescent {
    fn default() -> Self {
        let optimizer = Optimizer::Adam(Adam::default());
        Self { samples: 100, iterations: 30, sigma: 1.0, optimizer, clip: None, action_noise: 0.0 }
    }
}

impl Solver for GradientDescent {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(&ENTRY, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }
        let mut descent = Descent::new(ID, &problem, self.samples, self.sigma, move |actions| bounds.clip(actions))?;
        let step = Step { optimizer: &self.optimizer, action_noise: self.action_noise };
        descent.run(cost, self.iterations, step, |descent, _| {
            descent.record();
            if let Some(norm) = self.clip {
                clip_norm(&mut descent.gradient, descent.population.len(), norm);
            }
            Ok(())
        })?;
        descent.finish(cost)
    }

    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.samples(self.samples)?;
        settings.iterations("iterations", self.iterations)?;
        settings.not_negative("sigma", self.sigma)?;
        settings.not_negative("action_noise", self.action_noise)?;
        self.clip.map_or(Ok(()), |norm| settings.positive("clip", norm))?;
        self.optimizer.check(ID)
    }
}
