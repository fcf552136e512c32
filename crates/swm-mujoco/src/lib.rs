//! 3-D worlds on MuJoCo: DeepMind Control, OGBench, Fetch.
//!
//! MuJoCo's library and the models of the worlds are no part of the program: [`assets`] fetches them, [`link`] loads the
//! library when a world first needs it. Tests and programs share one copy of the assets through `SWM_ASSETS`
//! (`SWM_ASSETS=~/.cache/swm/assets` on a developer's machine).
//!
//! Read [`physics`] (a model and its state), [`render`] (its picture), [`env`] (what all worlds share), and then a family.

pub mod assets;
pub mod dmc;
mod env;
pub mod fetch;
mod ffi;
pub mod link;
pub mod ogbench;
pub mod physics;
pub mod render;

pub use physics::Physics;

use swm_core::registry::join;
use swm_core::{EnvEntry, Registry};

const TWO: usize = dmc::ENTRIES.len() + fetch::ENTRIES.len();
const THREE: usize = TWO + ogbench::ENTRIES.len();

/// Every environment of this crate.
pub static ENVS: Registry<EnvEntry> = Registry {
    kind: "environment",
    hint: "`swm envs` lists them",
    rows: &join::<_, THREE>(&join::<_, TWO>(&dmc::ENTRIES, &fetch::ENTRIES), &ogbench::ENTRIES),
};
