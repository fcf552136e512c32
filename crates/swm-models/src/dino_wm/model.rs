//! [`DinoWm`]: the network of a DINO-WM, with a frozen encoder of patches, encoders of dataset columns, a predictor and
//! an image decoder.

use super::config::{ACTION, DinoWmConfig};
use super::predictor::FramePredictor;
use crate::nn::mlp::PointwiseConv;
use crate::nn::{Activation, Backbone, DropoutRng, Init, Linear, ModuleDict};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use std::ops::Range;
use swm_core::columns::PIXELS;

/// The network of a DINO-WM, which predicts the patch features of the next frame from the patch features of earlier
/// frames and the actions between the frames.
#[derive(Module, Debug)]
pub struct DinoWm {
    /// Maps images to features of patches; frozen.
    pub backbone: Backbone,
    /// Maps the features of a window of frames to the features of the next frame.
    pub predictor: FramePredictor,
    /// Maps columns to the features that are appended to every patch.
    pub extra_encoders: ModuleDict<ColumnEncoder>,
    /// Maps the features of a patch to the pixels of the patch.
    pub decoder: Option<PatchDecoder>,
}

/// The encoder of a dataset column: a convolution over time with kernel size 1, which is a linear layer.
#[derive(Module, Debug)]
pub struct ColumnEncoder {
    /// The convolution, with a weight of `[dim, elements, 1]`.
    pub patch_embed: PointwiseConv,
}

/// The image decoder, from the features of a patch to the pixels of the patch: linear, GELU, and a transposed
/// convolution, which is one matrix product, because the stride equals the kernel size.
#[derive(Module, Debug)]
pub struct PatchDecoder {
    /// The layer to the hidden features.
    pub hidden: Linear,
    /// The layer from the hidden features.
    pub pixels: Linear,
}

impl ColumnEncoder {
    fn new(init: &Init, elements: usize, dim: usize) -> Self {
        let bound = 1.0 / (elements as f32).sqrt();
        let weight = init.uniform("weight", [dim, elements, 1], bound);
        Self { patch_embed: PointwiseConv { weight, bias: init.uniform("bias", [dim], bound) } }
    }

    /// Encodes a column.
    ///
    /// # Shapes
    /// `x` is `[clips, frames, elements]`; returns `[clips, frames, dim]`.
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let [clips, frames, elements] = x.dims();
        let weight: Tensor<2> = self.patch_embed.weight.val().squeeze_dim(2);
        let [dim, _] = weight.dims();
        let y = x.reshape([clips * frames, elements]).matmul(weight.transpose());
        (y + self.patch_embed.bias.val().unsqueeze()).reshape([clips, frames, dim])
    }
}

impl PatchDecoder {
    /// Decodes the normalised pixels of patches.
    ///
    /// # Shapes
    /// `features` is `[frames, patches, dim]`; returns `[frames, patches, 3 * patch * patch]`.
    pub fn forward(&self, features: Tensor<3>) -> Tensor<3> {
        self.pixels.forward(Activation::Gelu.forward(self.hidden.forward(features)))
    }
}

impl DinoWm {
    /// Returns the device of the weights.
    pub fn device(&self) -> Device {
        self.predictor.pos_embedding.val().device()
    }

    /// Creates a model with random weights. `widths` holds the number of elements per frame of each column in
    /// `config.columns`.
    pub fn init(config: &DinoWmConfig, widths: &[usize], init: &Init) -> Self {
        let columns = config.columns.iter().zip(widths).map(|(column, width)| {
            let init = init.of("extra_encoders").of(&column.name);
            (column.name.clone(), ColumnEncoder::new(&init, *width, column.dim))
        });
        let pixels = 3 * config.encoder.patch().pow(2);
        let decoder = init.of("decoder");
        Self {
            backbone: config.encoder.init(&init.of("backbone"), config.image).no_grad(),
            predictor: config.predictor.init(&init.of("predictor"), config.patches(), config.dim()),
            extra_encoders: ModuleDict(columns.collect()),
            decoder: (config.decoder > 0).then(|| PatchDecoder {
                hidden: Linear::new(&decoder.of("hidden"), config.encoder.patch_dim(), config.decoder),
                pixels: Linear::new(&decoder.of(PIXELS), config.decoder, pixels),
            }),
        }
    }

