//! TD-MPC2 (Hansen, Su and Wang 2024, arXiv 2310.16828): a latent world model that is trained to predict its own latents,
//! rewards and values, with a policy that plans start from. See `docs/models/tdmpc2.md`.

pub mod config;
mod cost;
pub mod eyes;
mod import;
pub mod model;
pub mod planner;
pub mod rollouts;
pub mod step;
mod train;

pub use config::{Encoding, LossConfig, Tdmpc2Config};
pub use cost::Tdmpc2Cost;
pub use import::{Published, export, import};
pub use model::{Gaussian, Observation, Tdmpc2};
pub use planner::{PlannerConfig, Tdmpc2Policy};
pub use rollouts::Rollouts;
