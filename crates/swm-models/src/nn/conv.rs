//! [`Conv`]: an image encoder of overlapping convolutions, each followed by batch normalisation and ReLU. In training, the
//! normalisations use the statistics of the batch.

use super::kernels::{cell_sizes, conv_sizes};
use super::{Activation, BatchNorm, BatchStatistics, Init, Linear, Named};
use crate::train::{check_sizes, limits};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, module, ops::ConvOptions};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;
use swm_core::{Error, Result};
use swm_kernels::{ConvGradient, ConvSizes, ScratchPool};

/// The side of the kernels.
const KERNEL: usize = 3;

/// The size of a [`Conv`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConvConfig {
    /// The output channels of each convolution, first to last. A convolution halves the side of its input.
    pub channels: Vec<usize>,
    /// The number of hidden features after the last convolution; 0 for none.
    #[serde(default)]
    pub hidden: usize,
    /// The number of output features.
    pub dim: usize,
}

/// 3 x 3 convolutions with stride 2, then one or two linear layers.
#[derive(Module, Debug)]
pub struct Conv {
    /// The convolutions, first to last.
    pub stages: Vec<ConvStage>,
    /// The layer to the hidden features, if there are any.
    pub hidden: Option<Linear>,
    /// The output layer.
    pub out: Linear,
    #[module(skip)]
    kernels: ConvKernels,
}

/// One convolution and its normalisation.
#[derive(Module, Debug)]
pub struct ConvStage {
    /// The convolution, without bias.
    pub conv: Convolution,
    /// The normalisation.
    pub norm: BatchNorm,
}

/// The weights of a convolution.
#[derive(Module, Debug)]
pub struct Convolution {
    /// The kernels, `[outputs, inputs, 3, 3]`.
    pub weight: Param<Tensor<4>>,
}

/// The CPU kernels of the encoder, whose memory is reused from step to step. Copies of a model share it.
#[derive(Clone, Default)]
struct ConvKernels(Arc<ScratchPool<Option<Box<ConvGradient>>>>);

impl fmt::Debug for ConvKernels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ConvKernels")
    }
}

impl ConvConfig {
    /// The side of the feature map after the last convolution, for images with a side of `image` pixels.
    pub fn map(&self, image: usize) -> usize {
        self.channels.iter().fold(image, |side, _| side.div_ceil(2))
    }

    /// The channels of the feature map after the last convolution.
    pub fn last(&self) -> usize {
        self.channels.last().copied().unwrap_or(0)
    }

    /// Checks the sizes. `at` is the dotted path of the settings, for errors.
    ///
    /// # Errors
    /// When there is no convolution, a size is out of range, or the images are too small for the convolutions.
    pub fn check(&self, at: &str, image: usize) -> Result<()> {
        let invalid = |problem: String, fix: &str| Err(Error::config(format!("{at}.channels"), problem, fix));
        if self.channels.is_empty() {
            return invalid("the list is empty".to_owned(), "give at least one number");
        }
        let channels = self.channels.iter().map(|&channels| ("channels", channels, 1));
        for (what, size, least) in [("hidden", self.hidden, 0), ("dim", self.dim, 1)].into_iter().chain(channels) {
            check_sizes(&[(&format!("{at}.{what}"), size, least, limits::FEATURES)])?;
        }
        let most = image.max(1).ilog2() as usize;
        if self.channels.len() > most {
            let problem = format!("{} convolutions halve a side of {image} pixels", self.channels.len());
            return invalid(problem, &format!("give at most {most}, or larger images"));
        }
        Ok(())
    }

    /// Creates an encoder for images with a side of `image` pixels. Kernels have the variance of He et al. 2015.
    pub fn init(&self, init: &Init, image: usize) -> Conv {
        let inputs = std::iter::once(3).chain(self.channels.iter().copied());
        let stages = self.channels.iter().zip(inputs).enumerate().map(|(index, (&outputs, inputs))| {
            let init = init.of("stage").at(index);
            let std = (2.0 / (inputs * KERNEL * KERNEL) as f32).sqrt();
            ConvStage {
                conv: Convolution { weight: init.normal("weight", [outputs, inputs, KERNEL, KERNEL], std) },
                norm: BatchNorm::new(&init, outputs),
            }
        });
        let features = self.map(image).pow(2) * self.last();
        let hidden = (self.hidden > 0)
            .then(|| Linear::normal(&init.of("hidden"), features, self.hidden, (2.0 / features as f32).sqrt()));
        let out = Linear::new(&init.of("out"), if self.hidden > 0 { self.hidden } else { features }, self.dim);
        Conv { stages: stages.collect(), hidden, out, kernels: ConvKernels::default() }
    }
}

