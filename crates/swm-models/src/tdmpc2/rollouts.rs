//! [`Rollouts`]: rollouts of a TD-MPC2 without autodiff, which evaluate and propose action sequences.

use super::model::Tdmpc2;
use super::step::expected_values;
use crate::nn::parameters::IntoF32;
use crate::nn::{DropoutRng, Ensemble, normal};
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use swm_core::Key;

/// The number of candidates that are rolled out together; the chunks of a population run in parallel.
const CHUNK_SIZE: usize = 128;

/// A model prepared for rollouts.
pub struct Rollouts {
    model: Tdmpc2,
    critics: Ensemble,
    discount: f64,
    uncertainty: f64,
}

impl Rollouts {
    /// Creates rollouts with a `discount` per step; `uncertainty` is the weight of the Q functions'
    /// standard deviation, which lowers the final value.
    pub fn new(model: &Tdmpc2, discount: f64, uncertainty: f64) -> Self {
        let critics = Ensemble::of(&model.qs.iter().collect::<Vec<_>>());
        Self { model: model.clone(), critics, discount, uncertainty }
    }

    /// Returns the model.
    pub fn model(&self) -> &Tdmpc2 {
        &self.model
    }

    /// Writes the costs of candidates that start at one latent: the negated sum of the discounted rewards and of the
    /// value of the policy's action after the last step.
    ///
    /// # Shapes
    /// `latent` is `[latent]`, `candidates` is `[samples, horizon, action_dim]`, `costs` is `[samples]`.
    pub fn cost(&self, latent: &[f32], candidates: &[f32], horizon: usize, costs: &mut [f32]) {
        let width = horizon * self.model.action_dim();
        let chunks = costs.par_chunks_mut(CHUNK_SIZE).zip(candidates.par_chunks(CHUNK_SIZE * width));
        chunks.for_each(|(costs, candidates)| costs.copy_from_slice(&self.chunk_costs(latent, candidates, horizon)));
    }

    fn chunk_costs(&self, latent: &[f32], candidates: &[f32], horizon: usize) -> Vec<f32> {
        let model = &self.model;
        let (device, bins, width) = (model.device(), model.config().bins, model.action_dim());
        let samples = candidates.len() / (horizon * width);
        let candidates =
            Tensor::<3>::from_data(TensorData::new(candidates.to_vec(), [samples, horizon, width]), &device);
        let start = Tensor::<2>::from_data(TensorData::new(latent.to_vec(), [1, latent.len()]), &device);
        let mut latents = start.expand([samples, latent.len()]);
        let mut inputs = vec![];
        // `alive` is 1 while the episode continues, else 0; `weights` has the weight of each reward.
        let mut alive = Tensor::<1>::ones([samples], &device);
        let mut weights = vec![];
        for step in 0..horizon {
            let actions = candidates.clone().slice([0..samples, step..step + 1]).reshape([samples, width]);
            let input = Tensor::cat(vec![latents, actions], 1);
            latents = model.next(input.clone());
            inputs.push(input);
            weights.push(alive.clone() * self.discount.powi(step as i32));
            if let Some(head) = &model.termination {
                let logits: Tensor<1> = head.forward(latents.clone()).squeeze_dim(1);
                alive = alive * logits.lower_elem(0.0).float();
            }
        }
        let rewards = bins.expectation(model.reward.forward(Tensor::cat(inputs, 0))) * Tensor::cat(weights, 0);
        let returns: Tensor<1> = rewards.reshape([horizon, samples]).sum_dim(0).squeeze_dim(0);

        let policy = model.policy(latents.clone()).mean.tanh();
        let q = expected_values(
            bins,
            self.critics.forward(Tensor::cat(vec![latents, policy], 1), 0.0, &mut DropoutRng::disabled()),
        );
        let [count, _] = q.dims();
        let mean = q.clone().mean_dim(0);
        let unbiased = (count as f64 - 1.0).max(1.0);
        let std = ((q - mean.clone()).square().sum_dim(0) / unbiased).sqrt();
        let value: Tensor<1> = (mean.clone() - mean.abs() * std * self.uncertainty).squeeze_dim(0);
        (returns + value * alive * self.discount.powi(horizon as i32)).neg().into_data().into_f32_vec()
    }

    /// Returns the policy's actions: the mean, or samples drawn with one key per row.
    ///
    /// # Shapes
    /// `latents` is `[rows, latent]`; returns `[rows, action_dim]`.
    pub fn act(&self, latents: Tensor<2>, keys: Option<&[Key]>) -> Tensor<2> {
        let gaussian = self.model.policy(latents);
        match keys {
            None => gaussian.mean.tanh(),
            Some(keys) => {
                let width = self.model.action_dim();
                let noise = normal(keys, width);
                gaussian.sample(Tensor::from_data(TensorData::new(noise, [keys.len(), width]), &self.model.device()))
            }
        }
    }

    /// Writes action sequences that begin with the actions `prefix` and continue with samples of the policy. `key` and
    /// the index of a sequence determine the samples of the sequence.
    ///
    /// # Shapes
    /// `latent` is `[latent]`, `prefix` is `[steps, action_dim]`, `proposals` is `[samples, horizon, action_dim]`.
    pub fn propose(&self, latent: &[f32], prefix: &[f32], horizon: usize, key: Key, proposals: &mut [f32]) {
        let (device, width) = (self.model.device(), self.model.action_dim());
        let samples = proposals.len() / (horizon * width);
        let start = Tensor::<2>::from_data(TensorData::new(latent.to_vec(), [1, latent.len()]), &device);
        let mut latents = start.expand([samples, latent.len()]);
        for step in 0..horizon {
            let actions = match prefix.get(step * width..(step + 1) * width) {
                Some(given) => Tensor::<2>::from_data(TensorData::new(given.to_vec(), [1, width]), &device)
                    .expand([samples, width]),
                None => {
                    let keys: Vec<Key> = (0..samples as u64).map(|i| key.at(i).at(step as u64)).collect();
                    self.act(latents.clone(), Some(&keys))
                }
            };
            let values = actions.to_data().into_f32_vec();
            for (proposal, action) in proposals.chunks_exact_mut(horizon * width).zip(values.chunks_exact(width)) {
                proposal[step * width..(step + 1) * width].copy_from_slice(action);
            }
            latents = self.model.next(Tensor::cat(vec![latents, actions], 1));
        }
    }
}
