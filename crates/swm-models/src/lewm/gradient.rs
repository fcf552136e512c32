//! Gradients of [`LewmCost`] with respect to actions, and one step of its dynamics with vector-Jacobian products, by
//! Burn's automatic differentiation of [`Lewm::rollout`].
//!
//! The latent state a solver sees is that of one frame: [`LatentDynamics::predict`] is the predictor with a window of one
//! latent, as it is trained on the first frame of every clip. The cost and its gradient see the whole window.
//!
//! As in the cost, parts are counted from each environment's first row, so that what an environment is given does not
//! depend on its neighbours.

use super::cost::{LewmCost, PlanContext};
use super::model::Lewm;
use crate::nn::parameters::IntoF32;
use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{Candidates, DifferentiableCost, Error, LatentDynamics, Result};

/// Rows of numbers as a tensor, where a model computes.
fn tensor<const D: usize>(model: &Lewm, numbers: Vec<f32>, shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(numbers, shape), &model.device().inner())
}

/// How many of `rows` are differentiated at once: equal parts of at most 80. Burn's products depend on it, so it does not
/// depend on the machine.
fn part(rows: usize) -> usize {
    rows.div_ceil(rows.div_ceil(80).max(1)).max(1)
}

/// The model, as differentiation wants it: its weights are constants.
fn differentiable(model: &Lewm) -> Lewm {
    model.clone().train().no_grad()
}

/// Costs of some candidates of one environment, `[samples, horizon, dim]`, and their gradients.
fn cost_and_gradient(
    model: &Lewm,
    context: &PlanContext,
    [samples, horizon, dim]: [usize; 3],
    actions: &[f32],
    costs: &mut [f32],
    gradient: &mut [f32],
) {
    let (latent, past) = (context.goal.len(), context.past.len() / dim);
    let seen = context.start.len() / latent;
    let start = tensor(model, context.start.repeat(samples), [samples, seen, latent]).autodiff();
    let free = tensor(model, actions.to_vec(), [samples, horizon, dim]).autodiff().require_grad();
    let taken = match past {
        0 => free.clone(),
        _ => Tensor::cat(
            vec![tensor(model, context.past.repeat(samples), [samples, past, dim]).autodiff(), free.clone()],
            1,
        ),
    };
    let last = seen + horizon - 1;
    let end = model.rollout(start, taken).slice([0..samples, last..last + 1, 0..latent]);
    let goal = tensor(model, context.goal.repeat(samples), [samples, 1, latent]).autodiff();
    let cost = (end - goal).square().sum_dim(2);
    costs.copy_from_slice(&cost.clone().inner().into_data().into_f32_vec());
    let all = cost.sum().backward();
    copy_gradient(free.grad(&all), gradient);
}

/// The gradient of a leaf; none where nothing depends on it.
fn copy_gradient<const D: usize>(found: Option<Tensor<D>>, to: &mut [f32]) {
    match found {
        Some(found) => to.copy_from_slice(&found.into_data().into_f32_vec()),
        None => to.fill(0.0),
    }
}

impl DifferentiableCost for LewmCost {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.check_sizes(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        if gradient.len() != actions.len() {
            let (given, expected) = (gradient.len().to_string(), actions.len().to_string());
            return Err(Error::mismatch("the gradient of a LeWM's cost, in numbers", given, expected));
        }
        let model = differentiable(&self.model);
        let (numbers, part) = (horizon * dim, part(samples));
        let rows = costs.par_chunks_mut(samples).zip(gradient.par_chunks_mut(samples * numbers));
        rows.zip(actions.par_chunks(samples * numbers)).zip(&self.contexts).for_each(
            |(((costs, gradient), actions), context)| {
                let parts = costs.par_chunks_mut(part).zip(gradient.par_chunks_mut(part * numbers));
                parts.zip(actions.par_chunks(part * numbers)).for_each(|((costs, gradient), actions)| {
                    cost_and_gradient(&model, context, [costs.len(), horizon, dim], actions, costs, gradient);
                });
            },
        );
        Ok(())
    }
}

