//! [`concat`]: the episodes of several datasets, one after another.

use super::view_hash;
use crate::dataset::episodes::{EpisodeRows, describe_columns, index_columns};
use crate::dataset::reader::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::dataset::sync::lock;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema};

/// Concatenates datasets with the same columns (in any order). Episodes are numbered from 0.
///
/// # Errors
/// If there is no dataset, or the columns of a dataset differ from those of the first dataset; the error lists the
/// differing columns.
pub fn concat(parts: Vec<Arc<dyn Reader>>) -> Result<Arc<dyn Reader>> {
    let Some(first) = parts.first() else {
        return Err(Error::config("concatenation", "the list of datasets is empty", "name at least one dataset"));
    };
    let data = |reader: &Arc<dyn Reader>| -> Vec<ColumnSpec> {
        reader.schema().columns().iter().filter(|c| c.name != EPISODE_IDX && c.name != STEP_IDX).cloned().collect()
    };
    let columns = data(first);
    for (i, part) in parts.iter().enumerate() {
        let part_columns = data(part);
        let without = |a: &[ColumnSpec], b: &[ColumnSpec]| {
            let missing: Vec<ColumnSpec> = a.iter().filter(|&column| !b.contains(column)).cloned().collect();
            (!missing.is_empty()).then(|| describe_columns(&missing))
        };
        let (missing, extra) = (without(&columns, &part_columns), without(&part_columns, &columns));
        if missing.is_some() || extra.is_some() {
            return Err(Error::mismatch(
                format!("concatenating dataset {} to the first", i + 1),
                format!(
                    "other columns (only in the first: {}; only in dataset {}: {})",
                    missing.as_deref().unwrap_or("none"),
                    i + 1,
                    extra.as_deref().unwrap_or("none")
                ),
                "the columns of the first; select the common columns",
            ));
        }
    }
    let mut rows = EpisodeRows::default();
    parts.iter().flat_map(|part| part.episodes()).for_each(|episode| rows.push(episode.length));
    let mut first_episodes = vec![0];
    for part in &parts {
        first_episodes.push(first_episodes[first_episodes.len() - 1] + part.episodes().len());
    }
    let indices = index_columns(first.schema().columns());
    let schema = Schema::new([&indices[..], &columns].concat())?;
    Ok(Arc::new(Concat { parts, first_episodes, rows, schema, scratch: Mutex::default() }))
}

struct Concat {
    parts: Vec<Arc<dyn Reader>>,
    /// Position of the first episode of every part, followed by the number of episodes.
    first_episodes: Vec<usize>,
    rows: EpisodeRows,
    schema: Schema,
    /// Reusable buffers for reading from the parts.
    scratch: Mutex<Vec<Vec<u8>>>,
}

impl Concat {
    /// The part that contains an episode, and the episode's position in it.
    fn locate(&self, episode: usize) -> (usize, usize) {
        let part = self.first_episodes.partition_point(|&first| first <= episode) - 1;
        (part, episode - self.first_episodes[part])
    }
}

impl Reader for Concat {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.rows.episodes()
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let spec = self.schema.column(column)?;
        if column == EPISODE_IDX || column == STEP_IDX {
            return self.rows.fill_index_column(spec, ranges, out);
        }
        EpisodeRows::check_output(spec, ranges, out)?;
        // `(part, byte offset in the output, range within the part)` for every range.
        let n = spec.row_bytes();
        let mut jobs = Vec::with_capacity(ranges.len());
        let mut offset = 0;
        for range in ranges {
            self.rows.range(range)?;
            let (part, episode) = self.locate(range.episode);
            jobs.push((part, offset, StepRange { episode, ..*range }));
            offset += range.length * n;
        }
        // If all ranges belong to one part, the rows are read directly into the output.
        let single_part = jobs.iter().all(|job| job.0 == jobs[0].0);
        if let (true, Some(&(part, ..))) = (single_part, jobs.first()) {
            let ranges: Vec<StepRange> = jobs.iter().map(|job| job.2).collect();
            return self.parts[part].read_column(column, &ranges, out);
        }
        let mut read = lock(&self.scratch).pop().unwrap_or_default();
        for (i, part) in self.parts.iter().enumerate() {
            let part_jobs = jobs.iter().filter(|job| job.0 == i);
            let ranges: Vec<StepRange> = part_jobs.clone().map(|job| job.2).collect();
            if ranges.is_empty() {
                continue;
            }
            read.resize(ranges.iter().map(|range| range.length * n).sum(), 0);
            part.read_column(column, &ranges, &mut read)?;
            let mut rest = &read[..];
            for (_, offset, range) in part_jobs {
                let (bytes, after) = rest.split_at(range.length * n);
                out[*offset..*offset + bytes.len()].copy_from_slice(bytes);
                rest = after;
            }
        }
        lock(&self.scratch).push(read);
        Ok(())
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.rows.range(&StepRange::new(episode, 0, 0))?;
        let (part, episode) = self.locate(episode);
        self.parts[part].constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let mut found = vec![];
        for (part, first) in self.parts.iter().zip(&self.first_episodes) {
            found.extend(part.irregularities()?.into_iter().map(|Irregularity { episode, what }| Irregularity {
                episode: episode.map(|episode| first + episode),
                what,
            }));
        }
        Ok(found)
    }

    fn check_files(&self) -> Result<()> {
        self.parts.iter().try_for_each(|part| part.check_files())
    }

    fn sources(&self) -> Vec<PathBuf> {
        self.parts.iter().flat_map(|part| part.sources()).collect()
    }

    /// Returns the manifest of the first part if all parts have the same manifest. Otherwise, returns a new manifest
    /// that contains the manifests of the parts, and the config entries that all these manifests share.
    fn manifest(&self) -> Option<Manifest> {
        let manifests: Vec<Manifest> = self.parts.iter().filter_map(|part| part.manifest()).collect();
        let first = manifests.first()?;
        if manifests.len() == self.parts.len() && manifests.iter().all(|manifest| manifest == first) {
            return Some(first.clone());
        }
        let mut config = serde_json::Map::new();
        for (name, value) in first.config.as_object().into_iter().flatten() {
            if manifests.iter().all(|manifest| manifest.config.get(name) == Some(value)) {
                config.insert(name.clone(), value.clone());
            }
        }
        config.insert("parts".to_owned(), serde_json::to_value(&manifests).ok()?);
        Some(Manifest::new("concat", first.seed, config.into()))
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let mut sizes: BTreeMap<String, u64> = BTreeMap::new();
        for part in &self.parts {
            for (name, size) in part.footprint()? {
                *sizes.entry(name).or_default() += size;
            }
        }
        let mut sizes: Vec<(String, u64)> = sizes.into_iter().collect();
        sizes.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(sizes)
    }

    /// A hash of the parts' hashes.
    fn content_hash(&self) -> Result<String> {
        let parts: Result<Vec<String>> = self.parts.iter().map(|part| part.content_hash()).collect();
        Ok(view_hash("concat", parts?))
    }

    fn cache_key(&self) -> Result<String> {
        let parts: Result<Vec<String>> = self.parts.iter().map(|part| part.cache_key()).collect();
        Ok(view_hash("concat", parts?))
    }
}
