//! Writes the images of an episode, then its numeric columns. Committing the numeric columns commits the episode.

use super::reader::FolderReader;
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, Reader as _, WriteOptions, Writer};
use crate::formats::column_files::{ColumnFilesWriter, ImageFiles, SUFFIXES, image_path};
use rayon::prelude::*;
use std::io::Write as _;
use swm_core::{Batch, Error, Result, Schema, files};
use swm_image::ImageCodec;

/// Creates, continues or replaces a dataset of the format `folder`.
pub(super) fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let folder = location.local("folder")?;
    options.codec.check()?;
    let continues = options.continues.clone();
    let known = || {
        let known = FolderReader::open(folder)?;
        continues.iter().try_for_each(|continued| continued.check(&known, &folder.display()))?;
        Ok(known.schema().clone())
    };
    let (incoming, codec) = (schema.clone(), options.codec);
    let make = move |columns| FolderWriter { columns, schema: incoming, codec };
    ColumnFilesWriter::create(folder, schema, options, known, ImageFiles::Images, make, |writer| {
        writer.columns.committed()
    })
}

struct FolderWriter {
    columns: ColumnFilesWriter,
    schema: Schema,
    codec: ImageCodec,
}

impl Writer for FolderWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check_episode(episode, &self.schema)?;
        let episode_index = self.columns.episodes();
        let mut images = self.schema.columns().iter().enumerate().filter(|(_, column)| column.is_image());
        // A failed write deletes the images of its episode, so they must be the writer's own.
        images.clone().try_for_each(|(_, column)| {
            let path = |step| image_path(self.columns.folder(), &column.name, episode_index, step, SUFFIXES[0]);
            (0..episode.rows()).try_for_each(|step| files::check_free(&path(step)))
        })?;
        let written = images.try_for_each(|(index, column)| {
            let (height, width) = (column.shape[0], column.shape[1]);
            let frames = episode.bytes(index).par_chunks_exact(column.row_bytes());
            frames.enumerate().with_max_len(1).try_for_each_init(Vec::new, |bytes, (step, frame)| {
                bytes.clear();
                self.codec.encode(frame, height, width, bytes)?;
                let path = image_path(self.columns.folder(), &column.name, episode_index, step, SUFFIXES[0]);
                let mut file = files::open_to_write(&path, false)?;
                file.write_all(bytes).map_err(|e| Error::io(path, "writing an image", e))
            })
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
