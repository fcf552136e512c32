//! [`DifferentiableCost`] and [`LatentDynamics`] for [`LewmCost`]: gradients with respect to actions, and
//! vector-Jacobian products of predictions, by Burn's autodiff.
//!
//! The state of a solver is the latent of one frame: [`LatentDynamics::predict`] uses a window of one latent, as
//! training does at the first frame of every clip. The cost and the gradient of the cost use the whole window.
//!
//! The rows of each environment are split into chunks separately, so that the results of an environment do not depend
//! on the other environments.

use super::cost::{LewmCost, PlanContext};
use super::model::Lewm;
use crate::nn::parameters::IntoF32;
use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{Candidates, DifferentiableCost, Error, LatentDynamics, Result};

/// Creates a tensor on the device of a model.
fn tensor<const D: usize>(model: &Lewm, values: Vec<f32>, shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), &model.device().inner())
}

/// Returns the number of rows that are differentiated in one call, given `rows` rows: equal chunks of at most 80 rows.
/// The rounding of Burn's products depends on the chunk size, so the chunk size must not depend on the machine.
fn chunk_size(rows: usize) -> usize {
    rows.div_ceil(rows.div_ceil(80).max(1)).max(1)
}

/// Returns the model in an autodiff graph with constant weights.
fn differentiable(model: &Lewm) -> Lewm {
    model.clone().train().no_grad()
}

/// Writes the costs of one environment's candidates, and the gradients of the costs.
///
/// # Shapes
/// `actions` and `gradient` are `[samples, horizon, dim]`, `costs` is `[samples]`.
fn cost_and_gradient(
    model: &Lewm,
    context: &PlanContext,
    closest: bool,
    [samples, horizon, dim]: [usize; 3],
    actions: &[f32],
    costs: &mut [f32],
    gradient: &mut [f32],
) {
    let (latent, past) = (context.goal.len(), context.past.len() / dim);
    let frames = context.start.len() / latent;
    let start = tensor(model, context.start.repeat(samples), [samples, frames, latent]).autodiff();
    let leaf = tensor(model, actions.to_vec(), [samples, horizon, dim]).autodiff().require_grad();
    let all_actions = match past {
        0 => leaf.clone(),
        _ => Tensor::cat(
            vec![tensor(model, context.past.repeat(samples), [samples, past, dim]).autodiff(), leaf.clone()],
            1,
        ),
    };
    let last = frames + horizon - 1;
    let compared = if closest { horizon } else { 1 };
    let ends = model.rollout(start, all_actions).slice([0..samples, last + 1 - compared..last + 1, 0..latent]);
    let goal = tensor(model, context.goal.repeat(samples), [samples, 1, latent]).autodiff();
    let distances = (ends - goal).square().sum_dim(2);
    let cost = if closest { distances.min_dim(1) } else { distances };
    costs.copy_from_slice(&cost.clone().inner().into_data().into_f32_vec());
    let all = cost.sum().backward();
    copy_gradient(leaf.grad(&all), gradient);
}

/// Copies the gradient of a leaf; writes zeros if the leaf has no gradient.
fn copy_gradient<const D: usize>(gradient: Option<Tensor<D>>, to: &mut [f32]) {
    match gradient {
        Some(gradient) => to.copy_from_slice(&gradient.into_data().into_f32_vec()),
        None => to.fill(0.0),
    }
}

impl DifferentiableCost for LewmCost {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.check_sizes(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        if gradient.len() != actions.len() {
            let (given, expected) = (gradient.len().to_string(), actions.len().to_string());
            return Err(Error::mismatch("the number of elements in the gradient of a LeWM's cost", given, expected));
        }
        let model = differentiable(&self.model);
        let (width, chunk_size) = (horizon * dim, chunk_size(samples));
        let rows = costs.par_chunks_mut(samples).zip(gradient.par_chunks_mut(samples * width));
        rows.zip(actions.par_chunks(samples * width)).zip(&self.contexts).for_each(
            |(((costs, gradient), actions), context)| {
                let chunks = costs.par_chunks_mut(chunk_size).zip(gradient.par_chunks_mut(chunk_size * width));
                chunks.zip(actions.par_chunks(chunk_size * width)).for_each(|((costs, gradient), actions)| {
                    let shape = [costs.len(), horizon, dim];
                    cost_and_gradient(&model, context, self.closest, shape, actions, costs, gradient);
                });
            },
        );
        Ok(())
    }
}

