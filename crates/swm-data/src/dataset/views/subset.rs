//! [`subset`] and [`select`]: some of a dataset's episodes, some of its columns.

use super::view_hash;
use crate::dataset::episodes::{EPISODE, STEP};
use crate::dataset::reader::{Constants, Episode, Irregularity, Reader, StepRange};
use std::sync::Arc;
use swm_core::{ColumnSpec, Error, Manifest, Result, Schema};

/// The episodes at these positions, in this order, under the numbers they have.
///
/// # Errors
/// When there is none, a position does not exist, or one is named twice.
pub fn subset(reader: Arc<dyn Reader>, positions: Vec<usize>) -> Result<Arc<dyn Reader>> {
    let all = reader.episodes();
    let mut seen = vec![false; all.len()];
    for &position in &positions {
        match seen.get_mut(position) {
            None => {
                let known = format!("positions below {}", all.len());
                return Err(Error::mismatch("choosing episodes", format!("position {position}"), known));
            }
            Some(true) => {
                return Err(Error::mismatch(
                    "choosing episodes",
                    format!("position {position} twice"),
                    "each one once",
                ));
            }
            Some(seen) => *seen = true,
        }
    }
    if positions.is_empty() {
        return Err(Error::mismatch("choosing episodes", "none", "at least one"));
    }
    let episodes = positions.iter().map(|&position| all[position]).collect();
    let schema = reader.schema().clone();
    Ok(Arc::new(Subset { reader, positions: Some(positions), episodes, schema }))
}

/// Some of the columns, in this order; those that number episodes and steps stay.
///
/// # Errors
/// When a column does not exist.
pub fn select(reader: Arc<dyn Reader>, columns: &[&str]) -> Result<Arc<dyn Reader>> {
    let numbers = reader.schema().columns().iter().filter(|column| column.name == EPISODE || column.name == STEP);
    let mut kept: Vec<ColumnSpec> = numbers.cloned().collect();
    for name in columns {
        let column = reader.schema().column(name)?;
        if !kept.contains(column) {
            kept.push(column.clone());
        }
    }
    let episodes = reader.episodes().to_vec();
    Ok(Arc::new(Subset { reader, positions: None, episodes, schema: Schema::new(kept)? }))
}

struct Subset {
    reader: Arc<dyn Reader>,
    /// Where its episodes are; where they are for `None`.
    positions: Option<Vec<usize>>,
    episodes: Vec<Episode>,
    schema: Schema,
}

impl Subset {
    fn position(&self, episode: usize) -> Result<usize> {
        if episode >= self.episodes.len() {
            let known = format!("positions below {}", self.episodes.len());
            return Err(Error::mismatch("reading rows", format!("the episode in position {episode}"), known));
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

    /// Those of the dataset as a whole and of the episodes that are chosen.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let place = |episode| match &self.positions {
            Some(positions) => positions.iter().position(|&position| position == episode),
            None => Some(episode),
        };
        let found = self.reader.irregularities()?.into_iter().filter_map(|found| match found.episode {
            Some(episode) => place(episode).map(|episode| Irregularity { episode: Some(episode), ..found }),
            None => Some(found),
        });
        Ok(found.collect())
    }

    fn manifest(&self) -> Option<Manifest> {
        self.reader.manifest()
    }

    /// That of the whole dataset, the columns that are left out aside.
    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let kept = |name: &str| self.schema.find(name).is_some() || self.reader.schema().find(name).is_none();
        Ok(self.reader.footprint()?.into_iter().filter(|(name, _)| kept(name)).collect())
    }

    /// A hash of the dataset's, the positions and the columns.
    fn content_hash(&self) -> Result<String> {
        let positions = self.positions.iter().flatten().map(usize::to_string);
        let columns = self.schema.columns().iter().map(|column| column.name.clone());
        Ok(view_hash("subset", std::iter::once(self.reader.content_hash()?).chain(columns).chain(positions)))
    }
}
