//! The prediction error of a batch and its gradients. The predictor processes shards of the windows in parallel; the
//! projector after the predictor processes all windows, because it normalises with the statistics of the batch.

use super::model::Lewm;
use crate::nn::parameters::{self, Named};
use crate::nn::{BatchStatistics, DropoutRng};
use burn::module::Module;
use burn::tensor::{Gradients, Tensor};
use rand::{Rng as _, SeedableRng as _};
use rayon::prelude::*;
use swm_core::Rng;

/// Windows of successive latents, all outside the autodiff graph.
pub(super) struct Windows {
    /// The latents from which the predictor predicts, `[windows, history, latent]`.
    pub latents: Tensor<3>,
    /// The actions that follow the latents, `[windows, history, action_dim]`.
    pub actions: Tensor<3>,
    /// The latents after the actions, `[windows, history, latent]`.
    pub targets: Tensor<3>,
}

/// The prediction error of a batch and its gradients.
pub(super) struct Prediction {
    /// The mean squared error of the predicted latents.
    pub error: f64,
    /// The flattened gradient of each parameter of the action encoder, the predictor and the projector after it, by
    /// parameter name.
    pub gradients: Named<Tensor<1>>,
    /// The gradient of [`Windows::latents`].
    pub latents: Tensor<3>,
    /// The gradient of [`Windows::targets`].
    pub targets: Tensor<3>,
    /// The batch statistics of the projector.
    pub statistics: BatchStatistics,
}

/// The forward pass of the predictor on a shard.
struct Shard {
    model: Lewm,
    latents: Tensor<3>,
    features: Tensor<3>,
}

/// Computes the prediction error and its gradients. `model` is outside autodiff; `shards` is at least 1.
pub(super) fn predict(model: &Lewm, windows: &Windows, shards: usize, mut noise: Option<&mut Rng>) -> Prediction {
    let [count, history, latent] = windows.latents.dims();
    let size = count.div_ceil(shards.max(1));
    let ranges: Vec<_> = (0..count).step_by(size).map(|start| start..(start + size).min(count)).collect();
    let part = |x: &Tensor<3>, range: &std::ops::Range<usize>| {
        let [_, steps, width] = x.dims();
        x.clone().slice([range.clone(), 0..steps, 0..width])
    };
    let noises: Vec<Option<Rng>> =
        ranges.iter().map(|_| noise.as_deref_mut().map(|rng| Rng::from_seed(rng.random()))).collect();
    let shards: Vec<Shard> = (ranges.par_iter().zip(noises))
        .map(|(range, mut noise)| {
            let model = model.clone().train();
            let latents = part(&windows.latents, range).autodiff().require_grad();
            let conditions = model.embed_actions(part(&windows.actions, range).autodiff());
            let features = model.predictor.forward(latents.clone(), conditions, &mut DropoutRng(noise.as_mut()));
            Shard { model, latents, features }
        })
        .collect();

    let projector = model.pred_proj.clone().train();
    let features = Tensor::cat(shards.iter().map(|shard| shard.features.clone().inner()).collect(), 0);
    let features = features.reshape([count * history, latent]).autodiff().require_grad();
    let targets = windows.targets.clone().autodiff().require_grad();
    let (predicted, statistics) = projector.forward_train(features.clone());
    let error = (predicted.reshape([count, history, latent]) - targets.clone()).square().mean();
    let value: f32 = error.clone().inner().into_scalar();
    let mut all = error.backward();
    let mut gradients = parameters::prefixed("pred_proj", parameters::gradients(&projector, &all));
    let d = gradient(&features, &mut all).reshape([count, history, latent]);

    let (latents, shards): (Vec<Tensor<3>>, Vec<Named<Tensor<1>>>) = (shards.into_par_iter().zip(&ranges))
        .map(|(shard, range)| {
            let mut all = (shard.features * part(&d, range).autodiff()).sum().backward();
            (gradient(&shard.latents, &mut all), parameters::gradients(&shard.model, &all))
        })
        .unzip();
    parameters::add_all(&mut gradients, shards);
    Prediction {
        error: f64::from(value),
        gradients,
        latents: Tensor::cat(latents, 0),
        targets: gradient(&targets, &mut all),
        statistics,
    }
}

/// Removes the gradient of a tensor; a tensor without effect has the gradient 0.
fn gradient<const D: usize>(x: &Tensor<D>, all: &mut Gradients) -> Tensor<D> {
    x.grad_remove(all).unwrap_or_else(|| x.clone().inner().zeros_like())
}
