//! [`Shard`]: forward and backward pass of the encoder for a range of the images of a batch.
//!
//! On the CPU, the kernels of `swm-kernels` differentiate vision transformers and convolutional encoders; Burn
//! differentiates all other encoders.

use super::model::Encoder;
use crate::nn::kernels::{batch_statistics, conv_parameters, named_conv_gradients, named_vit_gradients, vit_gradient};
use crate::nn::parameters::{self, HostValues, Named};
use crate::nn::{BatchStatistics, Conv};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use swm_kernels::{ConvGradient, Tape, VitGradient};

/// The implementation of the encoder's gradient.
pub(crate) enum Differentiation<'a> {
    /// Burn's autodiff. Every shard has its own copy of the encoder, so that the autodiff graphs of
    /// the shards are independent.
    Burn(&'a Encoder),
    /// The CPU kernels of a vision transformer.
    Vit(Box<VitGradient>),
    /// The CPU kernels of a convolutional encoder.
    Conv(&'a Conv),
}

impl<'a> Differentiation<'a> {
    /// Chooses the fastest implementation for a device.
    pub fn of(encoder: &'a Encoder, patches: usize, device: &Device) -> Self {
        let on_cpu = *device == Device::flex();
        match encoder {
            Encoder::Vit(vit) if on_cpu => {
                vit_gradient(vit, patches).map_or(Self::Burn(encoder), |kernels| Self::Vit(Box::new(kernels)))
            }
            Encoder::Conv(conv) if on_cpu => Self::Conv(conv),
            _ => Self::Burn(encoder),
        }
    }

    /// Whether all images must be in one shard: batch normalisation uses the statistics of the whole batch. The kernels
    /// of a convolutional encoder compute one shard on several threads.
    pub fn needs_whole_batch(&self) -> bool {
        match self {
            Self::Burn(encoder) => encoder.has_batch_statistics(),
            Self::Vit(_) => false,
            Self::Conv(_) => true,
        }
    }
}

/// Encoded images and the state that the backward pass reads.
pub(crate) struct Shard {
    /// The features of the images, `[images, features]`.
    pub features: Tensor<2>,
    /// The statistics of the encoder's batch normalisations.
    pub statistics: Vec<BatchStatistics>,
    state: BackwardState,
}

enum BackwardState {
    Burn(Box<(Encoder, Tensor<2>)>),
    Vit { patches: HostValues, tapes: Vec<Tape> },
    Conv { pixels: HostValues, network: Box<ConvGradient> },
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
                let (features, statistics) = encoder.forward_train(patches.autodiff());
                let state = BackwardState::Burn(Box::new((encoder, features.clone())));
                Self { features: features.inner(), statistics, state }
            }
            Differentiation::Vit(vit) => {
                let (patches, mut scratch) = (HostValues::of(&patches), vit.scratch());
                let (features, tapes): (Vec<_>, Vec<_>) =
                    patches.chunks_exact(count * width).map(|image| vit.forward(image, &mut scratch)).unzip();
                let features = TensorData::new(features.concat(), [images, vit.dim()]);
                let state = BackwardState::Vit { patches, tapes };
                Self { features: Tensor::from_data(features, &device), statistics: vec![], state }
            }
            Differentiation::Conv(conv) => {
                let (pixels, mut network) = (HostValues::of(&patches), conv.kernels(count.isqrt()));
                network.load(&conv_parameters(conv));
                let features = network.forward(&pixels);
                let features = TensorData::new(features, [images, network.dim()]);
                let statistics = batch_statistics(network.statistics(), &device);
                let state = BackwardState::Conv { pixels, network };
                Self { features: Tensor::from_data(features, &device), statistics, state }
            }
        }
    }

    /// Returns the flattened gradients of the encoder's parameters, by parameter name.
    ///
    /// # Shapes
    /// `gradient`, the gradient of the features, is `[images, features]`.
    pub fn backward(self, differentiation: &Differentiation<'_>, gradient: Tensor<2>) -> Named<Tensor<1>> {
        let device = gradient.device();
        let tensors = |named: Named<Vec<f32>>| -> Named<Tensor<1>> {
            let tensor = |values: Vec<f32>| {
                let shape = [values.len()];
                Tensor::from_data(TensorData::new(values, shape), &device)
            };
            named.into_iter().map(|(name, values)| (name, tensor(values))).collect()
        };
        match (self.state, differentiation) {
            (BackwardState::Vit { patches, tapes }, Differentiation::Vit(vit)) => {
                let (mut sums, mut scratch) = (vit.sums(), vit.scratch());
                let gradient = HostValues::of(&gradient);
                let images = patches.chunks_exact(patches.len() / tapes.len().max(1)).zip(&tapes);
                for ((image, tape), gradient) in images.zip(gradient.chunks_exact(vit.dim())) {
                    vit.backward(image, tape, gradient, &mut sums, &mut scratch);
                }
                tensors(named_vit_gradients(vit.gradients(sums)))
            }
            (BackwardState::Conv { pixels, mut network }, Differentiation::Conv(conv)) => {
                let gradients = network.backward(&pixels, &HostValues::of(&gradient));
                conv.return_kernels(network);
                tensors(named_conv_gradients(gradients))
            }
            (BackwardState::Burn(graph), _) => {
                let (encoder, features) = *graph;
                let all = (features * gradient.autodiff()).sum().backward();
                parameters::gradients(&encoder, &all)
            }
            (BackwardState::Vit { .. } | BackwardState::Conv { .. }, _) => Named::new(),
        }
    }
}
