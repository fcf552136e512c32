//! [`ObjectiveCost`]: an objective over what a model's latent dynamics predict.

use super::regularised::refuse_constraints;
use super::{Constraint, Objective, Rolled, Shape, check_all, check_room};
use crate::problem::UNWRITTEN;
use swm_core::{Batch, Candidates, Constrained, CostModel, DifferentiableCost, Env, Error, LatentDynamics, Result};

/// Rolls out a model's [`LatentDynamics`] from the present latent, step by step, and applies an objective and constraints to
/// what comes. Its gradient is that of back-propagation through time.
///
/// Only [`LatentDynamics`] is asked, so of a model that looks at several past states, such as a LeWM, it is the one-step
/// model that is rolled out: its terminal goal term is near to that model's own cost, not equal to it.
pub struct ObjectiveCost {
    model: Box<dyn CostModel>,
    objective: Box<dyn Objective>,
    constraints: Vec<Box<dyn Constraint>>,
    /// The present latents of the observed environments, and those of their goals, `[envs, latent]`.
    start: Vec<f32>,
    goals: Vec<f32>,
    latent: usize,
    rollout: Rollout,
    /// How the price changes with every latent, of the shape of the latents.
    slopes: Vec<f32>,
}

impl ObjectiveCost {
    /// An objective and constraints over a model that shows its latents.
    ///
    /// # Errors
    /// When the model shows no latents, or has constraints of its own.
    pub fn new(
        mut model: Box<dyn CostModel>,
        objective: Box<dyn Objective>,
        constraints: Vec<Box<dyn Constraint>>,
    ) -> Result<Self> {
        refuse_constraints(&mut *model)?;
        let latent = dynamics(&mut *model)?.latent_dim();
        if latent == 0 {
            return Err(Error::mismatch("the latent state of a model", "0 numbers", "at least 1"));
        }
        let (start, goals, slopes) = (vec![], vec![], vec![]);
        Ok(Self { model, objective, constraints, start, goals, latent, rollout: Rollout::default(), slopes })
    }

    /// Predicts where candidates lead.
    fn roll_out(&mut self, candidates: Candidates<'_>) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        if envs * self.latent != self.start.len() {
            let observed = format!("{}, which were observed", self.start.len() / self.latent);
            return Err(Error::mismatch("the environments of an objective", envs.to_string(), observed));
        }
        check_room("the candidates of an objective", actions.len(), envs * samples * horizon * dim)?;
        check_all(Shape { horizon, latent: self.latent, dim }, &*self.objective, &self.constraints)?;
        self.rollout.run(dynamics(&mut *self.model)?, &self.start, self.latent, candidates)
    }

    /// Candidates and where they lead, once that is predicted.
    fn rolled<'a>(&'a self, candidates: Candidates<'a>) -> Rolled<'a> {
        Rolled { candidates, latents: &self.rollout.latents, goals: &self.goals, latent: self.latent }
    }

    /// No slope yet in any latent.
    fn flat(&mut self) -> Vec<f32> {
        let mut slopes = std::mem::take(&mut self.slopes);
        slopes.clear();
        slopes.resize(self.rollout.latents.len(), 0.0);
        slopes
    }

    /// Turns slopes in latents into slopes in the actions that lead there.
    fn back_propagate(&mut self, candidates: Candidates<'_>, slopes: Vec<f32>, gradient: &mut [f32]) -> Result<()> {
        self.slopes = slopes;
        self.rollout.back(dynamics(&mut *self.model)?, self.latent, candidates, &mut self.slopes, gradient)
    }
}

fn dynamics(model: &mut dyn CostModel) -> Result<&mut dyn LatentDynamics> {
    let fix = "plan with its own cost, or with a model that shows them";
    model.latent().ok_or_else(|| Error::config("objective", "it prices latents, and this model shows none", fix))
}

impl CostModel for ObjectiveCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.rollout.forget();
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
        check_room("the costs of an objective", costs.len(), candidates.envs * candidates.samples)?;
        self.roll_out(candidates)?;
        costs.fill(0.0);
        self.rolled(candidates).add_costs(&*self.objective, costs);
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
        check_room("the gradient of an objective", gradient.len(), candidates.actions.len())?;
        self.cost(candidates, costs)?;
        gradient.fill(0.0);
        let mut slopes = self.flat();
        self.rolled(candidates).add_gradients(&*self.objective, &mut slopes, gradient);
        self.back_propagate(candidates, slopes, gradient)
    }
}

