//! 3-D worlds on MuJoCo: DeepMind Control, OGBench, Fetch.
//!
//! MuJoCo's library and the models of the worlds are no part of the program: [`assets`] fetches them, [`link`] loads the
//! library when a world first needs it. Tests and programs share one copy of the assets through `SWM_ASSETS`
//! (`SWM_ASSETS=~/.cache/swm/assets` on a developer's machine; `make assets` fills it).

pub mod assets;
mod ffi;
pub mod link;
mod physics;

pub use physics::{Physics, compile, compile_file, shared};
