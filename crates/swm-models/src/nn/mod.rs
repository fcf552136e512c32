//! Network modules with the parameter names and layouts of PyTorch checkpoints, so that weights need no renaming. A
//! [`Key`] and the name of a parameter determine the initial values; no global generator is used.

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

/// A source of initial values: a key derived along the path of the parameter.
#[derive(Clone)]
pub struct Init {
    key: Key,
    device: Device,
}

impl Init {
    /// Creates a source of values on `device` that `key` determines.
    pub fn new(key: Key, device: &Device) -> Self {
        Self { key, device: device.clone() }
    }

    /// Returns the source for the submodule named `part`.
    #[must_use]
    pub fn of(&self, part: &str) -> Self {
        Self { key: self.key.with(part), device: self.device.clone() }
    }

    /// Returns the source for the submodule with the index `index`.
    #[must_use]
    pub fn at(&self, index: usize) -> Self {
        Self { key: self.key.at(index as u64), device: self.device.clone() }
    }

    /// Draws a parameter uniformly from `-bound ..= bound`.
    pub fn uniform<const D: usize>(&self, name: &str, shape: [usize; D], bound: f32) -> Param<Tensor<D>> {
        use rand::Rng as _;
        let mut rng = self.key.with(name).rng();
        self.draw(shape, || rng.random_range(-bound..=bound))
    }

    /// Draws a parameter from a normal distribution of mean 0 and standard deviation `std`, truncated at `2 * std`.
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

    /// Creates a parameter whose elements are all `value`.
    pub fn constant<const D: usize>(&self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        self.draw(shape, || value)
    }

    /// Creates a constant tensor that is stored with the weights but not trained.
    pub fn buffer<const D: usize>(&self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        self.constant(shape, value).set_require_grad(false)
    }

    fn draw<const D: usize>(&self, shape: [usize; D], mut next: impl FnMut() -> f32) -> Param<Tensor<D>> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| next()).collect();
        Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), &self.device))
    }
}

/// Draws one row of standard normal values per key.
///
/// # Shapes
/// `[keys, width]`.
pub fn normal(keys: &[Key], width: usize) -> Vec<f32> {
    let row = |key: &Key| {
        let mut rng = key.rng();
        (0..width).map(move |_| StandardNormal.sample(&mut rng))
    };
    keys.iter().flat_map(row).collect()
}
