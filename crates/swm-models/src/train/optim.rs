//! AdamW (Loshchilov and Hutter 2019) with clipping of the global gradient norm, as PyTorch computes both.
//!
//! Burn's own optimizer clips every tensor by itself and keys its state by ids that change from run to run; this
//! one clips the whole gradient and keys its state by parameter name, so that it can be stored beside the
//! weights.

use super::trainable::ParameterGroup;
use crate::nn::parameters::{self, HostTensor, IntoF32, Named};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The optimizer's settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    /// The largest learning rate.
    pub lr: f64,
    /// Decay of the weights per step, times the learning rate.
    pub weight_decay: f64,
    /// Decay of the running gradient and of its running square.
    pub betas: [f64; 2],
    /// Added to the root of the running square.
    pub epsilon: f64,
    /// The largest gradient norm (of all parameters, or of each of the model's groups); larger gradients are scaled down to it.
    pub clip: f64,
    /// Batches whose gradients are averaged for one step.
    #[serde(default = "one")]
    pub accumulate: usize,
    /// The weights that are used in the end are a running average of those trained: the share of the average that a step
    /// keeps, such as 0.999; 0 for none.
    #[serde(default)]
    pub ema: f64,
}

fn one() -> usize {
    1
}

/// The running gradient and its running square, flat.
#[derive(Clone, Debug)]
struct Moments {
    first: Tensor<1>,
    second: Tensor<1>,
}

/// AdamW and its state.
pub struct AdamW {
    config: OptimConfig,
    steps: usize,
    moments: Named<Moments>,
}

impl AdamW {
    /// An optimizer that has made no step.
    pub fn new(config: OptimConfig) -> Self {
        Self { config, steps: 0, moments: Named::new() }
    }

    /// The state: `first.NAME` and `second.NAME`.
    pub fn state(&self) -> Named<HostTensor> {
        let host = |tensor: &Tensor<1>| {
            let values = tensor.to_data().into_f32_vec();
            HostTensor { shape: vec![values.len()], values }
        };
        let both = |(name, moments): (&String, &Moments)| {
            [(format!("first.{name}"), host(&moments.first)), (format!("second.{name}"), host(&moments.second))]
        };
        self.moments.iter().flat_map(both).collect()
    }

    /// Puts a state back that was taken after `steps` steps.
    pub fn restore(&mut self, steps: usize, state: Named<HostTensor>, device: &Device) {
        let tensor =
            |host: &HostTensor| Tensor::from_data(TensorData::new(host.values.clone(), [host.values.len()]), device);
        self.steps = steps;
        self.moments = state
            .iter()
            .filter_map(|(name, first)| {
                let name = name.strip_prefix("first.")?;
                let second = state.get(&format!("second.{name}"))?;
                Some((name.to_owned(), Moments { first: tensor(first), second: tensor(second) }))
            })
            .collect();
    }

    /// One step at a share of the largest learning rate; returns the module and the gradient's norm before clipping.
    /// `group` says how a parameter is treated.
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
    pub fn step<M: Module>(
        &mut self,
        module: M,
        share: f64,
        mut gradients: Named<Tensor<1>>,
        group: fn(&str) -> ParameterGroup,
    ) -> (M, f64) {
        // The square of each group's norm, in the order of names.
        let mut squares: BTreeMap<usize, f64> = BTreeMap::new();
        for (name, gradient) in &gradients {
            let square = f64::from(gradient.clone().square().sum().into_scalar::<f32>());
            *squares.entry(group(name).clip).or_default() += square;
        }
        let norm = squares.values().sum::<f64>().sqrt();
        self.steps += 1;
        let [beta1, beta2] = self.config.betas;
        let rest = 1.0 - beta1.powi(self.steps as i32);
        let root = (1.0 - beta2.powi(self.steps as i32)).sqrt();
        let moments = &mut self.moments;
        let config = &self.config;
        let module = parameters::map(module, |name, value| {
            let Some(gradient) = gradients.remove(name) else { return value };
            let group = group(name);
            let lr = config.lr * share * group.lr;
            // A little more than the norm, as PyTorch does, so that 0 divides nothing.
            let scale = config.clip / (squares[&group.clip].sqrt() + 1e-6);
            let gradient = if scale < 1.0 { gradient * scale } else { gradient };
            let (first, second) = match moments.remove(name) {
                Some(Moments { first, second }) => (
                    first * beta1 + gradient.clone() * (1.0 - beta1),
                    second * beta2 + gradient.square() * (1.0 - beta2),
                ),
                None => (gradient.clone() * (1.0 - beta1), gradient.square() * (1.0 - beta2)),
            };
            let update = first.clone() / (second.clone().sqrt() / root + config.epsilon);
            moments.insert(name.to_owned(), Moments { first, second });
            value * (1.0 - lr * config.weight_decay) - update * (lr / rest)
        });
        (module, norm)
    }
}
