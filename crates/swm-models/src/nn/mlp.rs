//! Small networks around the encoder and the predictor.

use super::{Activation, BatchNorm, BatchStatistics, Init, Linear};
use burn::module::Module;
use burn::tensor::Tensor;

/// Linear, batch normalisation, GELU, linear. Its parts carry the published names `net.0`, `net.1`, `net.3`: a
/// field `_3` is number 3 of a sequence.
#[derive(Module, Debug)]
pub struct Projector {
    /// The sequence.
    pub net: ProjectorNet,
}

/// The sequence of a [`Projector`].
#[derive(Module, Debug)]
pub struct ProjectorNet {
    /// Into the hidden features.
    pub _0: Linear,
    /// Normalises them.
    pub _1: BatchNorm,
    /// Out of them.
    pub _3: Linear,
}

impl Projector {
    /// A projector.
    pub fn new(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            net: ProjectorNet {
                _0: Linear::new(&init.of("0"), inputs, hidden),
                _1: BatchNorm::new(&init.of("1"), hidden),
                _3: Linear::new(&init.of("3"), hidden, outputs),
            },
        }
    }

    /// # Shapes
    /// `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let hidden = self.net._1.forward(self.net._0.forward(x));
        self.net._3.forward(Activation::Gelu.forward(hidden))
    }

    /// As [`Projector::forward`], with the statistics of the batch.
    pub fn forward_train(&self, x: Tensor<2>) -> (Tensor<2>, BatchStatistics) {
        let (hidden, statistics) = self.net._1.forward_train(self.net._0.forward(x));
        (self.net._3.forward(Activation::Gelu.forward(hidden)), statistics)
    }

    /// Moves the running statistics towards those of a batch.
    pub fn track(&mut self, batch: BatchStatistics) {
        self.net._1.track(batch);
    }
}

/// The action encoder: a convolution over time with one tap (a linear map), then a network of one hidden layer.
#[derive(Module, Debug)]
pub struct Embedder {
    /// The convolution.
    pub patch_embed: PointwiseConv,
    /// The network.
    pub embed: EmbedderNet,
}

/// A convolution with one tap.
#[derive(Module, Debug)]
pub struct PointwiseConv {
    /// `[outputs, inputs, 1]`.
    pub weight: burn::module::Param<Tensor<3>>,
    /// `[outputs]`.
    pub bias: burn::module::Param<Tensor<1>>,
}

/// The network of an [`Embedder`].
#[derive(Module, Debug)]
pub struct EmbedderNet {
    /// Into the hidden features.
    pub _0: Linear,
    /// Out of them.
    pub _2: Linear,
}

impl Embedder {
    /// An embedder of `inputs` numbers, of which the convolution makes `smoothed`, with `4 outputs` hidden features.
    #[allow(clippy::cast_precision_loss)]
    pub fn new(init: &Init, inputs: usize, smoothed: usize, outputs: usize) -> Self {
        let (tap, bound) = (init.of("patch_embed"), 1.0 / (inputs as f32).sqrt());
        Self {
            patch_embed: PointwiseConv {
                weight: tap.uniform("weight", [smoothed, inputs, 1], bound),
                bias: tap.uniform("bias", [smoothed], bound),
            },
            embed: EmbedderNet {
                _0: Linear::new(&init.of("0"), smoothed, 4 * outputs),
                _2: Linear::new(&init.of("2"), 4 * outputs, outputs),
            },
        }
    }

    /// # Shapes
    /// `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let tap: Tensor<2> = self.patch_embed.weight.val().squeeze_dim(2);
        let x = x.matmul(tap.transpose()) + self.patch_embed.bias.val().unsqueeze();
        self.embed._2.forward(Activation::Silu.forward(self.embed._0.forward(x)))
    }
}

/// Two hidden layers with GELU. A field `_2` is number 2 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct Mlp {
    /// Into hidden features.
    pub _0: Linear,
    /// From hidden features to hidden features.
    pub _2: Linear,
    /// Out of them.
    pub _4: Linear,
}

impl Mlp {
    /// A network.
    pub fn new(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            _0: Linear::new(&init.of("0"), inputs, hidden),
            _2: Linear::new(&init.of("2"), hidden, hidden),
            _4: Linear::new(&init.of("4"), hidden, outputs),
        }
    }

    /// # Shapes
    /// `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let hidden = Activation::Gelu.forward(self._0.forward(x));
        self._4.forward(Activation::Gelu.forward(self._2.forward(hidden)))
    }
}
