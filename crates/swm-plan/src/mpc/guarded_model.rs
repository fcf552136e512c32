//! [`GuardedModel`]: the model as the policy passes it to a solver.
//!
//! The wrapper measures the time spent in the model, so that the planner's own time is known, and turns a panic of the
//! model into an error.

use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;
use swm_core::{Batch, Candidates, Constrained, CostModel, DifferentiableCost, Env, Error, LatentDynamics, Result};

/// Measures the time of a model's methods and converts panics to errors.
pub(crate) struct GuardedModel<'m> {
    /// A cell, because [`LatentDynamics::latent_dim`] and [`Constrained::constraints`] take `&self`, but
    /// [`CostModel::latent`] and [`CostModel::constrained`] take `&mut self`.
    model: RefCell<&'m mut dyn CostModel>,
    /// Seconds spent in the model.
    pub seconds: f64,
}

/// Runs `work`; converts a panic in `work` to an error that names `who`.
pub(crate) fn catch_panic<T>(who: &str, doing: &str, work: impl FnOnce() -> Result<T>) -> Result<T> {
    // A panic may leave values inconsistent, but the error ends the run, so these values are not used again.
    catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|panic| Err(Error::panicked(&format!("{who} panicked while {doing}"), &*panic)))
}

fn not_offered(what: &str) -> Error {
    Error::external("calling the model", format!("the model offered {what} earlier and no longer does"))
}

impl<'m> GuardedModel<'m> {
    /// Wraps a model.
    pub fn new(model: &'m mut dyn CostModel) -> Self {
        Self { model: RefCell::new(model), seconds: 0.0 }
    }

    fn call<T>(&mut self, doing: &str, method: impl FnOnce(&mut dyn CostModel) -> Result<T>) -> Result<T> {
        let begun = Instant::now();
        let result = catch_panic("the model", doing, || method(*self.model.get_mut()));
        self.seconds += begun.elapsed().as_secs_f64();
        result
    }
}

impl CostModel for GuardedModel<'_> {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.call("observing the present", |model| model.observe(infos, envs))
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.call("scoring candidates", |model| model.cost(candidates, costs))
    }

    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        self.call("observing an environment", |model| model.observe_env(slot, env))
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        self.model.get_mut().differentiable().is_some().then_some(self as _)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        self.model.get_mut().latent().is_some().then_some(self as _)
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        self.model.get_mut().constrained().is_some().then_some(self as _)
    }
}

impl DifferentiableCost for GuardedModel<'_> {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.call("differentiating its cost", |model| {
            let model = model.differentiable().ok_or_else(|| not_offered("a gradient"))?;
            model.cost_and_gradient(candidates, costs, gradient)
        })
    }
}

impl LatentDynamics for GuardedModel<'_> {
    fn latent_dim(&self) -> usize {
        self.model.borrow_mut().latent().map_or(0, |model| model.latent_dim())
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        self.call("encoding start and goal", |model| {
            model.latent().ok_or_else(|| not_offered("a latent state"))?.encode(start, goal)
        })
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        self.call("predicting", |model| {
            model.latent().ok_or_else(|| not_offered("a latent state"))?.predict(latents, actions, next)
        })
    }

    fn predict_vjp(
        &mut self,
        latents: &[f32],
        actions: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()> {
        self.call("differentiating its prediction", |model| {
            let model = model.latent().ok_or_else(|| not_offered("a latent state"))?;
            model.predict_vjp(latents, actions, next_gradient, latent_gradient, action_gradient)
        })
    }
}

impl Constrained for GuardedModel<'_> {
    fn constraints(&self, horizon: usize) -> usize {
        self.model.borrow_mut().constrained().map_or(0, |model| model.constraints(horizon))
    }

    fn constrain(&mut self, candidates: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        self.call("checking constraints", |model| {
            model.constrained().ok_or_else(|| not_offered("constraints"))?.constrain(candidates, values)
        })
    }

    fn constrain_vjp(&mut self, candidates: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        self.call("differentiating constraints", |model| {
            model.constrained().ok_or_else(|| not_offered("constraints"))?.constrain_vjp(candidates, weights, gradient)
        })
    }
}
