//! AdamW (Loshchilov and Hutter 2019, algorithm 2) with clipping of the global gradient norm, as PyTorch computes both.
//!
//! Burn's optimizer clips every tensor separately and keys its state by ids that change from run to run. This optimizer
//! clips the whole gradient and keys its state by parameter name, so that the state can be stored with the weights.

use crate::nn::parameters::{self, HostTensor, HostValues, IntoF32, Named, host};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use swm_core::{Error, Result};
use swm_kernels::{AdamWStep, sum_of_squares};

/// The settings of [`AdamW`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    /// The peak learning rate.
    pub lr: f64,
    /// The decay of the weights in a step, as a multiple of the learning rate.
    pub weight_decay: f64,
    /// The decay of the first moment (running gradient) and of the second moment (running squared gradient).
    pub betas: [f64; 2],
    /// The value added to the square root of the second moment.
    pub epsilon: f64,
    /// The largest gradient norm of a clipping group ([`ParameterGroup::clip`]); larger gradients are scaled down to
    /// this norm.
    pub clip: f64,
    /// The number of batches whose gradients are averaged for one step.
    #[serde(default = "one")]
    pub accumulate: usize,
    /// The decay of the exponential moving average of the weights, such as 0.999; 0 for no average. The checkpoint
    /// stores the averaged weights.
    #[serde(default)]
    pub ema: f64,
}

fn one() -> usize {
    1
}

impl OptimConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// When one is out of range; the error names the setting.
    pub(crate) fn check(&self) -> Result<()> {
        let positive = [("optim.lr", self.lr), ("optim.epsilon", self.epsilon), ("optim.clip", self.clip)];
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::config(name, value.to_string(), "give a positive number"));
            }
        }
        if !(self.weight_decay.is_finite() && self.weight_decay >= 0.0) {
            return Err(Error::config(
                "optim.weight_decay",
                self.weight_decay.to_string(),
                "give a number of at least 0",
            ));
        }
        if let Some(beta) = self.betas.into_iter().find(|beta| !(0.0..1.0).contains(beta)) {
            return Err(Error::config("optim.betas", beta.to_string(), "give two decays of at least 0 and below 1"));
        }
        if !(0.0..1.0).contains(&self.ema) {
            let fix = "give a decay of at least 0 (no average) and below 1";
            return Err(Error::config("optim.ema", self.ema.to_string(), fix));
        }
        Ok(())
    }
}

/// The clipping group and the learning rate of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterGroup {
    /// The index of the clipping group. The parameters of a group have one common gradient norm.
    pub clip: usize,
    /// A factor of the learning rate.
    pub lr: f64,
}

impl Default for ParameterGroup {
    fn default() -> Self {
        Self { clip: 0, lr: 1.0 }
    }
}

/// First and second moment of a parameter's gradient, flattened to one axis.
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
    /// Creates an optimizer before its first step.
    pub fn new(config: OptimConfig) -> Self {
        Self { config, steps: 0, moments: Named::new() }
    }

    /// The moments by name: `first.NAME` and `second.NAME`, flattened to one axis.
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

    /// Restores a state that was taken after `steps` steps.
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

    /// Makes one step at `lr_factor` times the peak learning rate. Returns the module and the gradient norm before
    /// clipping. `group` maps a parameter name to the group of the parameter.
    ///
    /// # Shapes
    /// `gradients` are flattened to one axis, by parameter name.
    pub fn step<M: Module>(
        &mut self,
        module: M,
        lr_factor: f64,
        mut gradients: Named<Tensor<1>>,
        group: fn(&str) -> ParameterGroup,
    ) -> (M, f64) {
        let (squared_norms, norm) = squared_norms(&gradients, group);
        self.steps += 1;
        let [beta1, beta2] = self.config.betas;
        let bias1 = 1.0 - beta1.powi(self.steps as i32);
        let root_bias2 = (1.0 - beta2.powi(self.steps as i32)).sqrt();
        let mut updates = vec![];
        // Collects the tensors without copying them.
        let module = parameters::map(module, |name, value| {
            let Some(gradient) = gradients.remove(name) else { return value };
            let group = group(name);
            let lr = self.config.lr * lr_factor * group.lr;
            // PyTorch adds 1e-6 to the norm, so that the divisor of a zero gradient is not 0.
            let scale = self.config.clip / (squared_norms[&group.clip].sqrt() + 1e-6);
            let step = AdamWStep {
                gradient: scale.min(1.0) as f32,
                betas: [beta1 as f32, beta2 as f32],
                weights: [(1.0 - beta1) as f32, (1.0 - beta2) as f32],
                root_bias: root_bias2 as f32,
                epsilon: self.config.epsilon as f32,
                keep: (1.0 - lr * self.config.weight_decay) as f32,
                rate: (lr / bias1) as f32,
            };
            let zeros = || Tensor::zeros_like(&gradient);
            let old = self.moments.remove(name).unwrap_or_else(|| Moments { first: zeros(), second: zeros() });
            updates.push((name.to_owned(), step, value.clone(), gradient, old));
            value
        });
        let on_host = updates.first().is_none_or(|(_, _, value, ..)| value.device() == Device::flex());
        // The threads meet once, not once for each parameter.
        let updated: Vec<_> = if on_host {
            let host = |(name, step, value, gradient, old)| (name, host_step(&step, value, gradient, old));
            updates.into_par_iter().map(host).collect()
        } else {
            let device = |(name, step, value, gradient, old)| (name, device_step(&step, value, gradient, old));
            updates.into_iter().map(device).collect()
        };
        let mut values = Named::new();
        for (name, (value, new)) in updated {
            self.moments.insert(name.clone(), new);
            values.insert(name, value);
        }
        (parameters::map(module, |name, old| values.remove(name).unwrap_or(old)), norm)
    }
}

