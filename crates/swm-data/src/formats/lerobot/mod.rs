//! The format `lerobot`: datasets of Hugging Face's LeRobot, versions 2.1 (read) and 3.0 (read and written).
//!
//! ```text
//! NAME.lerobot/
//!   meta/info.json                                   features, path templates, number of episodes; written last
//!   meta/episodes/chunk-000/file-000.parquet         position of the rows and frames of each episode
//!   meta/tasks.parquet, meta/stats.json
//!   data/chunk-000/file-000.parquet                  numeric columns, one row per step, several episodes per file
//!   videos/KEY/chunk-000/file-000.mp4                frames of the same episodes
//! ```
//!
//! **Names.** As in the reference's adapter, `observation.state` becomes `proprio`, and the first camera in `info.json`
//! becomes `pixels`; all other names, such as `action`, are unchanged. Columns can also be read by their LeRobot names.
//! Datasets written here are read with their original names: images are stored as `observation.images.NAME`, and
//! `proprio` (or `state`, if there is none) as `observation.state`. `episode_index` and `frame_index` become
//! `episode_idx` and `step_idx`. `timestamp`, `index` and `task_index` can be read by name but are not columns, because
//! writers compute them. Text features are not read, except the task, which becomes the episode's constant `task`.
//!
//! **Time.** In LeRobot, the last row of an episode has an action. In this project, the action of the last row is NaN
//! (or -1 for integers). Third-party datasets are read unchanged. Datasets written here repeat the previous action in
//! the last row, so that other programs get no NaN; the reader restores NaN (or -1).
//!
//! **Frames** are located by time: the start time of the episode in the file plus the timestamp of the row. Reading
//! fails if the time of the nearest frame differs by more than a quarter of a frame interval. Opening fails if the ranges of rows
//! or of times that version 3.0 states for each episode contradict its length or each other (`ranges`).
//!
//! [`ImageCodec`](swm_image::ImageCodec) determines the encoding of frames as in the format `video`; use JPEG for
//! datasets that browsers must play.

#[cfg(feature = "lerobot")]
mod checks;
#[cfg(feature = "lerobot")]
mod episode_files;
#[cfg(feature = "lerobot")]
mod features;
#[cfg(feature = "lerobot")]
mod info;
#[cfg(feature = "lerobot")]
mod ranges;
#[cfg(feature = "lerobot")]
mod reader;
#[cfg(feature = "lerobot")]
mod removal;
#[cfg(feature = "lerobot")]
mod stats;
#[cfg(feature = "lerobot")]
mod table;
#[cfg(feature = "lerobot")]
mod values;
#[cfg(feature = "lerobot")]
mod writer;

pub(super) use removal::is_unfinished;

use crate::dataset::Location;
use crate::formats::entry::{Backend, FormatEntry};
use crate::formats::set_aside;

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "lerobot",
    summary: "LeRobot dataset, versions 2.1 (read) and 3.0; a folder with meta/info.json, new ones NAME.lerobot",
    suffixes: &["lerobot"],
    exact_images: false,
    codecs: true,
    feature: Some("lerobot"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "lerobot")]
const BACKEND: Option<Backend> = Some(Backend {
    open: reader::open,
    create: writer::create,
    remove: removal::remove,
    recover: Some(|path| set_aside::recover_unlocked(path, removal::Files)),
});
#[cfg(not(feature = "lerobot"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    ENTRY.has_suffix(location) || path.join("meta").join("info.json").is_file()
}

/// The constant that holds an episode's task.
#[cfg(feature = "lerobot")]
const TASK: &str = "task";
/// The stored task of an episode without a task.
#[cfg(feature = "lerobot")]
const NO_TASK: &str = "unspecified";
/// The column of `meta/episodes` that holds the constants, as JSON.
#[cfg(feature = "lerobot")]
const CONSTANTS: &str = "stable_worldmodel/constants";
