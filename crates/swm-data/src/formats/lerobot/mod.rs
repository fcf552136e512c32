//! The format `lerobot`: datasets of Hugging Face's LeRobot, versions 2.1 (read) and 3.0 (read and written).
//!
//! ```text
//! NAME.lerobot/
//!   meta/info.json                                   features, names of files, how many episodes; the commit
//!   meta/episodes/chunk-000/file-000.parquet         where the rows and frames of each episode are
//!   meta/tasks.parquet, meta/stats.json
//!   data/chunk-000/file-000.parquet                  numbers, a row a step, several episodes in a file
//!   videos/KEY/chunk-000/file-000.mp4                frames of the same episodes
//! ```
//!
//! **Names.** As in the reference's adapter, `observation.state` is called `proprio`, and the first camera of
//! `info.json` is called `pixels`; `action` keeps its name, and so does everything else. Reading by the native name works
//! as well. What was written here comes back under the names it was given: pictures are stored as
//! `observation.images.NAME`, `proprio` (or `state`, where there is none) as `observation.state`. `episode_index` and
//! `frame_index` are our `episode_idx` and `step_idx`; `timestamp`, `index` and `task_index` are read by name, but are no
//! columns, as every writer counts anew. Text is not read, but for the task, which is the episode's
//! constant `task`.
//!
//! **Time.** LeRobot's last row has an action, ours has none. Foreign datasets are read as they are. In ours the action
//! before is repeated in the file, so that whoever trains on it meets no NaN; reading it here gives NaN (or -1) again.
//!
//! **Frames** are found by time: that of the row after that of the episode's beginning in the file. A frame further away
//! than a quarter of a frame is an error.
//!
//! How pictures are stored follows from [`ImageCodec`](swm_image::ImageCodec) as in the format `video`; choose JPEG for
//! datasets that browsers should play.

#[cfg(feature = "lerobot")]
mod episode_files;
#[cfg(feature = "lerobot")]
mod features;
#[cfg(feature = "lerobot")]
mod info;
#[cfg(feature = "lerobot")]
mod reader;
#[cfg(feature = "lerobot")]
mod stats;
#[cfg(feature = "lerobot")]
mod table;
#[cfg(feature = "lerobot")]
mod values;
#[cfg(feature = "lerobot")]
mod writer;

use crate::dataset::Location;
use crate::formats::entry::{Backend, FormatEntry};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "lerobot",
    summary: "LeRobot dataset, versions 2.1 (read) and 3.0; a folder with meta/info.json, new ones NAME.lerobot",
    suffixes: &["lerobot"],
    feature: Some("lerobot"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "lerobot")]
const BACKEND: Option<Backend> = Some(Backend { open: reader::open, create: writer::create });
#[cfg(not(feature = "lerobot"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    ENTRY.has_suffix(location) || path.join("meta").join("info.json").is_file()
}

/// The constant that holds an episode's task.
#[cfg(feature = "lerobot")]
const TASK: &str = "task";
/// What an episode without a task is filed under.
#[cfg(feature = "lerobot")]
const NO_TASK: &str = "unspecified";
/// The column of `meta/episodes` that holds our constants, as JSON.
#[cfg(feature = "lerobot")]
const CONSTANTS: &str = "stable_worldmodel/constants";
