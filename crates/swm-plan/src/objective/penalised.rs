//! [`Penalised`]: adds the constraint violations of a model to its cost, for solvers that do not handle constraints.

use crate::search::{Settings, UNWRITTEN};
use swm_core::{Batch, Candidates, CostModel, Env, Error, Result};

/// Adds `weight` times the sum of all violations, `Σ max(0, g)`, to the cost of a candidate.
///
/// The penalty is exact: with a weight above the largest Lagrange multiplier of the optimum, the cheapest candidate is
/// the optimum itself, not a point near it. However, the gradient of the cost jumps at the boundary of the feasible
/// set. Use this cost with sampling solvers; for gradient methods, choose a solver that handles constraints
/// ([`Need::Constraints`](crate::Need::Constraints)).
pub struct Penalised {
    model: Box<dyn CostModel>,
    weight: f32,
    values: Vec<f32>,
}

impl Penalised {
    /// Creates a penalised cost from a model with constraints and the weight of the penalty.
    ///
    /// # Errors
    /// When the model has no constraints or the weight is not a finite number above 0.
    pub fn new(mut model: Box<dyn CostModel>, weight: f32) -> Result<Self> {
        if model.constrained().is_none() {
            return Err(Error::config(
                "penalty",
                "the model has no constraints",
                "plan with the model without a penalty",
            ));
        }
        Settings("penalty").positive("weight", weight)?;
        Ok(Self { model, weight, values: vec![] })
    }
}

impl CostModel for Penalised {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.model.observe(infos, envs)
    }

    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        self.model.observe_env(slot, env)
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.model.cost(candidates, costs)?;
        let Some(model) = self.model.constrained() else {
            return Ok(());
        };
        let constraints = model.constraints(candidates.horizon);
        self.values.clear();
        self.values.resize(costs.len() * constraints, UNWRITTEN);
        model.constrain(candidates, &mut self.values)?;
        for (cost, values) in costs.iter_mut().zip(self.values.chunks_exact(constraints.max(1))) {
            // NaN must reach the cost, where the solver rejects it; `max` would discard it.
            let violation: f32 = values.iter().map(|&value| if value <= 0.0 { 0.0 } else { value }).sum();
            *cost += self.weight * violation;
        }
        Ok(())
    }
}
