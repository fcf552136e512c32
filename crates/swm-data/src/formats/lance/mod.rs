//! The default format: Lance tables, read and written with Lance's storage crates, without its query engine.
//!
//! A table has one row per step, and stores episodes one after another. `episode_idx` and `step_idx` are 32-bit
//! integers; images are encoded bytes; every other column is a fixed-size list of `float32` (`float64` for `float64`
//! columns), with one element for a scalar. A `.` in a column name becomes `_`. This is the layout of the reference
//! implementation's `LanceWriter`, so the reference implementation and the Python `lance` package open tables that this
//! module writes, and vice versa. The table's metadata stores the original names, types and shapes; data files store
//! the constants of episodes. Other Lance readers ignore this metadata and the constants.
//!
//! A table is a local folder or a prefix in an object store. Each version is one object that is created only if no
//! object of that name exists, so of two concurrent commits one fails and is retried. Readers and writers need no
//! server besides the store. Several machines write one dataset with [`create_shard`].

mod convert;
mod encode;
mod errors;
mod image_locations;
mod manifest_file;
mod reader;
mod record;
mod removal;
mod salvage;
mod schema;
mod shard;
mod store;
mod table;
mod writer;

pub(super) use removal::is_unfinished;
pub use salvage::salvage;
pub use shard::{Shard, commit_shards, create_shard, shard_manifest, shard_manifests};

use crate::formats::entry::{Backend, FormatEntry};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "lance",
    summary: "Lance table, one folder NAME.lance; opens in Python's lance and lancedb",
    suffixes: &["lance"],
    exact_images: true,
    codecs: true,
    feature: None,
    detect: store::detect,
    backend: Some(Backend { open: reader::open, create: writer::create, remove: removal::remove, recover: None }),
};
