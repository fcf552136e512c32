//! World models, policies and their training.
//!
//! Contracts:
//! - [`train`](mod@train): the training loop for every [`Trainable`] model, the training configuration and the logs.
//! - [`family`]: [`ModelFamily`], the contract of a model family; [`registry`]: the families of this build.
//! - [`online`]: training by acting in environments; [`feed_forward`]: policies without planning.
//! - [`probe`]: regression of the environment state from frozen latents.
//! - [`checkpoint`]: trained models on disk; [`run_folder`]: the files of a training run; [`capsule`]: a trained model in
//!   one file; [`stored`]: both as the parts of a checkpoint; [`store`]: checkpoints that another program trained.
//! - [`weights`]: pretrained weights, and weight files for PyTorch.
//!
//! Building blocks: [`nn`], with PyTorch's parameter names; [`pixels`], the normalisation of images; [`device`].
//!
//! Model families, one module per group of related families:
//! - [`lewm`] (LeWM) and [`pldm`] (PLDM): world models with a latent per frame.
//! - [`dino_wm`] (DINO-WM): a world model that predicts the patch features of a frozen encoder.
//! - [`tdmpc2`] (TD-MPC2): a world model that predicts rewards and values; [`sac`]: soft actor-critic.
//! - [`gcrl`] (GCBC, GCIVL, GCIQL): goal-conditioned policies from offline data.
//! - [`inverse`]: an inverse-dynamics policy on the encoder of another checkpoint.

pub mod capsule;
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
pub mod run_folder;
pub mod sac;
pub mod store;
pub mod stored;
pub mod tdmpc2;
mod tensor_file;
pub mod train;
pub mod weights;

pub use burn::tensor::Device;
pub use checkpoint::Checkpoint;
pub use family::{CheckpointInfo, FamilyEntry, LoadedModel, ModelFamily, OnlineRun, TrainRun, TrainableConfig};
pub use registry::{FAMILIES, dataset_requirements, load, load_from, load_stored};
pub use stored::StoredCheckpoint;
pub use train::{TrainConfig, TrainOptions, TrainSummary, Trainable, train};
