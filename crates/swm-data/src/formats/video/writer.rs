//! Writes the videos of an episode, then its numeric columns. Committing the numeric columns commits the episode.

use super::reader::VideoReader;
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, Reader as _, WriteOptions, Writer};
use crate::formats::column_files::{ColumnFilesWriter, ImageFiles, video_path};
use rayon::prelude::*;
use std::io::Write as _;
use swm_core::{Batch, Error, Result, Schema, files};
use swm_video::{Encoding, encode};

/// Frame rate of written videos, in frames per second: the reference's default.
const FPS: u32 = 25;

/// Creates, continues or replaces a dataset of the format `video`.
pub(super) fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let folder = location.local("video")?;
    options.codec.check()?;
    swm_video::load()?;
    let continues = options.continues.clone();
    let known = || {
        let known = VideoReader::open(folder)?;
        continues.iter().try_for_each(|continued| continued.check(&known, &folder.display()))?;
        Ok(known.schema().clone())
    };
    let (incoming, encoding) = (schema.clone(), Encoding::training(options.codec));
    let make = move |columns| VideoWriter { columns, schema: incoming, encoding };
    ColumnFilesWriter::create(folder, schema, options, known, ImageFiles::Videos, make, |writer| {
        writer.columns.committed()
    })
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
        // A failed write deletes the videos of its episode, so they must be the writer's own.
        let mut cameras = self.schema.columns().iter().filter(|column| column.is_image());
        cameras.try_for_each(|column| files::check_free(&video_path(folder, &column.name, position)))?;
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
