//! Writes episodes to the table, with the videos as constants of their episode.

use super::{ENTRY, SCHEMA, VIDEO, table};
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, WriteMode, WriteOptions, Writer};
use crate::formats::lance;
use rayon::prelude::*;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, Error, Result, Schema};
use swm_video::{Encoding, encode};

/// Frame rate of the videos, in frames per second.
const FPS: u32 = 25;

/// Maximum size of a data file in bytes, unless one episode is larger. Reading one video reads all constants of its
/// data file.
const MAX_DATA_FILE_BYTES: usize = 4 << 20;

/// Creates, continues or replaces a dataset.
pub(super) fn create(location: &Location, schema: &Schema, mut options: WriteOptions) -> Result<Box<dyn Writer>> {
    options.codec.check()?;
    ENTRY.check_suffix(location)?;
    swm_video::load()?;
    let table_location = table(location)?;
    let columns: Vec<ColumnSpec> = schema.columns().iter().filter(|column| !column.is_image()).cloned().collect();
    if columns.iter().all(|column| column.name == EPISODE_IDX || column.name == STEP_IDX) {
        let fix = "add a numeric column, or use the format video";
        return Err(Error::config("schema", "the format lance-video needs a numeric column", fix));
    }
    if options.mode == WriteMode::Append
        && let Ok(known) = super::reader::open(location)
        && !known.episodes().is_empty()
    {
        episodes::check_appendable(location, schema, known.schema())?;
    }
    let encoding = Encoding::training(options.codec);
    options.commit.bytes = options.commit.bytes.min(MAX_DATA_FILE_BYTES);
    let steps = Schema::new(columns)?;
    let listed = serde_json::to_vec(schema).map_err(|e| Error::external("describing the dataset", e))?;
    let writer = lance::ENTRY.create(&table_location, &steps, options)?;
    Ok(Box::new(LanceVideoWriter { writer, steps, listed, schema: schema.clone(), encoding }))
}

struct LanceVideoWriter {
    writer: Box<dyn Writer>,
    /// The columns of the table.
    steps: Schema,
    /// The full schema as JSON.
    listed: Vec<u8>,
    schema: Schema,
    encoding: Encoding,
}

impl Writer for LanceVideoWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check_episode(episode, &self.schema)?;
        if let Some(name) = constants.keys().find(|name| *name == SCHEMA || name.starts_with(VIDEO)) {
            return Err(Error::config(
                "episode constant",
                format!("the name {name} is reserved by the format"),
                "rename it",
            ));
        }
        let images = self.schema.columns().par_iter().enumerate().filter(|(_, column)| column.is_image());
        let videos: Result<Constants> = images
            .map(|(index, column)| {
                let frames = episode.bytes(index).chunks_exact(column.row_bytes());
                let bytes = encode(column.shape[1], column.shape[0], FPS, self.encoding, frames)?;
                Ok((format!("{VIDEO}{}", column.name), bytes))
            })
            .collect();
        let mut all = videos?;
        all.extend(constants.clone());
        all.insert(SCHEMA.to_owned(), self.listed.clone());
        let mut steps = Batch::zeros(&self.steps, episode.rows());
        for (i, column) in self.steps.columns().iter().enumerate() {
            steps.bytes_mut(i).copy_from_slice(episode.bytes(self.schema.index(&column.name)?));
        }
        self.writer.write_episode_with(&steps, &all)
    }

    fn episodes(&self) -> usize {
        self.writer.episodes()
    }

    fn finish(self: Box<Self>) -> Result<()> {
        self.writer.finish()
    }

    fn pause(self: Box<Self>) -> Result<()> {
        self.writer.pause()
    }
}
