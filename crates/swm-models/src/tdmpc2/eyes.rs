//! The encoder of pictures: four convolutions and a linear map.

use crate::nn::{Init, Linear, normalized_mlp::mish};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, module, ops::ConvOptions};
use swm_core::{Error, Result};

/// Side and stride of the kernels.
const KERNELS: [[usize; 2]; 4] = [[7, 2], [5, 2], [3, 2], [3, 1]];
/// Channels of every convolution.
const CHANNELS: usize = 32;

/// A convolution without padding.
#[derive(Module, Debug)]
pub struct Convolution {
    /// `[outputs, inputs, side, side]`.
    pub weight: Param<Tensor<4>>,
    /// `[outputs]`.
    pub bias: Param<Tensor<1>>,
}

impl Convolution {
    #[allow(clippy::cast_precision_loss)]
    fn new(init: &Init, inputs: usize, side: usize) -> Self {
        let bound = 1.0 / ((inputs * side * side) as f32).sqrt();
        Self {
            weight: init.uniform("weight", [CHANNELS, inputs, side, side], bound),
            bias: init.uniform("bias", [CHANNELS], bound),
        }
    }

    fn forward(&self, x: Tensor<4>, stride: usize) -> Tensor<4> {
        let options = ConvOptions::new([stride; 2], [0; 2], [1; 2], 1);
        module::conv2d(x, self.weight.val(), Some(self.bias.val()), options)
    }
}

/// The convolutions, with Mish behind each. A field `_2` is number 2 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct Eyes {
    /// The first.
    pub _0: Convolution,
    /// The second.
    pub _2: Convolution,
    /// The third.
    pub _4: Convolution,
    /// The last.
    pub _6: Convolution,
}

impl Eyes {
    /// The convolutions.
    pub fn new(init: &Init) -> Self {
        let layer = |name: &str, inputs, kernel: usize| Convolution::new(&init.of(name), inputs, KERNELS[kernel][0]);
        Self {
            _0: layer("0", 3, 0),
            _2: layer("2", CHANNELS, 1),
            _4: layer("4", CHANNELS, 2),
            _6: layer("6", CHANNELS, 3),
        }
    }

    /// `[frames, 3, image, image]` to `[frames, features]`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<2> {
        let layers = [&self._0, &self._2, &self._4, &self._6];
        layers.into_iter().zip(KERNELS).fold(x, |x, (layer, [_, stride])| mish(layer.forward(x, stride))).flatten(1, 3)
    }
}

/// The linear map behind them, for pictures of a side.
pub fn projection(init: &Init, image: usize, latent: usize) -> Linear {
    let side = side(image).unwrap_or(1);
    Linear::normal(init, CHANNELS * side * side, latent, 0.02)
}

/// The side of what the last convolution makes of a picture; none where a kernel is larger than what it looks at.
fn side(image: usize) -> Option<usize> {
    KERNELS.iter().try_fold(image, |side, &[kernel, stride]| Some(side.checked_sub(kernel)? / stride + 1))
}

/// Checks the side of pictures.
///
/// # Errors
/// When they are too small.
pub fn check(image: usize) -> Result<()> {
    match side(image) {
        Some(_) => Ok(()),
        None => Err(Error::config("model.image", image.to_string(), "choose pictures of at least 39 pixels a side")),
    }
}
