//! One training step of a PLDM: loss and gradients of a batch.

use super::loss::{PldmLoss, Terms};
use super::model::Pldm;
use crate::lewm::joint::{self, Found};
use crate::lewm::step::TrainBatch;
use crate::nn::BatchStatistics;
use crate::nn::parameters::{self, IntoF32, Named};
use burn::module::Module;
use burn::tensor::Tensor;
use swm_core::Rng;

/// What a step found.
pub struct StepOutput {
    /// The total loss, then its terms before they are weighted, by the names of their weights.
    pub losses: Vec<(&'static str, f64)>,
    /// Gradients by parameter, flat.
    pub gradients: Named<Tensor<1>>,
    /// Batch statistics of the projections behind the encoder and the predictor.
    pub statistics: [BatchStatistics; 2],
    /// The latents, `[clips, steps, latent]`.
    pub latents: Vec<f32>,
}

/// Loss and gradients of a batch.
///
/// `model` is without autodiff; `shards` is at least 1.
pub fn step(
    model: &Pldm,
    batch: &TrainBatch,
    weights: &PldmLoss,
    shards: usize,
    noise: Option<&mut Rng>,
) -> StepOutput {
    let idm = model.idm.clone().train();
    let (mut terms, mut host, mut pull) = (vec![], vec![], 0.0);
    let value = |term: &Tensor<1>| f64::from(term.clone().inner().into_scalar::<f32>());
    let found = joint::step(&model.model, batch, shards, noise, |latents| {
        host = latents.clone().inner().into_data().into_f32_vec();
        let of = Terms::of(latents.clone());
        let [clips, steps, actions] = batch.actions.dims();
        let taken = batch.actions.clone().slice([0..clips, 0..steps - 1, 0..actions]).autodiff();
        let inverse = (idm.forward(latents.clone()) - taken).square().mean();
        let sum = of.sum(weights) + inverse.clone() * weights.idm;
        pull = value(&sum);
        terms = vec![
            ("std", value(&of.std)),
            ("std_t", value(&of.std_t)),
            ("cov", value(&of.cov)),
            ("cov_t", value(&of.cov_t)),
            ("temp_align", value(&of.temp_align)),
            ("idm", value(&inverse)),
        ];
        terms.extend(of.temp_straight.as_ref().map(|straight| ("temp_straight", value(straight))));
        sum
    });
    let Found { prediction, gradients, others, statistics } = found;
    let mut losses = vec![("loss", prediction + pull), ("prediction", prediction)];
    losses.extend(terms);
    let mut all = prefixed("model", gradients);
    all.extend(prefixed("idm", parameters::gradients(&idm, &others)));
    StepOutput { losses, gradients: all, statistics, latents: host }
}

fn prefixed<T>(part: &str, named: Named<T>) -> Named<T> {
    named.into_iter().map(|(name, value)| (format!("{part}.{name}"), value)).collect()
}
