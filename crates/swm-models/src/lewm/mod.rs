//! LeWM (LeWorldModel): an encoder and a predictor trained end to end to predict the next latent, with [SIGReg](loss)
//! against collapse. See `docs/models/lewm.md`.

pub mod config;
pub mod cost;
mod device_rollout;
mod family;
mod gradient;
pub mod host_encoder;
pub mod import;
pub(crate) mod joint;
pub mod loss;
pub mod model;
pub mod pixels;
mod prediction;
mod predictor;
pub mod rollout;
pub(crate) mod shard;
pub mod step;
pub(crate) mod train;

pub use config::{DecoderConfig, EncoderConfig, LewmConfig};
pub use cost::LewmCost;
pub use family::ENTRY;
pub(crate) use family::encode;
pub use model::{Encoder, Lewm};
pub use predictor::LewmPredictor;
pub use rollout::Rollout;
