//! [`ImageCnn`]: the image encoder, four convolutions and a linear layer.

use crate::nn::{Init, Linear, normalized_mlp::mish};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, module, ops::ConvOptions};
use swm_core::{Error, Result};

/// Kernel side and stride of each convolution.
const KERNELS: [[usize; 2]; 4] = [[7, 2], [5, 2], [3, 2], [3, 1]];
/// Output channels of every convolution.
const CHANNELS: usize = 32;

/// A convolution without padding.
#[derive(Module, Debug)]
pub struct Convolution {
    /// The kernels, `[outputs, inputs, side, side]`.
    pub weight: Param<Tensor<4>>,
    /// The biases, `[outputs]`.
    pub bias: Param<Tensor<1>>,
}

impl Convolution {
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

/// The convolutions, each followed by Mish. A field `_i` is element i of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct ImageCnn {
    /// The first convolution.
    pub _0: Convolution,
    /// The second convolution.
    pub _2: Convolution,
    /// The third convolution.
    pub _4: Convolution,
    /// The last convolution.
    pub _6: Convolution,
}

impl ImageCnn {
    /// Creates convolutions with random weights.
    pub fn new(init: &Init) -> Self {
        let layer = |name: &str, inputs, kernel: usize| Convolution::new(&init.of(name), inputs, KERNELS[kernel][0]);
        Self {
            _0: layer("0", 3, 0),
            _2: layer("2", CHANNELS, 1),
            _4: layer("4", CHANNELS, 2),
            _6: layer("6", CHANNELS, 3),
        }
    }

    /// Computes the features of images.
    ///
    /// # Shapes
    /// `x` is `[frames, 3, image, image]`; returns `[frames, features]`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<2> {
        let layers = [&self._0, &self._2, &self._4, &self._6];
        layers.into_iter().zip(KERNELS).fold(x, |x, (layer, [_, stride])| mish(layer.forward(x, stride))).flatten(1, 3)
    }
}

/// Returns the linear layer after the convolutions, for images with a side of `image` pixels.
pub fn projection(init: &Init, image: usize, latent: usize) -> Linear {
    let side = side(image).unwrap_or(1);
    Linear::normal(init, CHANNELS * side * side, latent, 0.02)
}

/// Returns the side of the last convolution's output; `None` if a kernel is larger than the input of the
/// convolution.
fn side(image: usize) -> Option<usize> {
    KERNELS.iter().try_fold(image, |side, &[kernel, stride]| Some(side.checked_sub(kernel)? / stride + 1))
}

/// Checks the side of the input images.
///
/// # Errors
/// When the side is below 39 pixels.
pub fn check(image: usize) -> Result<()> {
    match side(image) {
        Some(_) => Ok(()),
        None => Err(Error::config("model.image", image.to_string(), "choose images with a side of at least 39 pixels")),
    }
}
