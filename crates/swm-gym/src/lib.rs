//! Any Gymnasium environment as an [`swm_core::Env`].
//!
//! A Python class, `Bridge` in [`BRIDGE`], describes an environment and writes its outputs into one flat buffer. A
//! [`Transport`] holds that buffer and forwards requests: [`WorkerTransport`] starts a Python process for each
//! environment and shares memory with it, and the Python package runs the same class in its own interpreter. [`GymEnv`]
//! is the environment, over any transport. [`choose`] parses ids such as `ALE/Pong-v5,frameskip=2`.
//!
//! `docs/gymnasium.md` documents how observations, `info`, factors of variation, goals and frames are mapped.

mod answer;
pub mod assets;
mod choose;
mod config;
mod dataset_start;
mod describe;
mod env;
mod episode;
mod finite;
mod id;
mod interned;
mod reset_arguments;
mod tail;
mod transport;
mod worker;

pub use choose::{EXAMPLES, choose, is_gymnasium_id, make};
pub use config::{GymConfig, Python};
pub use describe::{Description, EnvLayout};
pub use env::GymEnv;
pub use id::TrustedId;
pub use transport::{Failure, Request, Transport};
pub use worker::WorkerTransport;

/// The Python module of the bridge: `Bridge(env)` wraps an environment, `make(id, options)` makes and wraps one.
pub const BRIDGE: &str = include_str!("../python/bridge.py");

/// The Python module of Craftax's environments; [`BRIDGE`] imports it as `swm_craftax`.
pub const CRAFTAX: &str = include_str!("../python/craftax.py");

/// The program of a worker process.
const WORKER: &str = include_str!("../python/worker.py");
