//! The default format: Lance tables, through the crates below Lance's query engine.
//!
//! One row a step, episodes one after another. `episode_idx` and `step_idx` are 32-bit integers, pictures are
//! encoded bytes, every other column is a fixed-size list of `float32` (a scalar is a list of one; columns of `float64`
//! keep their precision), and `.` in a name becomes `_`: the layout of the reference's `LanceWriter`, so its reader and
//! the Python `lance` package open what is written here, and the other way round. The original names, types and shapes
//! are kept in the table's metadata, and what is the same in all steps of an episode in its data file, both of which
//! foreign readers ignore.
//!
//! A table is a folder on this machine, or a prefix in an object store. Every version is one object that is created on
//! the condition that there is none of its name, so of two writers that commit at once one is told to look again.
//! Readers of several machines need nothing but the store; several machines write one dataset with [`create_shard`].

mod convert;
mod encode;
mod image_locations;
mod reader;
mod record;
mod salvage;
mod schema;
mod shard;
mod store;
mod table;
mod writer;

pub use salvage::salvage;
pub use shard::{Shard, commit_shards, create_shard, shard_manifests};

use crate::formats::entry::{Backend, FormatEntry};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "lance",
    summary: "Lance table, one folder NAME.lance; opens in Python's lance and lancedb",
    suffixes: &["lance"],
    feature: None,
    detect: store::looks_like,
    backend: Some(Backend { open: reader::open, create: writer::create }),
};
