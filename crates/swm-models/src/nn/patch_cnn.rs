//! [`PatchCnn`]: a small convolutional encoder whose kernels equal their strides, so that every layer is one matrix
//! product, which is the fastest kind of convolution on a CPU.

use super::vit::Projection;
use super::{Activation, Init, Linear};
use burn::module::Module;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The size of a [`PatchCnn`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PatchCnnConfig {
    /// The convolutions, first to last.
    pub stages: Vec<Stage>,
    /// The number of hidden features after the last convolution.
    pub hidden: usize,
    /// The number of output features.
    pub dim: usize,
    /// The activation function between layers.
    pub activation: Activation,
}

/// One convolution of a [`PatchCnn`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Kernel size and stride, in pixels of the input of the convolution.
    pub patch: usize,
    /// The number of output channels.
    pub channels: usize,
}

/// Convolutions over disjoint patches, then two linear layers.
#[derive(Module, Debug)]
pub struct PatchCnn {
    /// The first convolution.
    pub stem: Projection,
    /// The later convolutions.
    pub stages: Vec<Linear>,
    /// The layer to the hidden features.
    pub hidden: Linear,
    /// The output layer.
    pub out: Linear,
    #[module(skip)]
    config: PatchCnnConfig,
}

impl PatchCnnConfig {
    /// The side of the feature map after the last convolution, for images with a side of `image` pixels.
    fn side(&self, image: usize) -> usize {
        self.stages.iter().fold(image, |side, stage| side / stage.patch)
    }

    /// Creates an encoder for images with a side of `image` pixels. Weights have the variance of He et al. 2015.
    pub fn init(&self, init: &Init, image: usize) -> PatchCnn {
        let first = self.stages[0];
        let stages = self.stages.windows(2).enumerate().map(|(index, pair)| {
            let inputs = pair[1].patch.pow(2) * pair[0].channels;
            Linear::normal(&init.of("stage").at(index), inputs, pair[1].channels, (2.0 / inputs as f32).sqrt())
        });
        let features = self.side(image).pow(2) * self.stages[self.stages.len() - 1].channels;
        let std = (2.0 / (3 * first.patch.pow(2)) as f32).sqrt();
        PatchCnn {
            stem: Projection::new(&init.of("stem"), 3, first.patch, first.channels, std),
            stages: stages.collect(),
            hidden: Linear::normal(&init.of("hidden"), features, self.hidden, (2.0 / features as f32).sqrt()),
            out: Linear::new(&init.of("out"), self.hidden, self.dim),
            config: self.clone(),
        }
    }
}

impl PatchCnn {
    /// Computes the features of images.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]`, patches in row-major order of the image, to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        let [frames, count, width] = patches.dims();
        let activation = self.config.activation;
        let mut side = count.isqrt();
        let mut x = activation.forward(self.stem.forward(patches.reshape([frames * count, width])));
        for (layer, stage) in self.stages.iter().zip(&self.config.stages[1..]) {
            let ([_, channels], patch) = (x.dims(), stage.patch);
            side /= patch;
            let blocks = x.reshape([frames * side, patch, side, patch * channels]).swap_dims(1, 2);
            x = activation.forward(layer.forward(blocks.reshape([frames * side * side, patch * patch * channels])));
        }
        let [rows, channels] = x.dims();
        let x = x.reshape([frames, rows / frames * channels]);
        self.out.forward(activation.forward(self.hidden.forward(x)))
    }
}
