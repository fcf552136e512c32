//! Fitting a small network: AdamW, warm-up and cosine, batches drawn by key.

use crate::train::{AdamW, OptimConfig, ParameterGroup, ScheduleConfig, StepOutput};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};

/// How a network is fitted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitConfig {
    /// Steps of the optimizer.
    pub steps: usize,
    /// Frames in a batch, drawn with repetition.
    pub batch_size: usize,
    /// The largest learning rate.
    pub lr: f64,
}

/// Fits `model`: `step` gives loss and gradients for the samples at some places. Returns it and its last loss.
pub(super) fn fit<M: Module>(
    mut model: M,
    config: FitConfig,
    samples: usize,
    key: Key,
    step: impl Fn(&M, &[usize]) -> Result<StepOutput>,
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
    for number in 0..config.steps {
        let mut rng = key.at(number as u64).rng();
        let places: Vec<usize> = (0..config.batch_size).map(|_| rng.random_range(0..samples)).collect();
        let output = step(&model, &places)?;
        loss = output.loss();
        if !loss.is_finite() {
            return Err(Error::NotFinite {
                what: format!("the loss of a probe at step {}", number + 1),
                given: loss.to_string(),
                fix: "lower its learning rate, or check the checkpoint and the dataset".to_owned(),
            });
        }
        (model, _) = optimizer.step(model, schedule.lr_factor(number), output.gradients, |_| ParameterGroup::default());
    }
    Ok((model, loss))
}

/// Some rows of a table, `[rows, width]`, as a tensor.
pub(super) fn rows(table: &[f32], width: usize, places: &[usize]) -> Tensor<2> {
    let numbers: Vec<f32> =
        places.iter().flat_map(|&place| &table[place * width..(place + 1) * width]).copied().collect();
    Tensor::from_data(TensorData::new(numbers, [places.len(), width]), &Device::flex())
}
