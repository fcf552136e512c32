//! Multi-layer perceptrons: the projector of latents, the action embedder, and a network with two hidden layers.

use super::{Activation, BatchNorm, BatchStatistics, Init, Linear};
use burn::module::Module;
use burn::tensor::Tensor;

/// A projector: linear, batch normalisation, GELU, linear. The layers have the published names `net.0`, `net.1`,
/// `net.3`: a field `_3` is element 3 of a sequence.
#[derive(Module, Debug)]
pub struct Projector {
    /// The sequence.
    pub net: ProjectorNet,
}

/// The sequence of a [`Projector`].
#[derive(Module, Debug)]
pub struct ProjectorNet {
    /// The layer to the hidden features.
    pub _0: Linear,
    /// The normalisation of the hidden features.
    pub _1: BatchNorm,
    /// The layer from the hidden features.
    pub _3: Linear,
}

impl Projector {
    /// Creates a projector.
    pub fn new(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            net: ProjectorNet {
                _0: Linear::new(&init.of("0"), inputs, hidden),
                _1: BatchNorm::new(&init.of("1"), hidden),
                _3: Linear::new(&init.of("3"), hidden, outputs),
            },
        }
    }

    /// Applies the projector with the running statistics, for evaluation.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let hidden = self.net._1.forward(self.net._0.forward(x));
        self.net._3.forward(Activation::Gelu.forward(hidden))
    }

    /// Applies the projector with the statistics of the batch, for training; returns the output and the statistics.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward_train(&self, x: Tensor<2>) -> (Tensor<2>, BatchStatistics) {
        let (hidden, statistics) = self.net._1.forward_train(self.net._0.forward(x));
        (self.net._3.forward(Activation::Gelu.forward(hidden)), statistics)
    }

    /// Updates the running statistics with the statistics of a batch.
    pub fn track(&mut self, batch: BatchStatistics) {
        self.net._1.track(batch);
    }
}

/// The action encoder: a convolution over time with a kernel of 1, then a network with one hidden layer.
#[derive(Module, Debug)]
pub struct Embedder {
    /// The convolution.
    pub patch_embed: PointwiseConv,
    /// The network.
    pub embed: EmbedderNet,
}

/// A convolution with a kernel of 1, which is a linear layer.
#[derive(Module, Debug)]
pub struct PointwiseConv {
    /// The weights, `[outputs, inputs, 1]`.
    pub weight: burn::module::Param<Tensor<3>>,
    /// The bias, `[outputs]`.
    pub bias: burn::module::Param<Tensor<1>>,
}

/// The network of an [`Embedder`].
#[derive(Module, Debug)]
pub struct EmbedderNet {
    /// The layer to the hidden features.
    pub _0: Linear,
    /// The layer from the hidden features.
    pub _2: Linear,
}

impl Embedder {
    /// Creates an embedder of vectors with `inputs` elements, whose convolution has `smoothed` outputs and whose
    /// network has `4 * outputs` hidden features.
    pub fn new(init: &Init, inputs: usize, smoothed: usize, outputs: usize) -> Self {
        let (conv, bound) = (init.of("patch_embed"), 1.0 / (inputs as f32).sqrt());
        Self {
            patch_embed: PointwiseConv {
                weight: conv.uniform("weight", [smoothed, inputs, 1], bound),
                bias: conv.uniform("bias", [smoothed], bound),
            },
            embed: EmbedderNet {
                _0: Linear::new(&init.of("0"), smoothed, 4 * outputs),
                _2: Linear::new(&init.of("2"), 4 * outputs, outputs),
            },
        }
    }

    /// Embeds actions.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let weight: Tensor<2> = self.patch_embed.weight.val().squeeze_dim(2);
        let x = x.matmul(weight.transpose()) + self.patch_embed.bias.val().unsqueeze();
        self.embed._2.forward(Activation::Silu.forward(self.embed._0.forward(x)))
    }
}

/// A network of two hidden layers with GELU. A field `_2` is element 2 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct Mlp {
    /// The layer to the hidden features.
    pub _0: Linear,
    /// The layer between the hidden features.
    pub _2: Linear,
    /// The layer from the hidden features.
    pub _4: Linear,
}

impl Mlp {
    /// Creates a network.
    pub fn new(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            _0: Linear::new(&init.of("0"), inputs, hidden),
            _2: Linear::new(&init.of("2"), hidden, hidden),
            _4: Linear::new(&init.of("4"), hidden, outputs),
        }
    }

    /// Applies the network.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let hidden = Activation::Gelu.forward(self._0.forward(x));
        self._4.forward(Activation::Gelu.forward(self._2.forward(hidden)))
    }
}
