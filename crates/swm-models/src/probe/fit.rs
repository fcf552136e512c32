//! Training of the small networks of probes: AdamW, warm-up and cosine decay, batches drawn with a key.

use crate::nn::Named;
use crate::train::{AdamW, OptimConfig, ParameterGroup, ScheduleConfig, StepOutput};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::run::{Control, Progress};
use swm_core::{Error, Key, Result};

/// The settings of training a network.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitConfig {
    /// Optimizer steps.
    pub steps: usize,
    /// Frames of a batch, drawn with replacement.
    pub batch_size: usize,
    /// The peak learning rate.
    pub lr: f64,
}

/// Trains `model`; `step` computes loss and gradients of the samples with the given indices, and `track` updates the model
/// with the buffers of a step, such as running statistics. Returns the model and the last loss.
///
/// # Errors
/// When a step fails, a loss is not finite, or `control` stops the training.
pub(super) fn fit<M: Module>(
    mut model: M,
    config: FitConfig,
    samples: usize,
    key: Key,
    step: impl Fn(&M, &[usize]) -> Result<StepOutput>,
    track: impl Fn(&mut M, Named<Tensor<1>>),
    control: &mut Control<'_>,
) -> Result<(M, f64)> {
    let schedule = ScheduleConfig { steps: config.steps, warmup: config.steps / 20, floor: 0.0 };
    let optim = OptimConfig {
        lr: config.lr,
        weight_decay: 1e-4,
        betas: [0.9, 0.999],
        epsilon: 1e-8,
        clip: 1.0,
        accumulate: 1,
        ema: 0.0,
    };
    let mut optimizer = AdamW::new(optim);
    let mut loss = f64::NAN;
    for step_index in 0..config.steps {
        control.check()?;
        let mut rng = key.at(step_index as u64).rng();
        let indices: Vec<usize> = (0..config.batch_size).map(|_| rng.random_range(0..samples)).collect();
        let output = step(&model, &indices)?;
        loss = output.loss();
        if !loss.is_finite() {
            return Err(Error::NotFinite {
                what: format!("the loss of a probe at step {}", step_index + 1),
                given: loss.to_string(),
                fix: "lower the probe's learning rate, or check the checkpoint and the dataset".to_owned(),
            });
        }
        (model, _) =
            optimizer.step(model, schedule.lr_factor(step_index), output.gradients, |_| ParameterGroup::default());
        track(&mut model, output.buffers);
        let (stage, total, unit) = ("train", config.steps, "steps");
        control.progress(Progress { stage, done: step_index + 1, total, unit, metrics: &[("loss", loss)] });
    }
    Ok((model, loss))
}

/// Gathers rows of a table as a tensor.
///
/// # Shapes
/// Maps `[rows, width]` to `[indices, width]`.
pub(super) fn rows(table: &[f32], width: usize, indices: &[usize]) -> Tensor<2> {
    let values: Vec<f32> =
        indices.iter().flat_map(|&index| &table[index * width..(index + 1) * width]).copied().collect();
    Tensor::from_data(TensorData::new(values, [indices.len(), width]), &Device::flex())
}
