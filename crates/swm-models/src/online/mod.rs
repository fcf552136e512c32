//! Online training: interaction with environments alternates with optimizer steps, in one process.
//!
//! A round is one step of every environment, then [`OnlineConfig::updates`] optimizer steps. Transitions go to a replay
//! buffer, segment by segment of an episode, and batches are drawn from the buffer uniformly. The seed determines a
//! run: the seed and the index of an episode determine the episode; the seed, the index of an optimizer step and the
//! content of the buffer determine a batch. Results depend neither on the number of threads nor on the speed of the
//! machine.
//!
//! Value targets bootstrap from the next state unless `terminated` is set, also if the time limit truncates the
//! episode.

mod agent;
mod collector;
mod config;
mod evaluation;
mod planner_config;
mod run;
mod shared_model;
mod stochastic_policy;

pub(crate) use agent::check_rewards;
pub use agent::{Agent, AgentPolicy, policy};
pub use config::OnlineConfig;
pub use planner_config::PlannerConfig;
pub use run::{OnlineSummary, train_online};
pub use shared_model::SharedModel;
pub use stochastic_policy::{StochasticActor, StochasticPolicy};
