//! Writes the videos of an episode, then its numeric columns. Committing the numeric columns commits the episode.

use super::reader::VideoReader;
use super::video_path;
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, Reader as _, WriteMode, WriteOptions, Writer};
use crate::formats::column_files::{ColumnFilesWriter, exists};
use rayon::prelude::*;
use std::path::Path;
use swm_core::{Batch, Error, Result, Schema};
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
    let columns = ColumnFilesWriter::create(folder, schema, &options, known.as_ref())?;
    for column in schema.columns().iter().filter(|column| column.is_image()) {
        prepare(&folder.join(&column.name), columns.episodes())?;
    }
    Ok(Box::new(VideoWriter { columns, schema: schema.clone(), encoding: Encoding::training(options.codec) }))
}

/// Creates the folder of an image column and removes videos of uncommitted episodes.
fn prepare(folder: &Path, episodes: usize) -> Result<()> {
    let io = |e| Error::io(folder, "preparing the folder", e);
    std::fs::create_dir_all(folder).map_err(io)?;
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let episode = name.strip_prefix("ep_").and_then(|name| name.strip_suffix(".mp4")?.parse::<usize>().ok());
        if name.ends_with(TEMPORARY_SUFFIX) || episode.is_some_and(|episode| episode >= episodes) {
            std::fs::remove_file(entry.path()).map_err(io)?;
        }
    }
    Ok(())
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
        images.try_for_each(|(index, column)| {
            let frames = episode.bytes(index).chunks_exact(column.row_bytes());
            let bytes = encode(column.shape[1], column.shape[0], FPS, self.encoding, frames)?;
            let path = video_path(folder, &column.name, position);
            let temporary = path.with_extension(&TEMPORARY_SUFFIX[1..]);
            let io = |e| Error::io(&path, "writing a video", e);
            std::fs::write(&temporary, bytes).map_err(io)?;
            std::fs::rename(&temporary, &path).map_err(io)
        })?;
        self.columns.write(episode, constants)
    }

    fn episodes(&self) -> usize {
        self.columns.episodes()
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.columns.finish()
    }
}
