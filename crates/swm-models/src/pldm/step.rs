//! One training step of a PLDM: the loss of a batch and the gradients of the loss.

use super::loss::{PldmLoss, Terms};
use super::model::Pldm;
use crate::lewm::joint::{self, JointStep};
use crate::lewm::step::TrainBatch;
use crate::nn::parameters::{self, IntoF32, Named};
use burn::module::Module;
use burn::tensor::Tensor;
use swm_core::Rng;

/// Losses and gradients of a batch.
pub struct PldmStep {
    /// The total loss, then the unweighted terms of the loss, by name.
    pub losses: Vec<(&'static str, f64)>,
    /// The flattened gradient of each parameter, by parameter name.
    pub gradients: Named<Tensor<1>>,
    /// The batch statistics, which update the model's running statistics.
    pub buffers: Named<Tensor<1>>,
    /// The latents, `[clips, steps, latent]`.
    pub latents: Vec<f32>,
}

/// Computes loss and gradients of a batch. `model` is outside autodiff; `shards` is at least 1.
pub fn step(model: &Pldm, batch: &TrainBatch, weights: &PldmLoss, shards: usize, noise: Option<&mut Rng>) -> PldmStep {
    let idm = model.idm.clone().train();
    let (mut terms, mut host, mut regulariser) = (vec![], vec![], 0.0);
    let value = |term: &Tensor<1>| f64::from(term.clone().inner().into_scalar::<f32>());
    let step = joint::step(&model.model, batch, shards, noise, |latents| {
        host = latents.clone().inner().into_data().into_f32_vec();
        let latent_terms = Terms::of(latents.clone());
        let [clips, steps, action_dim] = batch.actions.dims();
        let taken = batch.actions.clone().slice([0..clips, 0..steps - 1, 0..action_dim]).autodiff();
        let inverse = (idm.forward(latents.clone()) - taken).square().mean();
        let sum = latent_terms.sum(weights) + inverse.clone() * weights.idm;
        regulariser = value(&sum);
        terms = vec![
            ("std", value(&latent_terms.std)),
            ("std_t", value(&latent_terms.std_t)),
            ("cov", value(&latent_terms.cov)),
            ("cov_t", value(&latent_terms.cov_t)),
            ("temp_align", value(&latent_terms.temp_align)),
            ("idm", value(&inverse)),
        ];
        terms.extend(latent_terms.temp_straight.as_ref().map(|straight| ("temp_straight", value(straight))));
        sum
    });
    let JointStep { prediction, decoding, gradients, all, buffers } = step;
    let decoded = decoding.map_or(0.0, |(error, weight)| error * weight);
    let mut losses = vec![("loss", prediction + regulariser + decoded), ("prediction", prediction)];
    losses.extend(terms);
    losses.extend(decoding.map(|(error, _)| ("features", error)));
    let mut named = parameters::prefixed("model", gradients);
    named.extend(parameters::prefixed("idm", parameters::gradients(&idm, &all)));
    PldmStep { losses, gradients: named, buffers, latents: host }
}
