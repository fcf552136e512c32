//! MuJoCo models and simulation states.
//!
//! A model is compiled once per process ([`shared_model`]) and copied for every environment. An environment edits its
//! copy to apply factors of variation; [`Physics::restore_model`] undoes all edits.
//!
//! **Instability.** When a simulation diverges, MuJoCo resets the state and continues. On an internal error, MuJoCo
//! ends the process by default; this crate resets the state instead. Both cases set [`Physics::is_unstable`] until the
//! next reset, and the environment terminates the episode.

mod appearance;
mod compile;
mod hooks;
mod simulation;
mod snapshot;
mod state_layout;
mod stepping;

pub(crate) use appearance::Appearance;
pub(crate) use compile::edit_welds;
pub use compile::{COMPILATION_BYTES, compile_file, compile_spec, compile_xml, index_of, shared_model};
pub(crate) use hooks::{EqualityRow, GeomPoses, StepHooks};
pub use simulation::Physics;
pub(crate) use state_layout::check_finite;
pub use state_layout::state_len;
