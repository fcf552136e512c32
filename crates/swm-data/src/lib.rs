//! Datasets of episodes: writing them while they are collected, and reading clips of them for training.
//!
//! - [`format`](mod@format): the contracts ([`Reader`], [`Writer`], [`Format`]) and the list of formats.
//! - [`lance`]: the default format, which the Python `lance` package and the reference read as well.
//! - [`clip`] and [`loader`]: windows of episodes, shuffled and prefetched as batches.
//! - [`image`]: how pictures are stored.
//! - [`preview`] and [`video`]: frames as pictures and videos for people.
//! - [`stats`]: column statistics.
//! - [`Split`]: which episodes are held out.

pub mod clip;
pub mod format;
pub mod image;
mod jpeg;
pub mod lance;

pub mod loader;
pub mod preview;
mod split;
pub mod stats;
pub mod video;

pub use clip::{ClipSpec, Clips};
pub use format::{
    CommitPolicy, Episode, FORMATS, Format, Reader, StepRange, WriteMode, WriteOptions, Writer, create, open,
};
pub use image::ImageCodec;
pub use loader::{Loader, LoaderConfig};
pub use preview::{Picture, contact_sheet, write_png};
pub use split::{Part, Split};
pub use stats::{ColumnStats, column_stats, split};
pub use video::{integer_scale, write_mp4, write_mp4_scaled};
