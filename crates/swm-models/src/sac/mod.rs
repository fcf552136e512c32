//! SAC, soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905): a stochastic policy trained online with an entropy
//! bonus. `swm collect --policy CHECKPOINT` collects demonstrations with a trained policy. See `docs/models/sac.md`.

mod config;
mod cpu_losses;
mod family;
mod model;
pub mod step;
mod train;

pub use config::{SacConfig, SacLoss};
pub use family::ENTRY;
pub use model::{ActionSample, Actor, Critic, Critics, Hidden, Sac};

/// The policy of a SAC. An action is the `tanh` of the actor's mean, or of a sample with exploration.
pub type SacPolicy = crate::online::StochasticPolicy<Sac>;
