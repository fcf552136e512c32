//! Any Gymnasium environment as an [`swm_core::Env`].
//!
//! A small Python class, [`BRIDGE`], finds out what an environment is and writes what it produces into one flat buffer.
//! Somebody holds that buffer and passes requests on: a [`Transport`]. [`WorkerTransport`] starts a Python process for
//! each environment and shares memory with it; a Python extension can drive the same class in its own interpreter.
//! [`GymEnv`] is the world itself, over any transport. [`choose`] reads what users type, `ALE/Pong-v5,frameskip=2`.
//!
//! `docs/gymnasium.md` says what becomes of observations, `info`, factors of variation, goals and pictures.

pub mod assets;
mod choose;
mod config;
mod describe;
mod env;
mod recorded;
mod transport;
mod worker;

pub use choose::{EXAMPLES, choose, looks_foreign, make};
pub use config::{GymConfig, Python};
pub use describe::{Description, Form};
pub use env::GymEnv;
pub use transport::{Failure, Request, Transport};
pub use worker::WorkerTransport;

/// The Python module that turns an environment into a buffer: `Bridge(env)` around one that exists, `make(id, options)`
/// by id.
pub const BRIDGE: &str = include_str!("../python/bridge.py");

/// The Python module with Craftax's environments; [`BRIDGE`] imports it as `swm_craftax`.
pub const CRAFTAX: &str = include_str!("../python/craftax.py");

/// The program of a worker process.
const WORKER: &str = include_str!("../python/worker.py");
