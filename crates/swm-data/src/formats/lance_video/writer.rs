//! Writing: an episode's videos are made first and travel with its numbers, in one commit.

use super::{SCHEMA, VIDEO, table};
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, WriteMode, WriteOptions, Writer};
use crate::formats::lance;
use rayon::prelude::*;
use swm_core::{Batch, ColumnSpec, Error, Result, Schema};
use swm_video::{Encoding, encode};

/// Frames a second that players show.
const FPS: u32 = 25;

/// Bytes of a data file at most, unless one episode has more: whoever wants one video reads as much.
const DATA_FILE: usize = 4 << 20;

/// Creates, continues or replaces a folder.
pub(super) fn create(location: &Location, schema: &Schema, mut options: WriteOptions) -> Result<Box<dyn Writer>> {
    options.codec.check()?;
    let place = table(location)?;
    let columns: Vec<ColumnSpec> = schema.columns().iter().filter(|column| !column.is_image()).cloned().collect();
    if columns.iter().all(|column| column.name == episodes::EPISODE || column.name == episodes::STEP) {
        let fix = "add one, or use the format video";
        return Err(Error::config("schema", "the format lance-video needs a column of numbers", fix));
    }
    if options.mode == WriteMode::Append
        && let Ok(known) = super::reader::open(location)
        && !known.episodes().is_empty()
    {
        episodes::check_continued(location, schema, known.schema())?;
    }
    let encoding = Encoding::training(options.codec);
    options.commit.bytes = options.commit.bytes.min(DATA_FILE);
    let numbers = Schema::new(columns)?;
    let listed = serde_json::to_vec(schema).map_err(|e| Error::external("describing the dataset", e))?;
    let writer = lance::ENTRY.create(&place, &numbers, options)?;
    Ok(Box::new(LanceVideoWriter { writer, numbers, listed, schema: schema.clone(), encoding }))
}

struct LanceVideoWriter {
    writer: Box<dyn Writer>,
    /// The columns of the table.
    numbers: Schema,
    /// All columns, as JSON.
    listed: Vec<u8>,
    schema: Schema,
    encoding: Encoding,
}

impl Writer for LanceVideoWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check(episode, &self.schema)?;
        if let Some(name) = constants.keys().find(|name| *name == SCHEMA || name.starts_with(VIDEO)) {
            return Err(Error::config(
                "episode constant",
                format!("the name {name} is used by the format"),
                "rename it",
            ));
        }
        let pictures = self.schema.columns().par_iter().enumerate().filter(|(_, column)| column.is_image());
        let videos: Result<Constants> = pictures
            .map(|(index, column)| {
                let frames = episode.bytes(index).chunks_exact(column.row_bytes());
                let bytes = encode(column.shape[1], column.shape[0], FPS, self.encoding, frames)?;
                Ok((format!("{VIDEO}{}", column.name), bytes))
            })
            .collect();
        let mut all = videos?;
        all.extend(constants.clone());
        all.insert(SCHEMA.to_owned(), self.listed.clone());
        let mut numbers = Batch::zeros(&self.numbers, episode.rows());
        for (i, column) in self.numbers.columns().iter().enumerate() {
            numbers.bytes_mut(i).copy_from_slice(episode.bytes(self.schema.index(&column.name)?));
        }
        self.writer.write_episode_with(&numbers, &all)
    }

    fn episodes(&self) -> usize {
        self.writer.episodes()
    }

    fn finish(self: Box<Self>) -> Result<()> {
        self.writer.finish()
    }
}
