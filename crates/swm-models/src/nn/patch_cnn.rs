//! A small convolutional encoder whose kernels equal their strides, so that every layer is one matrix product:
//! the fastest kind of convolution on a CPU.

use super::vit::Projection;
use super::{Activation, Init, Linear};
use burn::module::Module;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The size of a [`PatchCnn`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PatchCnnConfig {
    /// The convolutions, from pixels up.
    pub stages: Vec<Stage>,
    /// Hidden features after the last convolution.
    pub hidden: usize,
    /// Features it returns.
    pub dim: usize,
    /// The nonlinearity between layers.
    pub activation: Activation,
}

/// One convolution of a [`PatchCnn`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Kernel and stride.
    pub patch: usize,
    /// Output channels.
    pub channels: usize,
}

/// Convolutions of disjoint patches, then two linear layers.
#[derive(Module, Debug)]
pub struct PatchCnn {
    /// From pixels.
    pub stem: Projection,
    /// The later convolutions.
    pub stages: Vec<Linear>,
    /// Into the hidden features.
    pub hidden: Linear,
    /// Out of them.
    pub out: Linear,
    #[module(skip)]
    config: PatchCnnConfig,
}

impl PatchCnnConfig {
    /// Side of the feature map after the last convolution, for pictures of `image` pixels.
    fn side(&self, image: usize) -> usize {
        self.stages.iter().fold(image, |side, stage| side / stage.patch)
    }

    /// An encoder for square pictures of `image` pixels.
    #[allow(clippy::cast_precision_loss)]
    pub fn init(&self, init: &Init, image: usize) -> PatchCnn {
        let first = self.stages[0];
        let stages = self.stages.windows(2).enumerate().map(|(index, pair)| {
            let inputs = pair[1].patch.pow(2) * pair[0].channels;
            Linear::normal(&init.of("stage").at(index), inputs, pair[1].channels, (2.0 / inputs as f32).sqrt())
        });
        let features = self.side(image).pow(2) * self.stages[self.stages.len() - 1].channels;
        let spread = (2.0 / (3 * first.patch.pow(2)) as f32).sqrt();
        PatchCnn {
            stem: Projection::new(&init.of("stem"), 3, first.patch, first.channels, spread),
            stages: stages.collect(),
            hidden: Linear::normal(&init.of("hidden"), features, self.hidden, (2.0 / features as f32).sqrt()),
            out: Linear::new(&init.of("out"), self.hidden, self.dim),
            config: self.clone(),
        }
    }
}

impl PatchCnn {
    /// # Shapes
    /// `[frames, patches, 3 * patch * patch]`, patches in rows, to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        let [frames, count, numbers] = patches.dims();
        let activation = self.config.activation;
        let mut side = count.isqrt();
        let mut x = activation.forward(self.stem.forward(patches.reshape([frames * count, numbers])));
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
