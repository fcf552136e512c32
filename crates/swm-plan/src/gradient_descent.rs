//! [`GradientDescent`]: following the gradient of the cost.
//!
//! Algorithm "Gradient Descent Solver" of the stable-worldmodel paper: several candidates, the first at the nominal
//! sequence and the others at random around it, each take K steps against the gradient of their own cost; the cheapest
//! after the last step is the plan. Candidates are `[envs, samples, horizon, dim]`, their gradients likewise.
//!
//! The paper names no settings. The defaults are those of the reference's scripts (`scripts/eval` and `scripts/plan`): 30
//! steps, 100 candidates, Adam with the step size 0.1. (Its class begins with plain gradient descent of step 1, which
//! only suits costs of one scale.)
//!
//! Deviations from the paper and the reference, on purpose:
//! - Candidates are moved into the bounds of the problem after every step (and before the first), which the paper's table
//!   of solvers promises and neither its algorithm nor the reference does. Infinite bounds give their algorithm.
//! - The plan is the candidate that is cheapest after its last step, as in the paper; the reference compares the costs
//!   from before that step.
//! - Gradients are clipped candidate by candidate; the reference clips by the norm over all candidates of all
//!   environments, so that its plans depend on their neighbours.
//! - Every candidate draws from its own stream, keyed by (plan key, candidate), and noise by (plan key, step,
//!   candidate).
//! - Costs and gradients that are not finite are errors.
//!
//! Entry k of the trace is of the candidates after k steps, so there is one more than there are steps.

use crate::optimizer::{Adam, Memory, Optimizer, clip_norm};
use crate::population::{Population, check_settings};
use crate::problem::continuous;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Error, Plan, PlanProblem, PlanTrace, Result, Solver};

const ID: &str = "gd";

/// Gradient descent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GradientDescent {
    /// Candidates, N.
    pub samples: usize,
    /// Steps, K.
    pub iterations: usize,
    /// The standard deviation of the first candidates around the nominal one, in model action units.
    pub sigma: f32,
    /// How a gradient becomes a step.
    pub optimizer: Optimizer,
    /// The norm to which the gradient of a candidate is shortened where it is longer.
    pub clip: Option<f32>,
    /// The standard deviation of noise added to the actions after every step.
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
        let bounds = continuous(ID, cost, &problem)?;
        if problem.keys.is_empty() {
            return Ok(Plan::default());
        }

        let mut population = Population::around(&problem, self.samples, self.sigma, ID);
        let mut memory = Memory::new(population.actions.len());
        let mut trace = vec![PlanTrace::default(); problem.keys.len()];
        bounds.clip(&mut population.actions);

        for iteration in 0..self.iterations {
            population.differentiate(ID, cost, iteration)?;
            population.record(&mut trace, &population.cheapest());
            if let Some(norm) = self.clip {
                let len = population.len();
                clip_norm(&mut population.gradient, len, norm);
            }
            self.optimizer.step(&mut memory, &mut population.actions, &population.gradient);
            population.perturb(self.action_noise, iteration);
            bounds.clip(&mut population.actions);
            if problem.is_late() {
                break;
            }
        }
        population.evaluate(cost, self.iterations)?;
        let best = population.cheapest();
        population.record(&mut trace, &best);
        Ok(population.plan(&best, trace))
    }
}

impl GradientDescent {
    fn check(&self) -> Result<()> {
        let spreads = [("sigma", self.sigma), ("action_noise", self.action_noise)];
        check_settings(ID, self.samples, self.iterations, &spreads)?;
        if let Some(norm) = self.clip.filter(|norm| !(norm.is_finite() && *norm > 0.0)) {
            return Err(Error::config(format!("{ID} clip"), norm.to_string(), "choose a finite norm above 0, or none"));
        }
        self.optimizer.check(ID)
    }
}
