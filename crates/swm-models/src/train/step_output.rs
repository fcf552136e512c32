//! [`StepOutput`]: the loss, the gradients and the buffers of a batch, and their weighted sums over several batches.

use crate::nn::parameters::{self, Named};
use burn::tensor::Tensor;

/// The result of a training step on one batch.
#[derive(Default)]
pub struct StepOutput {
    /// Named values; the first is the total loss, `loss`.
    pub metrics: Vec<(&'static str, f64)>,
    /// Gradients by parameter name, flattened to one axis. A parameter without a gradient keeps its value.
    pub gradients: Named<Tensor<1>>,
    /// Tensors that [`Trainable::after_step`](super::Trainable::after_step) needs, such as batch statistics.
    pub buffers: Named<Tensor<1>>,
}

impl StepOutput {
    /// The total loss.
    pub fn loss(&self) -> f64 {
        self.metrics.first().map_or(f64::NAN, |&(_, loss)| loss)
    }

    /// Multiplies metrics, gradients and buffers by `factor`.
    #[must_use]
    pub(super) fn scaled(mut self, factor: f64) -> Self {
        self.metrics.iter_mut().for_each(|(_, value)| *value *= factor);
        for tensors in [&mut self.gradients, &mut self.buffers] {
            *tensors = std::mem::take(tensors).into_iter().map(|(name, tensor)| (name, tensor * factor)).collect();
        }
        self
    }

    /// Adds the metrics, gradients and buffers of `other`.
    pub(super) fn add(&mut self, other: Self) {
        if self.metrics.is_empty() {
            self.metrics = other.metrics;
        } else {
            for (sum, (_, value)) in self.metrics.iter_mut().zip(other.metrics) {
                sum.1 += value;
            }
        }
        parameters::add(&mut self.gradients, other.gradients);
        parameters::add(&mut self.buffers, other.buffers);
    }
}