impl LewmCost {
    /// Checks pairs of latents and actions; returns how many rows of them one environment has.
    fn pairs(&self, latents: &[f32], actions: &[f32], others: &[(&str, usize, usize)]) -> Result<usize> {
        let (latent, envs) = (self.config.latent, self.contexts.len().max(1));
        let n = latents.len() / latent;
        let given = [("latents", latents.len(), latent), ("actions", actions.len(), self.actions)];
        for &(what, numbers, width) in given.iter().chain(others) {
            if numbers != n * width || !n.is_multiple_of(envs) {
                return Err(Error::mismatch(
                    format!("one step of a LeWM: {what}"),
                    format!("{numbers} numbers"),
                    format!("{n} rows of {width}, equally many for each of {envs} environments"),
                ));
            }
        }
        Ok(n / envs)
    }
}

impl LatentDynamics for LewmCost {
    fn latent_dim(&self) -> usize {
        self.config.latent
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        let latent = self.config.latent;
        let expected = self.contexts.len() * latent;
        if self.contexts.is_empty() || start.len() != expected || goal.len() != expected {
            return Err(Error::mismatch(
                "the latents of start and goal of a LeWM",
                format!("{} and {} numbers", start.len(), goal.len()),
                format!("{latent} of each for every one of {} observed environments", self.contexts.len()),
            ));
        }
        for ((start, goal), context) in
            start.chunks_exact_mut(latent).zip(goal.chunks_exact_mut(latent)).zip(&self.contexts)
        {
            start.copy_from_slice(&context.start[context.start.len() - latent..]);
            goal.copy_from_slice(&context.goal);
        }
        Ok(())
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        let latent = self.config.latent;
        let rows = self.pairs(latents, actions, &[("next latents", next.len(), latent)])?;
        let parts = chunks(latents, rows, latent).zip(chunks(actions, rows, self.actions));
        let mut work: Vec<_> = parts.zip(chunks_mut(next, rows, latent)).collect();
        work.par_iter_mut().for_each(|((latents, actions), next)| {
            let (n, dim) = (latents.len() / latent, self.actions);
            let window = tensor(&self.model, latents.to_vec(), [n, 1, latent]);
            let conditions = self.model.embed_actions(tensor(&self.model, actions.to_vec(), [n, 1, dim]));
            next.copy_from_slice(&self.model.predict(window, conditions).into_data().into_f32_vec());
        });
        Ok(())
    }

    fn predict_vjp(
        &mut self,
        latents: &[f32],
        actions: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()> {
        let (latent, dim) = (self.config.latent, self.actions);
        let others = [
            ("gradients of next latents", next_gradient.len(), latent),
            ("gradients of latents", latent_gradient.len(), latent),
            ("gradients of actions", action_gradient.len(), dim),
        ];
        let rows = self.pairs(latents, actions, &others)?;
        let model = differentiable(&self.model);
        let given =
            chunks(latents, rows, latent).zip(chunks(actions, rows, dim)).zip(chunks(next_gradient, rows, latent));
        let asked = chunks_mut(latent_gradient, rows, latent).zip(chunks_mut(action_gradient, rows, dim));
        let mut work: Vec<_> = given.zip(asked).collect();
        work.par_iter_mut().for_each(|(((latents, actions), pull), (latent_gradient, action_gradient))| {
            let n = latents.len() / latent;
            let from = tensor(&model, latents.to_vec(), [n, 1, latent]).autodiff().require_grad();
            let by = tensor(&model, actions.to_vec(), [n, 1, dim]).autodiff().require_grad();
            let next = model.predict(from.clone(), model.embed_actions(by.clone()));
            let all = (next * tensor(&model, pull.to_vec(), [n, 1, latent]).autodiff()).sum().backward();
            copy_gradient(from.grad(&all), latent_gradient);
            copy_gradient(by.grad(&all), action_gradient);
        });
        Ok(())
    }
}

/// Rows of `width` numbers in the parts they are computed in: each environment's `rows` by themselves.
fn chunks(numbers: &[f32], rows: usize, width: usize) -> impl Iterator<Item = &[f32]> {
    let part = part(rows);
    numbers.chunks(rows.max(1) * width).flat_map(move |env| env.chunks(part * width))
}

/// As [`chunks`], to be written.
fn chunks_mut(numbers: &mut [f32], rows: usize, width: usize) -> impl Iterator<Item = &mut [f32]> {
    let part = part(rows);
    numbers.chunks_mut(rows.max(1) * width).flat_map(move |env| env.chunks_mut(part * width))
}
