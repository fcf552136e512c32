//! [`Shard`]: some pictures of a batch through the encoder and back.
//!
//! On the CPU a vision transformer is differentiated by hand ([`VitGradient`]); everything else by Burn.

use super::model::Encoder;
use crate::nn::kernels::{host, named_vit_gradients, vit_gradient};
use crate::nn::parameters::{self, Named};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use swm_kernels::{Tape, VitGradient};

/// How an encoder is differentiated.
pub(crate) enum Differentiation<'a> {
    /// By Burn; every shard differentiates its own copy: their graphs share nothing.
    Burn(&'a Encoder),
    /// By hand.
    Host(Box<VitGradient>),
}

impl<'a> Differentiation<'a> {
    /// The fastest way on a device.
    pub fn of(encoder: &'a Encoder, patches: usize, device: &Device) -> Self {
        let by_hand = match encoder {
            Encoder::Vit(vit) if *device == Device::flex() => vit_gradient(vit, patches),
            _ => None,
        };
        by_hand.map_or(Self::Burn(encoder), |by_hand| Self::Host(Box::new(by_hand)))
    }
}

/// Some pictures on their way.
pub(crate) struct Shard {
    /// `[pictures, features]`.
    pub features: Tensor<2>,
    way: Way,
}

enum Way {
    Burn(Box<(Encoder, Tensor<2>)>),
    Host { patches: Vec<f32>, tapes: Vec<Tape> },
}

impl Shard {
    /// ImageEncoder `[pictures, patches, numbers]`.
    pub fn forward(differentiation: &Differentiation<'_>, patches: Tensor<3>) -> Self {
        let ([pictures, count, width], device) = (patches.dims(), patches.device());
        match differentiation {
            Differentiation::Burn(encoder) => {
                let encoder = (*encoder).clone().train();
                let features = encoder.forward(patches.autodiff());
                Self { features: features.clone().inner(), way: Way::Burn(Box::new((encoder, features))) }
            }
            Differentiation::Host(vit) => {
                let (patches, mut scratch) = (host(patches), vit.scratch());
                let (features, tapes): (Vec<_>, Vec<_>) =
                    patches.chunks_exact(count * width).map(|picture| vit.forward(picture, &mut scratch)).unzip();
                let features = TensorData::new(features.concat(), [pictures, vit.dim()]);
                Self { features: Tensor::from_data(features, &device), way: Way::Host { patches, tapes } }
            }
        }
    }

    /// The gradients of the encoder's parameters, from that of the features.
    pub fn backward(self, differentiation: &Differentiation<'_>, gradient: Tensor<2>) -> Named<Tensor<1>> {
        let device = gradient.device();
        match (self.way, differentiation) {
            (Way::Host { patches, tapes }, Differentiation::Host(vit)) => {
                let (mut sums, mut scratch) = (vit.sums(), vit.scratch());
                let gradient = host(gradient);
                let pictures = patches.chunks_exact(patches.len() / tapes.len().max(1)).zip(&tapes);
                for ((picture, tape), gradient) in pictures.zip(gradient.chunks_exact(vit.dim())) {
                    vit.backward(picture, tape, gradient, &mut sums, &mut scratch);
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
            (Way::Burn(way), _) => {
                let (encoder, features) = *way;
                let all = (features * gradient.autodiff()).sum().backward();
                parameters::gradients(&encoder, &all)
            }
            (Way::Host { .. }, Differentiation::Burn(_)) => Named::new(),
        }
    }
}
