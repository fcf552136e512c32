//! SAC, soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905): a stochastic policy that is paid for entropy, learnt by
//! playing. Its use here is to demonstrate: `swm collect --policy CHECKPOINT`. See `docs/models/sac.md`.

mod config;
mod family;
mod model;
pub mod step;
mod train;

pub use config::{SacConfig, SacLoss};
pub use family::ENTRY;
pub use model::{Actor, Critic, Critics, Drawn, Hidden, Sac};

/// Acts as a trained SAC does: the mean of its policy, squashed.
pub type SacPolicy = crate::online::StochasticPolicy<Sac>;
