//! [`ConvEncoder`]: a convolutional encoder for inference.

use super::layer::Layer;
use super::maps::Activation;
use super::{ChannelStatistics, ConvParameters, ConvSizes, EPSILON};
use crate::{ScratchPool, grown};

/// A convolutional encoder whose normalisations are folded into the convolutions.
pub struct ConvEncoder {
    layers: Vec<Layer>,
    dim: usize,
    scratch: ScratchPool<Vec<Buffers>>,
}

/// The padded input map and the output map of a layer.
#[derive(Default)]
struct Buffers {
    input: Vec<f32>,
    output: Vec<f32>,
}

impl ConvEncoder {
    /// Lays out the parameters of an encoder with the given running statistics, one for each convolution.
    pub fn new(sizes: &ConvSizes, parameters: &ConvParameters, statistics: &[ChannelStatistics]) -> Self {
        let mut layers = sizes.layers(1);
        let (stages, linear) = layers.split_at_mut(parameters.stages.len());
        for ((layer, stage), ChannelStatistics { mean, variance }) in
            stages.iter_mut().zip(&parameters.stages).zip(statistics)
        {
            let channels = stage.norm.weight.iter().zip(variance);
            let scale: Vec<f32> =
                channels.map(|(weight, variance)| weight / (f64::from(*variance) + EPSILON).sqrt() as f32).collect();
            let bias: Vec<f32> = (stage.norm.bias.iter().zip(mean).zip(&scale))
                .map(|((bias, mean), scale)| bias - mean * scale)
                .collect();
            let rows = stage.weight.chunks_exact(stage.weight.len() / scale.len()).zip(&scale);
            let weight: Vec<f32> = rows.flat_map(|(row, scale)| row.iter().map(move |weight| weight * scale)).collect();
            layer.load(&weight, &bias);
        }
        for (layer, affine) in linear.iter_mut().zip(&parameters.linear) {
            layer.load(&affine.weight, &affine.bias);
        }
        Self { layers, dim: sizes.dim, scratch: ScratchPool::default() }
    }

    /// Returns the features of one normalised image.
    ///
    /// # Shapes
    /// `image` is `[side, side, 3]`; returns `[dim]`.
    pub fn encode(&self, image: &[f32]) -> Vec<f32> {
        self.scratch.with(|buffers| {
            buffers.resize_with(self.layers.len(), Buffers::default);
            for (index, layer) in self.layers.iter().enumerate() {
                let (before, rest) = buffers.split_at_mut(index);
                let Buffers { input, output } = &mut rest[0];
                let padded = grown(input, layer.geometry.padded_input());
                match before.last() {
                    None => layer.geometry.pad(image, padded),
                    Some(previous) => {
                        Activation::relu(layer.geometry.inputs).apply(&previous.output, &layer.geometry, padded)
                    }
                }
                layer.forward(padded, grown(output, layer.geometry.output()));
            }
            buffers.last().map_or_else(Vec::new, |last| last.output[..self.dim].to_vec())
        })
    }
}
