//! World models, goal-conditioned policies and their training.
//!
//! - [`nn`]: building blocks, under PyTorch's parameter names; [`pixels`]: from bytes to normalised tensors.
//! - [`train`](mod@train): the training loop for every [`Trainable`] model, presets, logs.
//! - [`online`]: training by interaction with an environment.
//! - [`lewm`]: the LeWM family: model, loss, planning cost.
//! - [`pldm`]: the PLDM family: LeWM's model with VICReg losses, temporal alignment and inverse dynamics.
//! - [`dino_wm`]: the DINO-WM family: a frozen patch encoder and a predictor of the patches of the next frame.
//! - [`tdmpc2`]: TD-MPC2, a world model of rewards and values; [`sac`]: soft actor-critic.
//! - [`gcrl`]: goal-conditioned cloning, values and Q-learning; [`feed_forward`]: policies that do not plan.
//! - [`inverse`]: an inverse-dynamics policy on a frozen encoder, the baseline without planning.
//! - [`weights`]: pretrained weights, from files and the Hugging Face hub, and for PyTorch.
//! - [`probe`]: how much of the state of an environment the latents contain.
//! - [`checkpoint`]: trained models on disk.
//! - [`device`]: the devices models compute on.

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
pub use train::{TrainConfig, TrainOptions, TrainSummary, Trainable, train};
