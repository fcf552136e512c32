//! [`subset`] and [`select`]: some episodes or some columns of a dataset.

use super::view_hash;
use crate::dataset::reader::{Constants, Episode, Irregularity, Reader, StepRange};
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema};

/// Selects the episodes at `positions`, in the given order. The episodes keep their values of `episode_idx`.
///
/// # Errors
/// If `positions` is empty, a position does not exist, or a position appears twice.
pub fn subset(reader: Arc<dyn Reader>, positions: Vec<usize>) -> Result<Arc<dyn Reader>> {
    let all = reader.episodes();
    let mut selected = vec![false; all.len()];
    for &position in &positions {
        match selected.get_mut(position) {
            None => {
                let expected = format!("positions below {}", all.len());
                return Err(Error::mismatch("choosing episodes", format!("position {position}"), expected));
            }
            Some(true) => {
                return Err(Error::mismatch(
                    "choosing episodes",
                    format!("position {position} twice"),
                    "each position at most once",
                ));
            }
            Some(selected) => *selected = true,
        }
    }
    if positions.is_empty() {
        return Err(Error::mismatch("choosing episodes", "no episode", "at least one"));
    }
    let episodes = positions.iter().map(|&position| all[position]).collect();
    let schema = reader.schema().clone();
    Ok(Arc::new(Subset { reader, positions: Some(positions), episodes, schema }))
}

/// Selects columns, in the given order, preceded by the index columns.
///
/// # Errors
/// If a column does not exist.
pub fn select(reader: Arc<dyn Reader>, columns: &[&str]) -> Result<Arc<dyn Reader>> {
    let indices =
        reader.schema().columns().iter().filter(|column| column.name == EPISODE_IDX || column.name == STEP_IDX);
    let mut selected: Vec<ColumnSpec> = indices.cloned().collect();
    for name in columns {
        let column = reader.schema().column(name)?;
        if !selected.contains(column) {
            selected.push(column.clone());
        }
    }
    let episodes = reader.episodes().to_vec();
    Ok(Arc::new(Subset { reader, positions: None, episodes, schema: Schema::new(selected)? }))
}

struct Subset {
    reader: Arc<dyn Reader>,
    /// Positions of the selected episodes in the inner reader; `None` if all episodes are selected.
    positions: Option<Vec<usize>>,
    episodes: Vec<Episode>,
    schema: Schema,
}

impl Subset {
    fn position(&self, episode: usize) -> Result<usize> {
        if episode >= self.episodes.len() {
            let expected = format!("positions below {}", self.episodes.len());
            return Err(Error::mismatch("reading rows", format!("episode position {episode}"), expected));
        }
        Ok(self.positions.as_ref().map_or(episode, |positions| positions[episode]))
    }
}

impl Reader for Subset {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        self.schema.index(column)?;
        let inner: Result<Vec<StepRange>> =
            ranges.iter().map(|range| Ok(StepRange { episode: self.position(range.episode)?, ..*range })).collect();
        self.reader.read_column(column, &inner?, out)
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.reader.constants(self.position(episode)?)
    }

    /// The irregularities of the whole dataset and of the selected episodes.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let position = |episode| match &self.positions {
            Some(positions) => positions.iter().position(|&selected| selected == episode),
            None => Some(episode),
        };
        let found = self.reader.irregularities()?.into_iter().filter_map(|found| match found.episode {
            Some(episode) => position(episode).map(|episode| Irregularity { episode: Some(episode), ..found }),
            None => Some(found),
        });
        Ok(found.collect())
    }

    fn check_files(&self) -> Result<()> {
        self.reader.check_files()
    }

    fn sources(&self) -> Vec<PathBuf> {
        self.reader.sources()
    }

    fn manifest(&self) -> Option<Manifest> {
        self.reader.manifest()
    }

    /// The footprint of the whole dataset, without unselected columns.
    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let selected = |name: &str| self.schema.find(name).is_some() || self.reader.schema().find(name).is_none();
        Ok(self.reader.footprint()?.into_iter().filter(|(name, _)| selected(name)).collect())
    }

    /// A hash of the inner reader's content hash, the column names and the positions.
    fn content_hash(&self) -> Result<String> {
        Ok(self.hash_with(self.reader.content_hash()?))
    }

    fn cache_key(&self) -> Result<String> {
        Ok(self.hash_with(self.reader.cache_key()?))
    }
}

impl Subset {
    /// A hash of a hash of the inner reader, the column names and the positions.
    fn hash_with(&self, inner: String) -> String {
        let positions = self.positions.iter().flatten().map(usize::to_string);
        let columns = self.schema.columns().iter().map(|column| column.name.clone());
        view_hash("subset", std::iter::once(inner).chain(columns).chain(positions))
    }
}
