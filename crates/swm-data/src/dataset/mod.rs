//! Datasets of episodes, independent of their format on disk.
//!
//! The contracts are [`Reader`] and [`Writer`]. All other modules use these contracts: clips, goals, the loader, the
//! cache, the replay buffer, splits, statistics and views. No file in this folder depends on a format.

pub mod cache;
pub mod clips;
pub(crate) mod episodes;
pub mod goals;
mod identity;
pub mod loader;
mod location;
mod mark;
pub mod objects;
mod reader;
pub mod replay;
mod split;
pub mod stats;
mod sync;
pub mod views;
mod writer;

pub use cache::CacheConfig;
pub use clips::{ClipSpec, Clips};
pub use episodes::check_storable;
pub use goals::{GoalMixture, GoalSpec};
pub use loader::{BatchSlice, Epoch, LoadedBatch, Loader, LoaderConfig};
pub use location::Location;
pub use mark::Mark;
pub use reader::{Constants, Episode, Irregularity, Reader, StepRange};
pub use replay::{ReplayBuffer, ReplayConfig, ReplayLoader};
pub use split::{Part, Split};
pub use stats::{ColumnStats, column_quantiles, column_stats};
pub use writer::{CommitPolicy, Continued, WriteMode, WriteOptions, Writer};
pub(crate) use writer::{is_full, with_stored};
