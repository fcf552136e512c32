//! [`Penalised`]: a model whose constraints are part of its cost, for solvers that know no constraints.

use crate::problem::UNWRITTEN;
use swm_core::{Batch, Candidates, CostModel, Env, Error, Result};

/// Adds `weight` times the sum of all violations, `Σ max(0, g)`, to the cost of a candidate.
///
/// The penalty is exact: with a weight above the largest Lagrange multiplier of the optimum, the cheapest candidate is
/// the optimum itself, not a point near it. The price is a kink at the edge, which no sampling solver minds. A solver
/// that follows gradients does; it keeps constraints by itself ([`Need::Constraints`](crate::registry::Need)).
pub struct Penalised {
    model: Box<dyn CostModel>,
    weight: f32,
    values: Vec<f32>,
}

impl Penalised {
    /// A model with its constraints priced.
    ///
    /// # Errors
    /// When the model has no constraints or the weight is not a finite number above 0.
    pub fn new(mut model: Box<dyn CostModel>, weight: f32) -> Result<Self> {
        if model.constrained().is_none() {
            return Err(Error::config("penalty", "the model has no constraints", "plan with the model as it is"));
        }
        if !(weight.is_finite() && weight > 0.0) {
            return Err(Error::config("penalty weight", weight.to_string(), "choose a finite number above 0"));
        }
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
            // A value that is not a number must reach the cost, where the solver refuses it; `max` would hide it.
            let violation: f32 = values.iter().map(|&value| if value <= 0.0 { 0.0 } else { value }).sum();
            *cost += self.weight * violation;
        }
        Ok(())
    }
}
