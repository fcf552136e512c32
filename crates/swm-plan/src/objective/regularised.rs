//! [`Regularised`]: the cost of a model plus terms and constraints on actions.

use super::contracts::{Constraint, Objective, Shape};
use super::trajectories::{Trajectories, check_all, check_len};
use swm_core::{Batch, Candidates, Constrained, CostModel, DifferentiableCost, Env, Error, LatentDynamics, Result};

/// A model with terms on actions added to its cost, and with constraints on actions. The sum is differentiable if the
/// model is differentiable. The model's latents stay accessible.
pub struct Regularised {
    model: Box<dyn CostModel>,
    objective: Box<dyn Objective>,
    constraints: Vec<Box<dyn Constraint>>,
}

impl Regularised {
    /// Adds an objective and constraints to a model.
    ///
    /// # Errors
    /// When the objective or a constraint uses latents, or the model has constraints of its own.
    pub fn new(
        mut model: Box<dyn CostModel>,
        objective: Box<dyn Objective>,
        constraints: Vec<Box<dyn Constraint>>,
    ) -> Result<Self> {
        reject_constraints(&mut *model)?;
        if objective.needs_latents() || constraints.iter().any(|constraint| constraint.needs_latents()) {
            return Err(Error::config(
                "objective",
                "a term on latents cannot be added to the model's own cost",
                "replace the cost by terms on the rollout: name a goal term too",
            ));
        }
        Ok(Self { model, objective, constraints })
    }

    fn check<'a>(&self, candidates: Candidates<'a>) -> Result<Trajectories<'a>> {
        let Candidates { horizon, dim, .. } = candidates;
        check_all(Shape { horizon, latent: 0, dim }, &*self.objective, &self.constraints)?;
        Ok(Trajectories { candidates, latents: &[], goals: &[], latent: 0 })
    }
}

/// Rejects models that already have constraints: constraints of a model and of an objective are not combined.
pub(super) fn reject_constraints(model: &mut dyn CostModel) -> Result<()> {
    if model.constrained().is_none() {
        return Ok(());
    }
    Err(Error::config("objective", "the model has constraints of its own", "give all constraints to one objective"))
}

impl CostModel for Regularised {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.model.observe(infos, envs)
    }

    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        self.model.observe_env(slot, env)
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let trajectories = self.check(candidates)?;
        self.model.cost(candidates, costs)?;
        trajectories.add_costs(&*self.objective, costs);
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        if self.model.differentiable().is_some() { Some(self) } else { None }
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        self.model.latent()
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        if self.constraints.is_empty() { None } else { Some(self) }
    }
}

impl DifferentiableCost for Regularised {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        let trajectories = self.check(candidates)?;
        check_len("the gradient of a cost", gradient.len(), candidates.actions.len())?;
        let Some(model) = self.model.differentiable() else {
            let fix = "choose a sampling solver";
            return Err(Error::config("objective", "the model to which it is added has no gradient", fix));
        };
        model.cost_and_gradient(candidates, costs, gradient)?;
        trajectories.add_costs(&*self.objective, costs);
        trajectories.add_gradients(&*self.objective, &mut [], gradient);
        Ok(())
    }
}

impl Constrained for Regularised {
    fn constraints(&self, horizon: usize) -> usize {
        self.constraints.iter().map(|constraint| constraint.count(horizon, 0)).sum()
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        let trajectories = self.check(candidates)?;
        check_len("the values of constraints", values.len(), trajectories.count(&self.constraints))?;
        trajectories.constrain(&self.constraints, values);
        Ok(())
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        let trajectories = self.check(candidates)?;
        check_len("the weights of constraints", weights.len(), trajectories.count(&self.constraints))?;
        check_len("the gradient of constraints", gradient.len(), candidates.actions.len())?;
        trajectories.add_constraint_gradients(&self.constraints, weights, &mut [], gradient);
        Ok(())
    }
}
