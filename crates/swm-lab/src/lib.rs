//! The lab: a local web application that shows environments, datasets and training runs as they move.
//!
//! - [`serve`](fn@serve): the server. It listens on the loopback address, and answers requests that carry its token only
//!   ([`access`]).
//! - [`still`]: one frame of an environment as PNG, the same bytes as `swm frame` writes.
//! - [`rendering`]: which camera view of an environment is shown, and the wrappers of its frames.
//! - [`session`]: a live environment behind a WebSocket, which a policy or a person drives, and whose episodes can be recorded.
//! - [`plans`]: a live environment that a solver plans in, whose searches are shown, and whose steps are a tree to go back in.
//! - [`datasets`], [`distribution`] and [`runs`]: what the pages of datasets and of training curves show, from [`folders`] and
//!   [`sources`] that the lab was started with, and no other.
//! - [`reports`]: results and studies, and their pages.
//! - [`requests`]: trainings, collections and evaluations that pages ask for. [`processes`]: those that run.
//! - [`assets`]: the pages, built from `web/` and embedded.
//!
//! This crate knows no environment, no model and no policy: [`Lab`] has the registry, and what makes policies and planners.

pub mod access;
mod api;
pub mod assets;
mod connections;
pub mod datasets;
pub mod distribution;
pub mod folders;
pub mod plans;
pub mod processes;
pub mod rendering;
pub mod reports;
pub mod requests;
pub mod runs;
pub mod serve;
pub mod session;
pub mod sources;
pub mod still;

pub use access::{Access, Token};
pub use serve::{Options, Server, serve};

use folders::Folders;
use std::sync::mpsc::Sender;
use swm_core::registry::Registry;
use swm_core::{EnvEntry, Policy, Result};
use swm_eval::World;

/// Makes the policy of this name for the environments of a world: `random`, or an expert.
pub type MakePolicy = fn(&EnvEntry, &str, &World) -> Result<Box<dyn Policy>>;

/// What the lab shows.
pub struct Lab {
    /// The environments.
    pub envs: &'static Registry<EnvEntry>,
    /// The wrappers of their frames.
    pub wrapping: Box<dyn rendering::Wrapping>,
    /// The policies that drive them.
    pub policy: MakePolicy,
    /// The models that plan.
    pub planning: Box<dyn plans::Planning>,
    /// What trains, collects and evaluates.
    pub program: Box<dyn processes::Program>,
    /// What makes pages of results and studies.
    pub reports: Box<dyn reports::Reports>,
    /// Folders of results and studies.
    pub results: Folders,
    /// Folders of datasets. The first receives recorded demonstrations.
    pub datasets: Folders,
    /// Datasets at URIs, which are read only.
    pub sources: Vec<sources::Source>,
    /// Folders of training runs. The first receives those that pages start.
    pub runs: Folders,
    /// Threads of an environment; 0 for one per core.
    pub threads: usize,
    /// Receives what the page of the benchmark measured; `None` unless this is a benchmark.
    pub measured: Option<Sender<serde_json::Value>>,
}
