//! Writes the videos of an episode, then its numeric columns. Committing the numeric columns commits the episode.

use super::reader::VideoReader;
use super::video_path;
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, Reader as _, WriteMode, WriteOptions, Writer};
use crate::formats::column_files::{ColumnFilesWriter, exists};
use rayon::prelude::*;
use std::io::Write as _;
use std::path::Path;
use swm_core::{Batch, Error, Result, Schema, files};
use swm_video::{Encoding, encode};

/// Frame rate of written videos, in frames per second: the reference's default.
const FPS: u32 = 25;

/// Creates, continues or replaces a dataset of the format `video`.
pub(super) fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let folder = location.local("video")?;
    options.codec.check()?;
    let known = if options.mode == WriteMode::Append && exists(folder) {
        Some(VideoReader::open(folder)?.schema().clone())
    } else {
        None
    };
    let columns = ColumnFilesWriter::create(folder, schema, &options, known.as_ref(), discard)?;
    Ok(Box::new(VideoWriter { columns, schema: schema.clone(), encoding: Encoding::training(options.codec) }))
}

/// Deletes the videos of all episodes from `from` on, in the folder of an image column.
fn discard(folder: &Path, from: usize) -> Result<()> {
    let io = |e| Error::io(folder, "deleting videos of uncommitted episodes", e);
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let is_video = entry.file_type().map_err(io)?.is_file();
        if is_video && entry.file_name().to_str().and_then(episode_of).is_some_and(|episode| episode >= from) {
            files::delete_file(&entry.path())?;
        }
    }
    Ok(())
}

/// The episode in the name of a video or of an incomplete video.
fn episode_of(name: &str) -> Option<usize> {
    let name = name.strip_suffix(TEMPORARY_SUFFIX).or_else(|| name.strip_suffix(".mp4"))?;
    name.strip_prefix("ep_")?.parse().ok()
}

/// Suffix of incomplete videos.
const TEMPORARY_SUFFIX: &str = ".mp4.tmp";

struct VideoWriter {
    columns: ColumnFilesWriter,
    schema: Schema,
    encoding: Encoding,
}

impl Writer for VideoWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check_episode(episode, &self.schema)?;
        let (folder, position) = (self.columns.folder(), self.columns.episodes());
        let images = self.schema.columns().par_iter().enumerate().filter(|(_, column)| column.is_image());
        let written = images.try_for_each(|(index, column)| {
            let frames = episode.bytes(index).chunks_exact(column.row_bytes());
            let bytes = encode(column.shape[1], column.shape[0], FPS, self.encoding, frames)?;
            let path = video_path(folder, &column.name, position);
            let temporary = path.with_extension(&TEMPORARY_SUFFIX[1..]);
            let io = |e| Error::io(&path, "writing a video", e);
            files::open_to_write(&temporary, false)?.write_all(&bytes).map_err(io)?;
            std::fs::rename(&temporary, &path).map_err(io)
        });
        written.map_err(|error| self.columns.fail(error))?;
        self.columns.write(episode, constants)
    }

    fn episodes(&self) -> usize {
        self.columns.episodes()
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.columns.finish()
    }
}
