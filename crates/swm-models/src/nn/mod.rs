//! Network modules with the parameter names and layouts of PyTorch checkpoints, so that weights need no renaming. A
//! [`Key`] and the name of a parameter determine the initial values; no global generator is used.

pub mod activation;
pub mod attention;
pub mod backbone;
pub mod conv;
mod custom_derivative;
pub mod dino;
mod fused_layers;
pub(crate) mod kernels;
pub mod keypoints;
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
pub use conv::{Conv, ConvConfig};
pub use custom_derivative::with_derivative;
pub use dino::{Dino, DinoConfig};
pub use keypoints::{Keypoints, KeypointsConfig};
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
use parameters::HostTensor;
use rand_distr::{Distribution as _, StandardNormal};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use swm_core::{Error, Key, Result};

/// A source of initial values: a key derived along the path of the parameter. The parameters that it creates have a
/// limited number of elements in all, because the sizes of a model may come from a file.
#[derive(Clone)]
pub struct Init {
    key: Key,
    device: Device,
    budget: Arc<Budget>,
}

/// The number of elements that a model may have.
struct Budget {
    limit: usize,
    created: AtomicUsize,
    exceeded: AtomicBool,
}

/// The most elements of a model, unless its weights limit it: 8 GiB in single precision.
const LARGEST_MODEL: usize = 1 << 31;
/// Added to the limit that the weights set, so that errors name the first weight that differs.
const MARGIN: usize = 1 << 20;

impl Init {
    /// Creates a source of values on `device` that `key` determines.
    pub fn new(key: Key, device: &Device) -> Self {
        Self::limited(key, device, LARGEST_MODEL)
    }

    /// Creates a source of values that `weights` replace: the model may be little larger than they are.
    pub fn for_weights(weights: &Named<HostTensor>, device: &Device) -> Self {
        let elements: usize = weights.values().map(|tensor| tensor.values.len()).sum();
        Self::limited(Key::new(0), device, 2 * elements + MARGIN)
    }

    fn limited(key: Key, device: &Device, limit: usize) -> Self {
        let budget = Budget { limit, created: AtomicUsize::new(0), exceeded: AtomicBool::new(false) };
        Self { key, device: device.clone(), budget: Arc::new(budget) }
    }

    /// Checks that the model was created whole; a parameter beyond the limit has one element instead.
    ///
    /// # Errors
    /// When the model has more elements than the limit, or does not fit into memory.
    pub fn check(&self) -> Result<()> {
        if !self.budget.exceeded.load(Ordering::Relaxed) {
            return Ok(());
        }
        let given = format!("its sizes give more than {} elements, or more than the free memory", self.budget.limit);
        Err(Error::config("model", given, "choose smaller sizes, or give the weights of this configuration"))
    }

    /// Returns the source for the submodule named `part`.
    #[must_use]
    pub fn of(&self, part: &str) -> Self {
        Self { key: self.key.with(part), ..self.clone() }
    }

    /// Returns the source for the submodule with the index `index`.
    #[must_use]
    pub fn at(&self, index: usize) -> Self {
        Self { key: self.key.at(index as u64), ..self.clone() }
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
        let (values, shape) = match self.reserve(&shape) {
            Some((count, mut values)) => {
                values.extend((0..count).map(|_| next()));
                (values, shape)
            }
            None => {
                self.budget.exceeded.store(true, Ordering::Relaxed);
                (vec![0.0], [1; D])
            }
        };
        Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), &self.device))
    }

    /// Returns the number of elements of a shape and memory for them; `None` beyond the limit or the free memory.
    fn reserve(&self, shape: &[usize]) -> Option<(usize, Vec<f32>)> {
        let count = shape.iter().try_fold(1_usize, |count, side| count.checked_mul(*side))?;
        let created = self.budget.created.fetch_add(count.min(self.budget.limit), Ordering::Relaxed);
        if self.budget.limit.checked_sub(created)? < count {
            return None;
        }
        let mut values = vec![];
        values.try_reserve_exact(count).ok()?;
        Some((count, values))
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