impl LewmCost {
    /// Checks the lengths of latents, actions and additional arrays, each given as (name, length, width). Returns the
    /// number of rows per environment.
    fn rows_per_environment(
        &self,
        latents: &[f32],
        actions: &[f32],
        additional: &[(&str, usize, usize)],
    ) -> Result<usize> {
        let (latent, envs) = (self.config.latent, self.contexts.len().max(1));
        let n = latents.len() / latent;
        let given = [("latents", latents.len(), latent), ("actions", actions.len(), self.action_dim)];
        for &(what, length, width) in given.iter().chain(additional) {
            if length != n * width || !n.is_multiple_of(envs) {
                return Err(Error::mismatch(
                    format!("one step of a LeWM: {what}"),
                    format!("{length} elements"),
                    format!("{n} rows of {width} elements, and equally many rows for each of {envs} environments"),
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
                format!("{} and {} elements", start.len(), goal.len()),
                format!("{latent} elements of each per environment, for {} observed environments", self.contexts.len()),
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
        let rows = self.rows_per_environment(latents, actions, &[("next latents", next.len(), latent)])?;
        let inputs = chunks(latents, rows, latent).zip(chunks(actions, rows, self.action_dim));
        let mut work: Vec<_> = inputs.zip(chunks_mut(next, rows, latent)).collect();
        work.par_iter_mut().for_each(|((latents, actions), next)| {
            let (n, dim) = (latents.len() / latent, self.action_dim);
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
        let (latent, dim) = (self.config.latent, self.action_dim);
        let additional = [
            ("gradients of next latents", next_gradient.len(), latent),
            ("gradients of latents", latent_gradient.len(), latent),
            ("gradients of actions", action_gradient.len(), dim),
        ];
        let rows = self.rows_per_environment(latents, actions, &additional)?;
        let model = differentiable(&self.model);
        let given =
            chunks(latents, rows, latent).zip(chunks(actions, rows, dim)).zip(chunks(next_gradient, rows, latent));
        let outputs = chunks_mut(latent_gradient, rows, latent).zip(chunks_mut(action_gradient, rows, dim));
        let mut work: Vec<_> = given.zip(outputs).collect();
        work.par_iter_mut().for_each(|(((latents, actions), cotangent), (latent_gradient, action_gradient))| {
            let n = latents.len() / latent;
            let latent_leaf = tensor(&model, latents.to_vec(), [n, 1, latent]).autodiff().require_grad();
            let action_leaf = tensor(&model, actions.to_vec(), [n, 1, dim]).autodiff().require_grad();
            let next = model.predict(latent_leaf.clone(), model.embed_actions(action_leaf.clone()));
            let all = (next * tensor(&model, cotangent.to_vec(), [n, 1, latent]).autodiff()).sum().backward();
            copy_gradient(latent_leaf.grad(&all), latent_gradient);
            copy_gradient(action_leaf.grad(&all), action_gradient);
        });
        Ok(())
    }
}

/// Splits rows of `width` elements into chunks; no chunk spans two environments.
fn chunks(values: &[f32], rows: usize, width: usize) -> impl Iterator<Item = &[f32]> {
    let chunk_size = chunk_size(rows);
    values.chunks(rows.max(1) * width).flat_map(move |env| env.chunks(chunk_size * width))
}

/// Splits mutable rows of `width` elements into chunks; no chunk spans two environments.
fn chunks_mut(values: &mut [f32], rows: usize, width: usize) -> impl Iterator<Item = &mut [f32]> {
    let chunk_size = chunk_size(rows);
    values.chunks_mut(rows.max(1) * width).flat_map(move |env| env.chunks_mut(chunk_size * width))
}
