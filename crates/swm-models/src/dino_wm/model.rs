//! [`DinoWm`]: a frozen encoder of patches, encoders of columns, the predictor, and a decoder of pictures.

use super::config::{ACTION, DinoWmConfig};
use super::predictor::FramePredictor;
use crate::nn::mlp::PointwiseConv;
use crate::nn::{Activation, Backbone, DropoutRng, Init, Linear, ModuleDict};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use std::ops::Range;
use swm_core::Key;

/// A DINO-WM: from the patches of frames and the actions between them to the patches of the next frame.
#[derive(Module, Debug)]
pub struct DinoWm {
    /// From pictures to features of patches; frozen.
    pub backbone: Backbone,
    /// From a window of frames to the next.
    pub predictor: FramePredictor,
    /// From columns to what stands beside the features of every patch.
    pub extra_encoders: ModuleDict<ColumnEncoder>,
    /// From features of patches to their pixels.
    pub decoder: Option<PatchDecoder>,
}

/// A convolution over time with one tap: a linear map.
#[derive(Module, Debug)]
pub struct ColumnEncoder {
    /// `[dim, numbers, 1]`.
    pub patch_embed: PointwiseConv,
}

/// From the features of a patch to its pixels: linear, GELU, and a transposed convolution whose stride is its kernel,
/// which is one matrix product.
#[derive(Module, Debug)]
pub struct PatchDecoder {
    /// Into the hidden features.
    pub hidden: Linear,
    /// Out of them.
    pub pixels: Linear,
}

impl ColumnEncoder {
    #[allow(clippy::cast_precision_loss)]
    fn new(init: &Init, numbers: usize, dim: usize) -> Self {
        let bound = 1.0 / (numbers as f32).sqrt();
        let weight = init.uniform("weight", [dim, numbers, 1], bound);
        Self { patch_embed: PointwiseConv { weight, bias: init.uniform("bias", [dim], bound) } }
    }

    /// # Shapes
    /// `[clips, frames, numbers]` to `[clips, frames, dim]`.
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let [clips, frames, numbers] = x.dims();
        let weight: Tensor<2> = self.patch_embed.weight.val().squeeze_dim(2);
        let [dim, _] = weight.dims();
        let y = x.reshape([clips * frames, numbers]).matmul(weight.transpose());
        (y + self.patch_embed.bias.val().unsqueeze()).reshape([clips, frames, dim])
    }
}

impl PatchDecoder {
    /// # Shapes
    /// Features `[frames, patches, dim]` to normalised pixels `[frames, patches, 3 * patch * patch]`.
    pub fn forward(&self, features: Tensor<3>) -> Tensor<3> {
        self.pixels.forward(Activation::Gelu.forward(self.hidden.forward(features)))
    }
}

impl DinoWm {
    /// A model drawn from `key`; `numbers` are those of each column in a frame, in the order of the configuration.
    pub fn init(config: &DinoWmConfig, numbers: &[usize], key: Key, device: &Device) -> Self {
        let init = Init::new(key, device);
        let columns = config.columns.iter().zip(numbers).map(|(column, numbers)| {
            let init = init.of("extra_encoders").of(&column.name);
            (column.name.clone(), ColumnEncoder::new(&init, *numbers, column.dim))
        });
        let pixels = 3 * config.encoder.patch().pow(2);
        let decoder = init.of("decoder");
        Self {
            backbone: config.encoder.init(&init.of("backbone"), config.image).no_grad(),
            predictor: config.predictor.init(&init.of("predictor"), config.patches(), config.dim()),
            extra_encoders: ModuleDict(columns.collect()),
            decoder: (config.decoder > 0).then(|| PatchDecoder {
                hidden: Linear::new(&decoder.of("hidden"), config.encoder.dim(), config.decoder),
                pixels: Linear::new(&decoder.of("pixels"), config.decoder, pixels),
            }),
        }
    }

    /// Which features of a patch stand for each column; those of the picture come before.
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

    /// The features of whole frames: those of the patches, with those of the columns beside each.
    ///
    /// # Shapes
    /// `[clips, frames, patches, features]` and, in order, `[clips, frames, numbers]` to `[clips, frames, patches, dim]`.
    pub fn embed(&self, features: Tensor<4>, columns: &[Tensor<3>]) -> Tensor<4> {
        let [_, _, patches, _] = features.dims();
        let beside = self.extra_encoders.iter().zip(columns);
        let beside = beside.map(|((_, encoder), column)| tiled(encoder.forward(column.clone()), patches));
        Tensor::cat(std::iter::once(features).chain(beside).collect(), 3)
    }

    /// Frames with other actions beside their patches.
    ///
    /// # Shapes
    /// `[clips, frames, patches, dim]` and `[clips, frames, numbers]` to the former.
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

    /// The frame after each of a window.
    ///
    /// # Shapes
    /// `[clips, frames, patches, dim]`, `frames` at most the history, to the same.
    pub fn predict(&self, frames: Tensor<4>, noise: &mut DropoutRng<'_>) -> Tensor<4> {
        let [clips, steps, patches, dim] = frames.dims();
        self.predictor
            .forward(frames.reshape([clips, steps * patches, dim]), noise)
            .reshape([clips, steps, patches, dim])
    }

    /// All frames of a rollout: those given, then one predicted after each further action.
    ///
    /// # Shapes
    /// `[clips, given, patches, dim]` and `[clips, steps, numbers]`, `steps >= given`, to `[clips, steps + 1, patches,
    /// dim]`. The actions beside the frames given do not matter; the last frame has none of meaning beside it.
    pub fn rollout(&self, given: Tensor<4>, actions: Tensor<3>) -> Tensor<4> {
        let ([clips, seen, patches, dim], [_, steps, numbers]) = (given.dims(), actions.dims());
        let history = self.predictor.config().history;
        let taken = |range: Range<usize>| actions.clone().slice([0..clips, range, 0..numbers]);
        let mut all = self.with_actions(given, taken(0..seen));
        for end in seen..=steps {
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

/// The same features beside every patch: `[clips, frames, dim]` to `[clips, frames, patches, dim]`.
fn tiled(features: Tensor<3>, patches: usize) -> Tensor<4> {
    let [clips, frames, dim] = features.dims();
    let features: Tensor<4> = features.unsqueeze_dim(2);
    features.expand([clips, frames, patches, dim])
}
