//! The default format: Lance tables, through the crates below Lance's query engine.
//!
//! One row a step, episodes one after another. `episode_idx` and `step_idx` are 32-bit integers, pictures are
//! encoded bytes, every other column is a fixed-size list of `float32` (a scalar is a list of one), and `.` in
//! a name becomes `_`: the layout of the reference's `LanceWriter`, so its reader and the Python `lance`
//! package open what is written here, and the other way round. The original names, types and shapes are kept
//! in the table's metadata, which foreign readers ignore.

mod convert;
mod reader;
mod schema;
mod store;
mod writer;

use crate::format::Format;

/// The registry row.
pub const FORMAT: Format = Format {
    id: "lance",
    summary: "Lance table, one folder NAME.lance; opens in Python's lance and lancedb",
    detect: store::looks_like,
    open: reader::open,
    create: writer::create,
};
