//! TD-MPC2 (Hansen, Su and Wang 2024, arXiv 2310.16828): a latent world model trained to predict future latents,
//! rewards and values, with a policy that initialises plans. See `docs/models/tdmpc2.md`.

pub mod config;
mod cost;
mod family;
pub mod image_encoder;
mod import;
pub mod model;
pub mod planner;
pub mod rollouts;
pub mod step;
mod train;

pub use crate::online::PlannerConfig;
pub use config::{Encoding, LossConfig, Tdmpc2Config};
pub use cost::Tdmpc2Cost;
pub use family::ENTRY;
pub use import::{Published, export, import};
pub use model::{Gaussian, Observation, Tdmpc2};
pub use planner::{Tdmpc2Policy, latent};
pub use rollouts::Rollouts;
