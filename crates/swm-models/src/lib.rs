//! World models and their training.
//!
//! - [`nn`]: building blocks, under PyTorch's parameter names.
//! - [`lewm`]: the LeWM family: model, loss, planning cost.
//! - [`inverse`]: an inverse-dynamics policy on a frozen encoder, the baseline without planning.
//! - [`train`](mod@train): the training loop, presets, logs.
//! - [`checkpoint`]: trained models on disk.

pub mod checkpoint;
pub mod inverse;
pub mod lewm;
pub mod nn;
pub mod train;

pub use burn::tensor::Device;
pub use checkpoint::Checkpoint;
pub use train::{Observer, PRESETS, Progress, TrainConfig, TrainOptions, TrainSummary, train};
