//! [`CellPass`]: forward and backward pass of a convolutional encoder on the CPU kernels, for heads that read the cells of its
//! feature map.

use crate::nn::kernels::{batch_statistics, conv_parameters, named_conv_gradients};
use crate::nn::parameters::{self, Named, host};
use crate::nn::{Backbone, BatchStatistics, Conv};
use burn::tensor::{Device, Gradients, Tensor, TensorData};
use swm_kernels::ConvGradient;

/// The cells of a batch of images and the state that the backward pass reads.
pub(super) struct CellPass<'a> {
    conv: &'a Conv,
    pixels: Vec<f32>,
    network: Box<ConvGradient>,
    /// The cells, `[images, cells, channels]`: a leaf of the autodiff graph.
    pub cells: Tensor<3>,
}

impl<'a> CellPass<'a> {
    /// Encodes images with the statistics of the batch, which are returned; `None` if the kernels do not compute this encoder
    /// on this device.
    ///
    /// # Shapes
    /// `images` is `[images, side * side, 3]`, outside the autodiff graph.
    pub fn forward(encoder: &'a Backbone, images: &Tensor<3>) -> Option<(Self, Vec<BatchStatistics>)> {
        let Backbone::Conv(conv) = encoder else { return None };
        let ([count, pixels, _], device) = (images.dims(), images.device());
        if device != Device::flex() {
            return None;
        }
        let side = pixels.isqrt();
        let (pixels, mut network) = (host(images.clone()), conv.cell_kernels(side));
        network.load(&conv_parameters(conv));
        let cells = network.forward(&pixels);
        let channels = cells.len() / (count * network.sizes().map().pow(2));
        let shape = [count, network.sizes().map().pow(2), channels];
        let cells = Tensor::from_data(TensorData::new(cells, shape), &device).autodiff().require_grad();
        let statistics = batch_statistics(network.statistics(), &device);
        Some((Self { conv, pixels, network, cells }, statistics))
    }

    /// Returns the flattened gradients of the encoder's parameters, by parameter name; removes the gradient of the cells.
    pub fn backward(mut self, all: &mut Gradients) -> Named<Tensor<1>> {
        let Some(gradient) = self.cells.grad_remove(all) else { return Named::new() };
        let device = gradient.device();
        let gradients = named_conv_gradients(self.network.backward(&self.pixels, &host(gradient)));
        self.conv.return_kernels(self.network);
        let tensor = |values: Vec<f32>| {
            let shape = [values.len()];
            Tensor::from_data(TensorData::new(values, shape), &device)
        };
        let named = gradients.into_iter().map(|(name, values)| (name, tensor(values))).collect();
        parameters::prefixed(super::step::ENCODER, named)
    }
}
