//! World models and their training.
//!
//! - [`nn`]: building blocks, under PyTorch's parameter names; [`pixels`]: from bytes to numbers.
//! - [`train`](mod@train): the training loop for every [`Trainable`] model, presets, logs.
//! - [`lewm`]: the LeWM family: model, loss, planning cost.
//! - [`inverse`]: an inverse-dynamics policy on a frozen encoder, the baseline without planning.
//! - [`checkpoint`]: trained models on disk.
//! - [`device`]: where they compute.

pub mod checkpoint;
pub mod device;
pub mod inverse;
pub mod lewm;
pub mod nn;
pub mod pixels;
pub mod train;

pub use burn::tensor::Device;
pub use checkpoint::Checkpoint;
pub use train::{Observer, Progress, TrainConfig, TrainOptions, TrainSummary, Trainable, train};