impl Constrained for ObjectiveCost {
    fn constraints(&self, horizon: usize) -> usize {
        self.constraints.iter().map(|constraint| constraint.count(horizon, self.latent)).sum()
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        self.roll_out(candidates)?;
        let rolled = self.rolled(candidates);
        check_room("the values of constraints", values.len(), rolled.count(&self.constraints))?;
        rolled.constrain(&self.constraints, values);
        Ok(())
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        check_room("the gradient of constraints", gradient.len(), candidates.actions.len())?;
        self.roll_out(candidates)?;
        let mut slopes = self.flat();
        let rolled = self.rolled(candidates);
        check_room("the weights of constraints", weights.len(), rolled.count(&self.constraints))?;
        rolled.add_constraint_gradients(&self.constraints, weights, &mut slopes, gradient);
        self.back_propagate(candidates, slopes, gradient)
    }
}

/// Where the candidates that were asked about last lead. Costs, constraints and gradients of the same candidates share it.
#[derive(Default)]
struct Rollout {
    /// The candidates' actions and `[envs, samples, horizon, dim]`.
    actions: Vec<f32>,
    shape: [usize; 4],
    /// The present and what is predicted, `[envs, samples, horizon + 1, latent]`.
    latents: Vec<f32>,
    /// One step of all candidates: the latents before, the actions, and the latents behind.
    now: Vec<f32>,
    by: Vec<f32>,
    next: Vec<f32>,
    /// Gradients with respect to `now` and `by`.
    now_gradient: Vec<f32>,
    by_gradient: Vec<f32>,
}

impl Rollout {
    fn forget(&mut self) {
        self.shape = [0; 4];
    }

    /// Predicts step by step, for all candidates at once.
    fn run(
        &mut self,
        model: &mut dyn LatentDynamics,
        start: &[f32],
        latent: usize,
        candidates: Candidates<'_>,
    ) -> Result<()> {
        let Candidates { actions, envs, samples, horizon, dim } = candidates;
        let shape = [envs, samples, horizon, dim];
        if self.shape == shape && self.actions == actions {
            return Ok(());
        }
        self.forget();
        let way = (horizon + 1) * latent;
        self.latents.clear();
        self.latents.resize(envs * samples * way, 0.0);
        for (row, latents) in self.latents.chunks_exact_mut(way).enumerate() {
            latents[..latent].copy_from_slice(&start[row / samples * latent..][..latent]);
        }
        self.next.resize(envs * samples * latent, 0.0);
        for t in 0..horizon {
            gather(&self.latents, way, t * latent, latent, &mut self.now);
            gather(actions, horizon * dim, t * dim, dim, &mut self.by);
            self.next.fill(UNWRITTEN);
            model.predict(&self.now, &self.by, &mut self.next)?;
            for (latents, next) in self.latents.chunks_exact_mut(way).zip(self.next.chunks_exact(latent)) {
                latents[(t + 1) * latent..][..latent].copy_from_slice(next);
            }
        }
        self.actions.clear();
        self.actions.extend_from_slice(actions);
        self.shape = shape;
        Ok(())
    }

    /// Carries slopes in latents back to the actions, from the last step to the first.
    fn back(
        &mut self,
        model: &mut dyn LatentDynamics,
        latent: usize,
        candidates: Candidates<'_>,
        slopes: &mut [f32],
        gradient: &mut [f32],
    ) -> Result<()> {
        let Candidates { actions, horizon, dim, .. } = candidates;
        let (way, len) = ((horizon + 1) * latent, horizon * dim);
        for t in (0..horizon).rev() {
            gather(slopes, way, (t + 1) * latent, latent, &mut self.next);
            // Nothing depends on these latents, as when only actions are priced or constrained.
            if self.next.iter().all(|&slope| slope == 0.0) {
                continue;
            }
            gather(&self.latents, way, t * latent, latent, &mut self.now);
            gather(actions, len, t * dim, dim, &mut self.by);
            self.now_gradient.resize(self.now.len(), 0.0);
            self.by_gradient.resize(self.by.len(), 0.0);
            self.now_gradient.fill(UNWRITTEN);
            self.by_gradient.fill(UNWRITTEN);
            model.predict_vjp(&self.now, &self.by, &self.next, &mut self.now_gradient, &mut self.by_gradient)?;
            add(slopes, way, t * latent, latent, &self.now_gradient);
            add(gradient, len, t * dim, dim, &self.by_gradient);
        }
        Ok(())
    }
}

/// The `width` numbers from `at` on of every row.
fn gather(rows: &[f32], row: usize, at: usize, width: usize, to: &mut Vec<f32>) {
    to.clear();
    rows.chunks_exact(row).for_each(|numbers| to.extend_from_slice(&numbers[at..at + width]));
}

/// Adds to the `width` numbers from `at` on of every row.
fn add(rows: &mut [f32], row: usize, at: usize, width: usize, what: &[f32]) {
    for (numbers, what) in rows.chunks_exact_mut(row).zip(what.chunks_exact(width)) {
        numbers[at..at + width].iter_mut().zip(what).for_each(|(number, what)| *number += what);
    }
}
