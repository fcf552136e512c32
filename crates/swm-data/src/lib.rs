//! Datasets of episodes: writing them while they are collected, and reading clips of them for training.
//!
//! - [`format`](mod@format): the contracts ([`Reader`], [`Writer`], [`Format`]) and the list of formats.
//! - [`lance`]: the default format, which the Python `lance` package and the reference read as well.
//! - [`clip`], [`goals`] and [`loader`]: windows of episodes and where they lead, shuffled and prefetched as batches;
//!   [`cache`]: decoded rows kept for the next epoch.
//! - [`convert`](mod@convert): from any format to any other, resumed and verified.
//! - [`doctor`]: what is wrong with a dataset, and which models it can train.
//! - [`views`]: datasets made of datasets; [`replay`]: the latest episodes of a running collection.
//! - [`image`]: the codecs of stored frames.
//! - [`preview`](mod@preview): frames as pictures and videos for people.
//! - [`stats`]: column statistics.
//! - [`Split`]: which episodes are held out.

pub mod cache;
pub mod clip;
mod column_files;
pub mod convert;
pub mod doctor;
mod episodes;
mod ffmpeg;
pub mod folder;
pub mod format;
pub mod goals;
#[cfg(feature = "hdf5")]
pub mod hdf5;
pub mod lance;
mod lance_video;
mod lerobot;
pub mod loader;
mod location;
mod numbers;
pub mod objects;
pub mod preview;
pub mod replay;
mod split;
pub mod stats;
mod video;
pub mod views;

pub use cache::CacheConfig;
pub use clip::{ClipSpec, Clips};
pub use convert::{ConvertMode, ConvertOptions, Converted, checksum, convert};
pub use format::{
    CommitPolicy, Constants, Episode, FORMATS, Format, Irregularity, Reader, StepRange, WriteMode, WriteOptions,
    Writer, create, open,
};
pub use goals::{GoalMixture, GoalSpec};
pub use loader::{Epoch, Loaded, Loader, LoaderConfig};
pub use location::Location;
pub use preview::{PreviewOptions, contact_sheet, integer_scale, preview, write_mp4, write_mp4_scaled};
pub use replay::{ReplayBuffer, ReplayConfig, ReplayLoader};
pub use split::{Part, Split};
pub use stats::{ColumnStats, column_quantiles, column_stats, split};
pub use swm_image::{self as image, ImageCodec, RgbImage, write_png};
