//! [`ObjectiveCost`]: an objective computed on a rollout of a model's latent dynamics.

use super::contracts::{Constraint, Objective, Shape};
use super::regularised::reject_constraints;
use super::rollout::Rollout;
use super::trajectories::{Trajectories, check_all, check_len};
use crate::search::UNWRITTEN;
use swm_core::{Batch, Candidates, Constrained, CostModel, DifferentiableCost, Env, Error, LatentDynamics, Result};

/// A model whose cost is an objective on a rollout of its [`LatentDynamics`] from the present latent, with constraints.
/// The gradient is computed by back-propagation through time.
///
/// Only [`LatentDynamics`] is used. For a model that conditions on several past states, such as a LeWM, the latent
/// dynamics are a one-step model, so a terminal goal term is close to that model's own cost but not equal to it.
pub struct ObjectiveCost {
    model: Box<dyn CostModel>,
    objective: Box<dyn Objective>,
    constraints: Vec<Box<dyn Constraint>>,
    /// The present latents of the observed environments, `[envs, latent]`.
    start: Vec<f32>,
    /// The goal latents of the observed environments, `[envs, latent]`.
    goals: Vec<f32>,
    latent: usize,
    rollout: Rollout,
    /// The gradient with respect to every latent, in the shape of the latents.
    slopes: Vec<f32>,
}

impl ObjectiveCost {
    /// Applies an objective and constraints to a model with latent dynamics.
    ///
    /// # Errors
    /// When the model has no latents, or has constraints of its own.
    pub fn new(
        mut model: Box<dyn CostModel>,
        objective: Box<dyn Objective>,
        constraints: Vec<Box<dyn Constraint>>,
    ) -> Result<Self> {
        reject_constraints(&mut *model)?;
        let latent = dynamics(&mut *model)?.latent_dim();
        if latent == 0 {
            return Err(Error::mismatch("the latent dimension of a model", "0", "at least 1"));
        }
        let (start, goals, slopes) = (vec![], vec![], vec![]);
        Ok(Self { model, objective, constraints, start, goals, latent, rollout: Rollout::default(), slopes })
    }

    /// Predicts the latents of the candidates.
    fn roll_out(&mut self, candidates: Candidates<'_>) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        if envs * self.latent != self.start.len() {
            let observed = format!("{}, the number of observed environments", self.start.len() / self.latent);
            return Err(Error::mismatch("the environments of an objective", envs.to_string(), observed));
        }
        check_len("the candidates of an objective", actions.len(), envs * samples * horizon * dim)?;
        check_all(Shape { horizon, latent: self.latent, dim }, &*self.objective, &self.constraints)?;
        self.rollout.run(dynamics(&mut *self.model)?, &self.start, self.latent, candidates)
    }

    /// The candidates with their latents, after [`ObjectiveCost::roll_out`].
    fn trajectories<'a>(&'a self, candidates: Candidates<'a>) -> Trajectories<'a> {
        Trajectories { candidates, latents: &self.rollout.latents, goals: &self.goals, latent: self.latent }
    }

    /// A zero gradient with respect to the latents.
    fn zero_slopes(&mut self) -> Vec<f32> {
        let mut slopes = std::mem::take(&mut self.slopes);
        slopes.clear();
        slopes.resize(self.rollout.latents.len(), 0.0);
        slopes
    }

    /// Adds the gradient with respect to the actions, computed from the gradient with respect to the latents.
    fn back_propagate(&mut self, candidates: Candidates<'_>, slopes: Vec<f32>, gradient: &mut [f32]) -> Result<()> {
        self.slopes = slopes;
        self.rollout.back(dynamics(&mut *self.model)?, self.latent, candidates, &mut self.slopes, gradient)
    }
}

fn dynamics(model: &mut dyn CostModel) -> Result<&mut dyn LatentDynamics> {
    let fix = "plan with the model's own cost, or with a model that has latent dynamics; of the terms, goal,when=closest alone, \
               without a weight, is a cost that some models have";
    model.latent().ok_or_else(|| Error::config("objective", "it uses latents, and this model has none", fix))
}

impl CostModel for ObjectiveCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.rollout.clear();
        self.model.observe(infos, envs)?;
        for latents in [&mut self.start, &mut self.goals] {
            latents.clear();
            latents.resize(envs.len() * self.latent, UNWRITTEN);
        }
        dynamics(&mut *self.model)?.encode(&mut self.start, &mut self.goals)
    }

    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        self.model.observe_env(slot, env)
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        check_len("the costs of an objective", costs.len(), candidates.envs * candidates.samples)?;
        self.roll_out(candidates)?;
        costs.fill(0.0);
        self.trajectories(candidates).add_costs(&*self.objective, costs);
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        Some(self)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        self.model.latent()
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        if self.constraints.is_empty() { None } else { Some(self) }
    }
}

impl DifferentiableCost for ObjectiveCost {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        check_len("the gradient of an objective", gradient.len(), candidates.actions.len())?;
        self.cost(candidates, costs)?;
        gradient.fill(0.0);
        let mut slopes = self.zero_slopes();
        self.trajectories(candidates).add_gradients(&*self.objective, &mut slopes, gradient);
        self.back_propagate(candidates, slopes, gradient)
    }
}

impl Constrained for ObjectiveCost {
    fn constraints(&self, horizon: usize) -> usize {
        self.constraints.iter().map(|constraint| constraint.count(horizon, self.latent)).sum()
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        self.roll_out(candidates)?;
        let trajectories = self.trajectories(candidates);
        check_len("the values of constraints", values.len(), trajectories.count(&self.constraints))?;
        trajectories.constrain(&self.constraints, values);
        Ok(())
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        check_len("the gradient of constraints", gradient.len(), candidates.actions.len())?;
        self.roll_out(candidates)?;
        let mut slopes = self.zero_slopes();
        let trajectories = self.trajectories(candidates);
        check_len("the weights of constraints", weights.len(), trajectories.count(&self.constraints))?;
        trajectories.add_constraint_gradients(&self.constraints, weights, &mut slopes, gradient);
        self.back_propagate(candidates, slopes, gradient)
    }
}
