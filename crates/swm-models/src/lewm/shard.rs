//! [`Shard`]: forward and backward pass of the encoder for a range of the images of a batch.
//!
//! On the CPU, [`VitGradient`] differentiates vision transformers; Burn differentiates all other encoders.

use super::model::Encoder;
use crate::nn::kernels::{named_vit_gradients, vit_gradient};
use crate::nn::parameters::host;
use crate::nn::parameters::{self, Named};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use swm_kernels::{Tape, VitGradient};

/// The implementation of the encoder's gradient.
pub(crate) enum Differentiation<'a> {
    /// Burn's autodiff. Every shard has its own copy of the encoder, so that the autodiff graphs of
    /// the shards are independent.
    Burn(&'a Encoder),
    /// The CPU kernels.
    Host(Box<VitGradient>),
}

impl<'a> Differentiation<'a> {
    /// Chooses the fastest implementation for a device.
    pub fn of(encoder: &'a Encoder, patches: usize, device: &Device) -> Self {
        let kernels = match encoder {
            Encoder::Vit(vit) if *device == Device::flex() => vit_gradient(vit, patches),
            _ => None,
        };
        kernels.map_or(Self::Burn(encoder), |kernels| Self::Host(Box::new(kernels)))
    }
}

/// Encoded images and the state that the backward pass reads.
pub(crate) struct Shard {
    /// The features of the images, `[images, features]`.
    pub features: Tensor<2>,
    state: BackwardState,
}

enum BackwardState {
    Burn(Box<(Encoder, Tensor<2>)>),
    Host { patches: Vec<f32>, tapes: Vec<Tape> },
}

impl Shard {
    /// Encodes images.
    ///
    /// # Shapes
    /// `patches` is `[images, patches, 3 * patch * patch]`.
    pub fn forward(differentiation: &Differentiation<'_>, patches: Tensor<3>) -> Self {
        let ([images, count, width], device) = (patches.dims(), patches.device());
        match differentiation {
            Differentiation::Burn(encoder) => {
                let encoder = (*encoder).clone().train();
                let features = encoder.forward(patches.autodiff());
                Self { features: features.clone().inner(), state: BackwardState::Burn(Box::new((encoder, features))) }
            }
            Differentiation::Host(vit) => {
                let (patches, mut scratch) = (host(patches), vit.scratch());
                let (features, tapes): (Vec<_>, Vec<_>) =
                    patches.chunks_exact(count * width).map(|image| vit.forward(image, &mut scratch)).unzip();
                let features = TensorData::new(features.concat(), [images, vit.dim()]);
                Self { features: Tensor::from_data(features, &device), state: BackwardState::Host { patches, tapes } }
            }
        }
    }

    /// Returns the flattened gradients of the encoder's parameters, by parameter name.
    ///
    /// # Shapes
    /// `gradient`, the gradient of the features, is `[images, features]`.
    pub fn backward(self, differentiation: &Differentiation<'_>, gradient: Tensor<2>) -> Named<Tensor<1>> {
        let device = gradient.device();
        match (self.state, differentiation) {
            (BackwardState::Host { patches, tapes }, Differentiation::Host(vit)) => {
                let (mut sums, mut scratch) = (vit.sums(), vit.scratch());
                let gradient = host(gradient);
                let images = patches.chunks_exact(patches.len() / tapes.len().max(1)).zip(&tapes);
                for ((image, tape), gradient) in images.zip(gradient.chunks_exact(vit.dim())) {
                    vit.backward(image, tape, gradient, &mut sums, &mut scratch);
                }
                let tensor = |values: Vec<f32>| {
                    let shape = [values.len()];
                    Tensor::from_data(TensorData::new(values, shape), &device)
                };
                named_vit_gradients(vit.gradients(sums))
                    .into_iter()
                    .map(|(name, values)| (name, tensor(values)))
                    .collect()
            }
            (BackwardState::Burn(graph), _) => {
                let (encoder, features) = *graph;
                let all = (features * gradient.autodiff()).sum().backward();
                parameters::gradients(&encoder, &all)
            }
            (BackwardState::Host { .. }, Differentiation::Burn(_)) => Named::new(),
        }
    }
}
