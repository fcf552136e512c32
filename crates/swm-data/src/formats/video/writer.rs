//! Writing: an episode's videos first, then its numbers, which commit it.

use super::file;
use super::reader::VideoReader;
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, Reader as _, WriteMode, WriteOptions, Writer};
use crate::formats::column_files::{ColumnFilesWriter, is_there};
use rayon::prelude::*;
use std::path::Path;
use swm_core::{Batch, Error, Result, Schema};
use swm_video::{Encoding, encode};

/// Frames a second that players show; the reference's default.
const FPS: u32 = 25;

/// Creates, continues or replaces a folder of videos.
pub(super) fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let folder = location.local("video")?;
    options.codec.check()?;
    let known = if options.mode == WriteMode::Append && is_there(folder) {
        Some(VideoReader::open(folder)?.schema().clone())
    } else {
        None
    };
    let numbers = ColumnFilesWriter::create(folder, schema, &options, known.as_ref())?;
    for column in schema.columns().iter().filter(|column| column.is_image()) {
        prepare(&folder.join(&column.name), numbers.episodes())?;
    }
    Ok(Box::new(VideoWriter { numbers, schema: schema.clone(), encoding: Encoding::training(options.codec) }))
}

/// Makes the folder of a column of pictures, and removes videos of episodes that were never committed.
fn prepare(folder: &Path, episodes: usize) -> Result<()> {
    let io = |e| Error::io(folder, "preparing the folder", e);
    std::fs::create_dir_all(folder).map_err(io)?;
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let episode = name.strip_prefix("ep_").and_then(|name| name.strip_suffix(".mp4")?.parse::<usize>().ok());
        if name.ends_with(PASSING) || episode.is_some_and(|episode| episode >= episodes) {
            std::fs::remove_file(entry.path()).map_err(io)?;
        }
    }
    Ok(())
}

/// How the names of videos end that are being written.
const PASSING: &str = ".mp4.tmp";

struct VideoWriter {
    numbers: ColumnFilesWriter,
    schema: Schema,
    encoding: Encoding,
}

impl Writer for VideoWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check(episode, &self.schema)?;
        let (folder, number) = (self.numbers.folder(), self.numbers.episodes());
        let pictures = self.schema.columns().par_iter().enumerate().filter(|(_, column)| column.is_image());
        pictures.try_for_each(|(index, column)| {
            let frames = episode.bytes(index).chunks_exact(column.row_bytes());
            let bytes = encode(column.shape[1], column.shape[0], FPS, self.encoding, frames)?;
            let path = file(folder, &column.name, number);
            let passing = path.with_extension(&PASSING[1..]);
            let io = |e| Error::io(&path, "writing a video", e);
            std::fs::write(&passing, bytes).map_err(io)?;
            std::fs::rename(&passing, &path).map_err(io)
        })?;
        self.numbers.write(episode, constants)
    }

    fn episodes(&self) -> usize {
        self.numbers.episodes()
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.numbers.finish()
    }
}
