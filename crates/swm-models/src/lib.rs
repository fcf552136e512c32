//! World models and their training.
//!
//! - [`nn`]: building blocks, under PyTorch's parameter names; [`pixels`]: from bytes to numbers.
//! - [`train`](mod@train): the training loop for every [`Trainable`] model, presets, logs.
//! - [`lewm`]: the LeWM family: model, loss, planning cost.
//! - [`tdmpc2`]: TD-MPC2, a world model of rewards and values; [`sac`]: soft actor-critic, which demonstrates.
//! - [`online`]: playing and learning by turns.
//! - [`pldm`]: the PLDM family: LeWM's model under VICReg's losses, temporal alignment and inverse dynamics.
//! - [`dino_wm`]: the DINO-WM family: a frozen encoder of patches, a predictor of the patches of the next frame.
//! - [`gcrl`]: goal-conditioned cloning, values and Q-learning; [`feed_forward`]: acting without planning.
//! - [`inverse`]: an inverse-dynamics policy on a frozen encoder, the baseline without planning.
//! - [`weights`]: weights of others, from files and the Hugging Face hub, and for PyTorch.
//! - [`probe`]: what latents say about the world.
//! - [`checkpoint`]: trained models on disk.
//! - [`device`]: where they compute.

pub mod checkpoint;
mod checks;
pub mod device;
pub mod dino_wm;
pub mod family;
pub mod feed_forward;
pub mod gcrl;
pub mod inverse;
pub mod lewm;
pub mod nn;
pub mod online;
pub mod pixels;
pub mod pldm;
pub mod probe;
pub mod registry;
pub mod sac;
pub mod tdmpc2;
pub mod train;
pub mod weights;

pub use burn::tensor::Device;
pub use checkpoint::Checkpoint;
pub use family::{CheckpointInfo, FamilyEntry, LoadedModel, ModelFamily, OnlineRun, TrainRun, TrainableConfig};
pub use registry::{FAMILIES, load, load_from};
pub use train::{Observer, Progress, TrainConfig, TrainOptions, TrainSummary, Trainable, train};
