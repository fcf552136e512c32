//! Convolutional image encoders: 3 x 3 convolutions with stride 2, each followed by batch normalisation and ReLU, then
//! linear layers of the whole feature map.
//!
//! [`ConvEncoder`] encodes images with the running statistics of the normalisations; [`ConvGradient`] computes the
//! features and the gradients of a training batch with the statistics of the batch.

mod encoder;
mod geometry;
mod gradient;
mod layer;
mod maps;

pub use encoder::ConvEncoder;
pub use gradient::ConvGradient;

use crate::Affine;
use crate::panels::LANES;
use geometry::Geometry;
use layer::Layer;

/// The value that the normalisations add to the variance.
const EPSILON: f64 = 1e-5;
/// The number of channels of an image.
const COLOURS: usize = 3;

/// The sizes of a convolutional encoder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConvSizes {
    /// The side of the square images, in pixels.
    pub side: usize,
    /// The output channels of each convolution; at least one.
    pub channels: Vec<usize>,
    /// The hidden features after the last convolution; 0 for none.
    pub hidden: usize,
    /// The output features; 0, together with `hidden`, for an encoder without linear layers, whose features are the cells
    /// of the feature map.
    pub dim: usize,
}

impl ConvSizes {
    /// The side of the feature map after the last convolution.
    pub fn map(&self) -> usize {
        self.channels.iter().fold(self.side, |side, _| side.div_ceil(2))
    }

    /// The channels of a pixel of the last layer: the output features, or the channels of a cell.
    fn outputs(&self) -> usize {
        if self.dim > 0 { self.dim } else { self.channels.last().copied().unwrap_or(0) }
    }

    /// Returns the layers, first to last, for blocks of at most `images` images.
    fn layers(&self, images: usize) -> Vec<Layer> {
        let width = |channels: usize| channels.next_multiple_of(LANES);
        let (mut layers, mut side, mut inputs) = (vec![], self.side, [COLOURS, COLOURS]);
        for &channels in &self.channels {
            let outputs = [channels, width(channels)];
            let geometry = Geometry::convolution(side, inputs[1], outputs[1]);
            side = geometry.out;
            layers.push(Layer::new(geometry, [inputs[0], channels], images));
            inputs = outputs;
        }
        for features in [self.hidden, self.dim].into_iter().filter(|features| *features > 0) {
            let outputs = [features, width(features)];
            let geometry = Geometry::linear(side, inputs[1], outputs[1]);
            side = geometry.out;
            layers.push(Layer::new(geometry, [inputs[0], features], images));
            inputs = outputs;
        }
        layers
    }
}

/// The parameters of a convolutional encoder, or their gradients.
#[derive(Clone, Debug, PartialEq)]
pub struct ConvParameters {
    /// The convolutions, first to last.
    pub stages: Vec<ConvStage>,
    /// The linear layers, first to last: the hidden layer, if any, and the output layer. The first is
    /// `[features, channels * map * map]`, in the order of a flattened `[channels, map, map]`.
    pub linear: Vec<Affine>,
}

/// The parameters of a convolution and of its normalisation, or their gradients.
#[derive(Clone, Debug, PartialEq)]
pub struct ConvStage {
    /// The weights, `[outputs, inputs, 3, 3]`.
    pub weight: Vec<f32>,
    /// Scale and shift of the normalisation, `[outputs]`.
    pub norm: Affine,
}

/// Mean and variance of every channel, `[channels]` each.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelStatistics {
    /// The means.
    pub mean: Vec<f32>,
    /// The unbiased variances.
    pub variance: Vec<f32>,
}
