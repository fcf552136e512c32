//! Model families: the contract of a family, and type-erased forms for programs that choose a family at run time.
//!
//! A family implements [`ModelFamily`] in its own folder, builds a [`FamilyEntry`] from it, and adds the entry to
//! [`registry`](crate::registry).

mod config;
mod contract;
mod entry;
mod loaded;

pub use config::TrainableConfig;
pub use contract::{ModelFamily, OnlineRun, TrainRun};
pub use entry::FamilyEntry;
pub use loaded::{CheckpointInfo, LoadedModel};
