//! Reads numeric columns from the table, and frames from the videos among the constants of the episodes.

use super::{SCHEMA, VIDEO, table};
use crate::dataset::Location;
use crate::dataset::episodes::EpisodeRows;
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::formats::lance;
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema};
use swm_video::{Source, VideoCache};

/// Opens a dataset.
pub(super) fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    let steps = lance::ENTRY.open(&table(location)?)?;
    swm_video::load()?;
    let schema = match steps.episodes() {
        [] => steps.schema().clone(),
        _ => {
            let constants = steps.constants(0)?;
            let listed = constants.get(SCHEMA).and_then(|bytes| serde_json::from_slice::<Schema>(bytes).ok());
            let listed = listed.ok_or_else(|| damaged(location, "its first episode does not list the columns"))?;
            full_schema(steps.schema(), &listed)?
        }
    };
    let mut rows = EpisodeRows::default();
    steps.episodes().iter().for_each(|episode| rows.push(episode.length));
    Ok(Arc::new(LanceVideoReader { label: location.label(), steps, schema, rows, videos: VideoCache::default() }))
}

fn damaged(location: &Location, problem: &str) -> Error {
    Error::corrupt(location.label(), problem, "restore it from a copy, or rebuild the dataset")
}

/// The schema for readers: index columns, then the columns in the order in which they were written.
fn full_schema(steps: &Schema, listed: &Schema) -> Result<Schema> {
    let mut columns: Vec<ColumnSpec> = steps.columns().iter().take(2).cloned().collect();
    for column in listed.columns() {
        if column.is_image() {
            columns.push(column.clone());
        } else if let Some(index) = steps.find(&column.name).filter(|&index| index >= 2) {
            columns.push(steps.columns()[index].clone());
        }
    }
    Schema::new(columns)
}

struct LanceVideoReader {
    label: PathBuf,
    steps: Arc<dyn Reader>,
    schema: Schema,
    rows: EpisodeRows,
    /// Videos by column index and episode position.
    videos: VideoCache<(usize, usize)>,
}

impl LanceVideoReader {
    fn source(&self, &(column, episode): &(usize, usize)) -> Result<Source> {
        let name = &self.schema.columns()[column].name;
        let label = self.label.join(format!("episode {episode}, {name}"));
        match self.steps.constants(episode)?.remove(&format!("{VIDEO}{name}")) {
            Some(bytes) => Ok(Source::Memory(label, bytes.into())),
            None => {
                Err(Error::corrupt(label, "the video is missing", "restore it from a copy, or rebuild the dataset"))
            }
        }
    }
}

impl Reader for LanceVideoReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.steps.episodes()
    }

    fn read_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let index = self.schema.index(name)?;
        let column = &self.schema.columns()[index];
        if !column.is_image() {
            return self.steps.read_column(name, ranges, out);
        }
        let slots = self.rows.row_slots(column, ranges, out)?;
        let requests = slots.into_iter().map(|((episode, step), slot)| ((index, episode), step, slot)).collect();
        self.videos.read(requests, |key| self.source(key), |_, &step| Ok(step))
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        let mut constants = self.steps.constants(episode)?;
        constants.retain(|name, _| name != SCHEMA && !name.starts_with(VIDEO));
        Ok(constants)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let image_columns = self.schema.columns().iter().enumerate().filter(|(_, column)| column.is_image());
        let found = image_columns.flat_map(|(index, column)| {
            self.episodes().iter().enumerate().filter_map(move |(position, episode)| {
                let key = (index, position);
                let what = self.videos.irregularity(&key, || self.source(&key), &column.name, episode.length)?;
                Some(Irregularity { episode: Some(position), what })
            })
        });
        let mut all = self.steps.irregularities()?;
        all.extend(found);
        Ok(all)
    }

    fn check_files(&self) -> Result<()> {
        self.steps.check_files()
    }

    fn sources(&self) -> Vec<PathBuf> {
        vec![self.label.clone()]
    }

    fn manifest(&self) -> Option<Manifest> {
        self.steps.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        self.steps.footprint()
    }

    fn content_hash(&self) -> Result<String> {
        self.steps.content_hash()
    }

    fn identity(&self, episodes: usize) -> Result<String> {
        self.steps.identity(episodes)
    }

    fn cache_key(&self) -> Result<String> {
        self.steps.cache_key()
    }
}