    /// Returns the range of each column among the features of a patch; the image features come first.
    pub fn columns(&self) -> Vec<(&str, Range<usize>)> {
        let width = |encoder: &ColumnEncoder| encoder.patch_embed.bias.dims()[0];
        let all: usize = self.extra_encoders.iter().map(|(_, encoder)| width(encoder)).sum();
        let [_, _, dim] = self.predictor.pos_embedding.dims();
        let mut end = dim - all;
        let mut span = |encoder: &ColumnEncoder| {
            let start = end;
            end += width(encoder);
            start..end
        };
        self.extra_encoders.iter().map(|(name, encoder)| (name, span(encoder))).collect()
    }

    /// Appends the features of the columns to the features of every patch.
    ///
    /// # Shapes
    /// `features` is `[clips, frames, patches, features]`, each column is `[clips, frames, elements]`; returns
    /// `[clips, frames, patches, dim]`.
    pub fn embed(&self, features: Tensor<4>, columns: &[Tensor<3>]) -> Tensor<4> {
        let [_, _, patches, _] = features.dims();
        let encoded = self.extra_encoders.iter().zip(columns);
        let encoded = encoded.map(|((_, encoder), column)| tiled(encoder.forward(column.clone()), patches));
        Tensor::cat(std::iter::once(features).chain(encoded).collect(), 3)
    }

    /// Replaces the action features of frames.
    ///
    /// # Shapes
    /// `frames` is `[clips, frames, patches, dim]`, `actions` is `[clips, frames, action_dim]`; returns the shape of
    /// `frames`.
    pub fn with_actions(&self, frames: Tensor<4>, actions: Tensor<3>) -> Tensor<4> {
        let mut columns = self.extra_encoders.iter().zip(self.columns());
        let Some(((_, encoder), (_, span))) = columns.find(|((name, _), _)| *name == ACTION) else { return frames };
        let [clips, steps, patches, dim] = frames.dims();
        let part = |range: Range<usize>| frames.clone().slice([0..clips, 0..steps, 0..patches, range]);
        let mut parts = vec![part(0..span.start), tiled(encoder.forward(actions), patches)];
        if span.end < dim {
            parts.push(part(span.end..dim));
        }
        Tensor::cat(parts, 3)
    }

    /// Predicts the frame after each frame of a window.
    ///
    /// # Shapes
    /// `frames` is `[clips, frames, patches, dim]` with at most as many frames as the history; returns the same shape.
    pub fn predict(&self, frames: Tensor<4>, rng: &mut DropoutRng<'_>) -> Tensor<4> {
        let [clips, steps, patches, dim] = frames.dims();
        self.predictor.forward(frames.reshape([clips, steps * patches, dim]), rng).reshape([clips, steps, patches, dim])
    }

    /// Rolls the model out: returns the given frames, then one predicted frame after each further action. `actions`
    /// replace the action features of every returned frame except the last, whose action features have no meaning.
    ///
    /// # Shapes
    /// `given` is `[clips, given, patches, dim]`, `actions` is `[clips, steps, action_dim]` with `steps >= given`;
    /// returns `[clips, steps + 1, patches, dim]`.
    pub fn rollout(&self, given: Tensor<4>, actions: Tensor<3>) -> Tensor<4> {
        let ([clips, count, patches, dim], [_, steps, elements]) = (given.dims(), actions.dims());
        let history = self.predictor.config().history;
        let taken = |range: Range<usize>| actions.clone().slice([0..clips, range, 0..elements]);
        let mut all = self.with_actions(given, taken(0..count));
        for end in count..=steps {
            let window = all.clone().slice([0..clips, end.saturating_sub(history)..end, 0..patches, 0..dim]);
            let next = self.predict(window, &mut DropoutRng::disabled());
            let [_, count, _, _] = next.dims();
            let mut next = next.slice([0..clips, count - 1..count, 0..patches, 0..dim]);
            if end < steps {
                next = self.with_actions(next, taken(end..end + 1));
            }
            all = Tensor::cat(vec![all, next], 1);
        }
        all
    }
}

/// Repeats the features of a frame for every patch.
///
/// # Shapes
/// `features` is `[clips, frames, dim]`; returns `[clips, frames, patches, dim]`.
fn tiled(features: Tensor<3>, patches: usize) -> Tensor<4> {
    let [clips, frames, dim] = features.dims();
    let features: Tensor<4> = features.unsqueeze_dim(2);
    features.expand([clips, frames, patches, dim])
}
