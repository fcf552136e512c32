//! Building blocks, with the parameter names and layouts PyTorch checkpoints use, so that weights move both ways
//! without renaming. Every initial value comes from a [`Key`] and the parameter's name, never from a global
//! generator.

pub mod activation;
pub mod attention;
pub mod backbone;
mod custom_derivative;
pub mod dino;
pub(crate) mod kernels;
pub mod linear;
pub mod mlp;
pub mod module_dict;
pub mod norm;
pub mod normalized_mlp;
pub mod parameters;
pub mod patch_cnn;
pub mod positions;
pub mod predictor;
pub mod two_hot;
pub mod vit;

pub use activation::{Activation, DropoutRng};
pub use attention::{FeedForward, SelfAttention};
pub use backbone::{Backbone, BackboneConfig};
pub use custom_derivative::with_derivative;
pub use dino::{Dino, DinoConfig};
pub use linear::Linear;
pub use mlp::{Embedder, Mlp, Projector};
pub use module_dict::ModuleDict;
pub use norm::{BatchNorm, BatchStatistics, LayerNorm};
pub use normalized_mlp::{Dynamics, Ensemble, Head, NormalizedLinear};
pub use parameters::Named;
pub use patch_cnn::{PatchCnn, PatchCnnConfig, Stage};
pub use predictor::{Predictor, PredictorConfig};
pub use two_hot::Bins;
pub use vit::{Vit, VitConfig};

use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use rand_distr::{Distribution as _, StandardNormal};
use swm_core::Key;

/// Where initial values come from: a key that narrows with the path of the parameter.
#[derive(Clone)]
pub struct Init {
    key: Key,
    device: Device,
}

impl Init {
    /// Initial values decided by `key`, on `device`.
    pub fn new(key: Key, device: &Device) -> Self {
        Self { key, device: device.clone() }
    }

    /// Initial values of a part.
    #[must_use]
    pub fn of(&self, part: &str) -> Self {
        Self { key: self.key.with(part), device: self.device.clone() }
    }

    /// Initial values of the `index`th part.
    #[must_use]
    pub fn at(&self, index: usize) -> Self {
        Self { key: self.key.at(index as u64), device: self.device.clone() }
    }

    /// A parameter drawn uniformly from `-bound ..= bound`.
    pub fn uniform<const D: usize>(&self, name: &str, shape: [usize; D], bound: f32) -> Param<Tensor<D>> {
        use rand::Rng as _;
        let mut rng = self.key.with(name).rng();
        self.draw(shape, || rng.random_range(-bound..=bound))
    }

    /// A parameter drawn from a normal distribution of mean 0, cut off at two standard deviations.
    pub fn normal<const D: usize>(&self, name: &str, shape: [usize; D], std: f32) -> Param<Tensor<D>> {
        let mut rng = self.key.with(name).rng();
        self.draw(shape, || {
            loop {
                let value: f32 = StandardNormal.sample(&mut rng);
                if value.abs() <= 2.0 {
                    return value * std;
                }
            }
        })
    }

    /// A parameter of equal numbers.
    pub fn constant<const D: usize>(&self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        self.draw(shape, || value)
    }

    /// A tensor that is stored with the weights but not trained.
    pub fn buffer<const D: usize>(&self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        self.constant(shape, value).set_require_grad(false)
    }

    fn draw<const D: usize>(&self, shape: [usize; D], mut next: impl FnMut() -> f32) -> Param<Tensor<D>> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| next()).collect();
        Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), &self.device))
    }
}

/// Standard normal numbers, `[keys, width]`, each row decided by its key.
pub fn normal(keys: &[Key], width: usize) -> Vec<f32> {
    let row = |key: &Key| {
        let mut rng = key.rng();
        (0..width).map(move |_| StandardNormal.sample(&mut rng))
    };
    keys.iter().flat_map(row).collect()
}
