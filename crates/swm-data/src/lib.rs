//! Datasets of episodes: writing them during collection, and reading clips of them for training.
//!
//! - [`dataset`]: the contracts [`Reader`] and [`Writer`], and the code that uses them: clips, goals, [`Loader`],
//!   cache, [`ReplayBuffer`], [`Split`], statistics, views, [`Location`]. This module does not depend on any format.
//! - [`formats`]: a module for each format on disk, and the registry [`FORMATS`]. [`lance`] is the default.
//! - [`hub`]: datasets and checkpoints of the Hugging Face hub.
//! - [`tools`]: [`convert`](mod@convert) between formats, [`doctor`], [`preview`](mod@preview).

pub mod dataset;
pub mod formats;
#[cfg(feature = "hub")]
pub mod hub;
pub mod tools;

pub use dataset::{
    BatchSlice, CacheConfig, ClipSpec, Clips, ColumnStats, CommitPolicy, Constants, Continued, Episode, Epoch,
    GoalMixture, GoalSpec, Irregularity, LoadedBatch, Loader, LoaderConfig, Location, Mark, Part, Reader, ReplayBuffer,
    ReplayConfig, ReplayLoader, Split, StepRange, WriteMode, WriteOptions, Writer, check_storable, column_quantiles,
    column_stats, goals, objects, views,
};
pub use formats::{FORMATS, FormatEntry, create, has_no_dataset, lance, open, recover};
pub use swm_image::{self as image, ImageCodec, RgbImage, check_png, write_png};
pub use tools::convert::{self, ConvertMode, ConvertOptions, Converted, checksum, convert, convert_shard};
pub use tools::doctor;
pub use tools::frequent_colours;
pub use tools::preview::{
    self, PreviewOptions, check_mp4, contact_sheet, integer_scale, preview, write_mp4, write_mp4_scaled,
};