impl Conv {
    /// Computes the features of images, with the running statistics.
    ///
    /// # Shapes
    /// Maps `[frames, side * side, 3]` to `[frames, dim]`.
    pub fn forward(&self, pixels: Tensor<3>) -> Tensor<2> {
        self.head(self.cells(pixels))
    }

    /// Computes the features of images with the statistics of the batch; also returns the statistics, for
    /// [`Conv::track`].
    ///
    /// # Shapes
    /// As [`Conv::forward`].
    pub fn forward_train(&self, pixels: Tensor<3>) -> (Tensor<2>, Vec<BatchStatistics>) {
        let (cells, statistics) = self.cells_train(pixels);
        (self.head(cells), statistics)
    }

    /// Computes the feature map after the last convolution, with the running statistics.
    ///
    /// # Shapes
    /// Maps `[frames, side * side, 3]` to `[frames, map * map, channels]`.
    pub fn cells(&self, pixels: Tensor<3>) -> Tensor<3> {
        self.convolve(pixels, |norm, rows| norm.forward(rows))
    }

    /// Computes the feature map after the last convolution with the statistics of the batch, and returns the statistics.
    ///
    /// # Shapes
    /// As [`Conv::cells`].
    pub fn cells_train(&self, pixels: Tensor<3>) -> (Tensor<3>, Vec<BatchStatistics>) {
        let mut all = vec![];
        let cells = self.convolve(pixels, |norm, rows| {
            let (rows, statistics) = norm.forward_train(rows);
            all.push(statistics);
            rows
        });
        (cells, all)
    }

    fn convolve(&self, pixels: Tensor<3>, mut normalise: impl FnMut(&BatchNorm, Tensor<2>) -> Tensor<2>) -> Tensor<3> {
        let [frames, count, _] = pixels.dims();
        let (mut x, mut side) = (pixels, count.isqrt());
        for ConvStage { conv, norm } in &self.stages {
            let [_, _, inputs] = x.dims();
            let planes: Tensor<4> = x.reshape([frames, side, side, inputs]).permute([0, 3, 1, 2]);
            let planes = module::conv2d(planes, conv.weight.val(), None, ConvOptions::new([2; 2], [1; 2], [1; 2], 1));
            let [_, outputs, _, _] = planes.dims();
            side = side.div_ceil(2);
            let rows = planes.permute([0, 2, 3, 1]).reshape([frames * side * side, outputs]);
            x = Activation::Relu.forward(normalise(norm, rows)).reshape([frames, side * side, outputs]);
        }
        x
    }

    /// Computes the features from the feature map; the inputs of the first layer are ordered by channel, as PyTorch
    /// flattens a map.
    fn head(&self, cells: Tensor<3>) -> Tensor<2> {
        let [frames, cell, channels] = cells.dims();
        let x = cells.swap_dims(1, 2).reshape([frames, cell * channels]);
        match &self.hidden {
            Some(hidden) => self.out.forward(Activation::Relu.forward(hidden.forward(x))),
            None => self.out.forward(x),
        }
    }

    /// Returns CPU kernels for images with a side of `side` pixels: those of the last step, if they were returned.
    pub(crate) fn kernels(&self, side: usize) -> Box<ConvGradient> {
        self.kernels_of(conv_sizes(self, side))
    }

    /// Returns CPU kernels of the convolutions without the linear layers, as [`Conv::kernels`].
    pub(crate) fn cell_kernels(&self, side: usize) -> Box<ConvGradient> {
        self.kernels_of(cell_sizes(self, side))
    }

    fn kernels_of(&self, sizes: ConvSizes) -> Box<ConvGradient> {
        let unused = self.kernels.0.with(Option::take).filter(|kernels| *kernels.sizes() == sizes);
        unused.unwrap_or_else(|| Box::new(ConvGradient::new(&sizes)))
    }

    /// Keeps CPU kernels for the next step.
    pub(crate) fn return_kernels(&self, kernels: Box<ConvGradient>) {
        self.kernels.0.with(|unused| *unused = Some(kernels));
    }

    /// Updates the running statistics with batch statistics that [`store`] inserted under `name`.
    pub fn track(&mut self, name: &str, buffers: &mut Named<Tensor<1>>) {
        for (index, stage) in self.stages.iter_mut().enumerate() {
            if let Some(statistics) = BatchStatistics::take(&stage_name(name, index), buffers) {
                stage.norm.track(statistics);
            }
        }
    }
}

/// Inserts the statistics of an encoder's normalisations into `buffers` under `name`.
pub fn store(statistics: Vec<BatchStatistics>, name: &str, buffers: &mut Named<Tensor<1>>) {
    for (index, statistics) in statistics.into_iter().enumerate() {
        statistics.store(&stage_name(name, index), buffers);
    }
}

fn stage_name(name: &str, index: usize) -> String {
    format!("{name}.stages.{index}.norm")
}
