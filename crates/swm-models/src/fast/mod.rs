//! Planning and training on the CPU: what is repeated thousands of times, as kernels on plain arrays.
//!
//! Burn's tensors cost fresh memory and a pass over it for every operation. Here weights are laid out once
//! ([`Panels`]), scratch is kept, and every row is computed on its own, so that neither threads nor neighbours change a
//! byte. The numbers are those of the same layers in [`nn`](crate::nn), up to rounding.

// Loops over constant numbers of lanes are what compilers turn into vectors.
#![allow(clippy::needless_range_loop)]

pub mod attention;
pub mod dense;
pub mod functions;
pub mod norm;
pub mod product;
mod scratch;
mod simd;
pub mod vit;
pub mod vit_gradient;

pub(crate) use attention::attend;
pub use dense::dense;
pub use norm::{Modulation, Norm};
pub use product::Panels;
pub(crate) use scratch::{Pool, grown};
pub use vit::FastVit;
pub use vit_gradient::VitGradient;

use crate::nn::parameters::IntoF32;
use burn::tensor::Tensor;

/// The numbers of a tensor, row by row.
pub(crate) fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().into_f32_vec()
}
