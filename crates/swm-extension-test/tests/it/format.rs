//! The format `json`: a dataset in one JSON file, `NAME.extjson`.

use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::sync::Arc;
use swm::core::{Batch, ColumnSpec, Error, Manifest, Result, Schema, manifest};
use swm::data::FormatEntry;
use swm::data::dataset::{Constants, Episode, Location, Reader, StepRange, WriteOptions, Writer};
use swm::data::formats::Backend;

pub const ENTRY: FormatEntry = FormatEntry {
    id: "json",
    summary: "one JSON file",
    suffixes: &["extjson"],
    exact_images: true,
    codecs: false,
    feature: None,
    detect: |location| location.has_suffix("extjson"),
    backend: Some(Backend { open, create, remove: swm::core::files::delete_file, recover: None }),
};

#[derive(Serialize, Deserialize)]
struct Stored {
    columns: Vec<ColumnSpec>,
    lengths: Vec<usize>,
    /// For each column, the bytes of all rows.
    data: Vec<Vec<u8>>,
    manifest: Option<Manifest>,
}

struct JsonReader {
    schema: Schema,
    episodes: Vec<Episode>,
    /// The first row of each episode.
    starts: Vec<usize>,
    stored: Stored,
}

fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    let path = location.local("json")?;
    let text = std::fs::read(path).map_err(|error| Error::io(path, "reading a dataset", error))?;
    let stored: Stored =
        serde_json::from_slice(&text).map_err(|error| Error::corrupt(path, error.to_string(), "write it again"))?;
    let starts = (0..stored.lengths.len()).map(|episode| stored.lengths[..episode].iter().sum()).collect();
    let episodes = stored.lengths.iter().zip(0..).map(|(&length, index)| Episode { index, length }).collect();
    Ok(Arc::new(JsonReader { schema: Schema::new(stored.columns.clone())?, episodes, starts, stored }))
}

impl Reader for JsonReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], mut out: &mut [u8]) -> Result<()> {
        let index = self.schema.index(column)?;
        let row_size = self.schema.columns()[index].row_bytes();
        for range in ranges {
            let first = (self.starts[range.episode] + range.start) * row_size;
            let (target, rest) = out.split_at_mut(range.length * row_size);
            target.copy_from_slice(&self.stored.data[index][first..][..target.len()]);
            out = rest;
        }
        Ok(())
    }

    fn manifest(&self) -> Option<Manifest> {
        self.stored.manifest.clone()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        Ok(manifest::hash(&self.stored.data.concat()))
    }
}

struct JsonWriter {
    path: PathBuf,
    stored: Stored,
}

fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let stored = Stored {
        columns: schema.columns().to_vec(),
        lengths: vec![],
        data: vec![vec![]; schema.columns().len()],
        manifest: options.manifest,
    };
    Ok(Box::new(JsonWriter { path: location.local("json")?.to_owned(), stored }))
}

impl Writer for JsonWriter {
    fn write_episode_with(&mut self, episode: &Batch, _: &Constants) -> Result<()> {
        self.stored.lengths.push(episode.rows());
        for (index, data) in self.stored.data.iter_mut().enumerate() {
            data.extend_from_slice(episode.bytes(index));
        }
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.stored.lengths.len()
    }

    fn finish(self: Box<Self>) -> Result<()> {
        let text = serde_json::to_vec(&self.stored).map_err(|error| Error::external("writing JSON", error))?;
        std::fs::write(&self.path, text).map_err(|error| Error::io(&self.path, "writing a dataset", error))
    }
}
