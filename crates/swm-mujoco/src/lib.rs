//! 3-D environments on MuJoCo: DeepMind Control, OGBench and Fetch.
//!
//! MuJoCo's library and the models of the environments are not part of the program: [`assets`] installs them, and
//! [`link`] loads the library when the first environment needs it. The environment variable `SWM_ASSETS` names the
//! folder of the assets, for example `SWM_ASSETS=~/.cache/swm/assets`. *The reference* is the published Python package
//! `stable-worldmodel`, whose environments this crate reproduces.
//!
//! Read [`physics`] (a model and its state), [`render`] (rendering), `env` (the environment shared by all families) and
//! `task` (the trait that a family implements) first, then a family.

pub mod assets;
pub mod dmc;
mod env;
pub mod fetch;
mod ffi;
pub mod link;
pub mod ogbench;
pub mod physics;
pub mod render;
mod task;

pub use physics::Physics;

use swm_core::registry::concat;
use swm_core::{EnvEntry, Registry};

const DMC_AND_FETCH: usize = dmc::ENTRIES.len() + fetch::ENTRIES.len();
const ALL: usize = DMC_AND_FETCH + ogbench::ENTRIES.len();

/// Every environment of this crate.
pub static ENVS: Registry<EnvEntry> = Registry {
    kind: "environment",
    hint: "`swm envs` lists them",
    rows: &concat::<_, ALL>(&concat::<_, DMC_AND_FETCH>(&dmc::ENTRIES, &fetch::ENTRIES), &ogbench::ENTRIES),
};