/// Makes the step of one parameter with the CPU kernel, in one pass.
fn host_step(step: &AdamWStep, value: Tensor<1>, gradient: Tensor<1>, old: Moments) -> (Tensor<1>, Moments) {
    let device = value.device();
    let (mut value, mut first, mut second) = (host(value), host(old.first), host(old.second));
    step.apply(&mut value, &host(gradient), &mut first, &mut second);
    let tensor = |values: Vec<f32>| {
        let shape = [values.len()];
        Tensor::from_data(TensorData::new(values, shape), &device)
    };
    (tensor(value), Moments { first: tensor(first), second: tensor(second) })
}

/// Makes the step of one parameter with tensors, on any device.
fn device_step(step: &AdamWStep, value: Tensor<1>, gradient: Tensor<1>, old: Moments) -> (Tensor<1>, Moments) {
    let gradient = gradient * step.gradient;
    let first = old.first * step.betas[0] + gradient.clone() * step.weights[0];
    let second = old.second * step.betas[1] + gradient.square() * step.weights[1];
    let update = first.clone() / (second.clone().sqrt() / step.root_bias + step.epsilon);
    (value * step.keep - update * step.rate, Moments { first, second })
}

/// The squared gradient norm of every clipping group, and the norm of the whole gradient. Sums run in the order of
/// names.
fn squared_norms(gradients: &Named<Tensor<1>>, group: fn(&str) -> ParameterGroup) -> (BTreeMap<usize, f64>, f64) {
    let on_host = gradients.values().next().is_none_or(|gradient| gradient.device() == Device::flex());
    let sums = if on_host {
        let gradients: Vec<&Tensor<1>> = gradients.values().collect();
        gradients.into_par_iter().map(|gradient| sum_of_squares(&HostValues::of(gradient))).collect()
    } else {
        device_sums_of_squares(gradients)
    };
    let mut squares: BTreeMap<usize, f64> = BTreeMap::new();
    for (name, square) in gradients.keys().zip(sums) {
        *squares.entry(group(name).clip).or_default() += square;
    }
    let norm = squares.values().sum::<f64>().sqrt();
    (squares, norm)
}

/// The sum of squares of every tensor. They are read together: reading one waits for all that a device was asked to do.
fn device_sums_of_squares(gradients: &Named<Tensor<1>>) -> Vec<f64> {
    let sums = gradients.values().map(|gradient| gradient.clone().square().sum()).collect();
    Tensor::cat(sums, 0).into_data().into_f32_vec().into_iter().map(f64::from).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_sums_the_squares_of_every_gradient() {
        let tensor = |values: &[f32]| Tensor::<1>::from_floats(values, &Device::flex());
        let gradients = Named::from([("b".to_owned(), tensor(&[3.0, 4.0])), ("a".to_owned(), tensor(&[2.0]))]);
        assert_eq!(device_sums_of_squares(&gradients), [4.0, 25.0]);
        let (squares, norm) = squared_norms(&gradients, |name| ParameterGroup { clip: name.len(), lr: 1.0 });
        assert_eq!((squares, norm), (BTreeMap::from([(1, 29.0)]), 29f64.sqrt()));
    }
}
