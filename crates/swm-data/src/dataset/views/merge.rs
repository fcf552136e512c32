//! [`merge`]: a dataset with additional columns from another dataset of the same episodes.

use super::view_hash;
use crate::dataset::reader::{Constants, Episode, Irregularity, Reader, StepRange};
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::{Error, Manifest, Result, Schema};

/// Adds columns of `other` to `base`, such as embeddings of the images of `base`. Both datasets must have episodes of
/// the same lengths in the same order. Episode indices, manifest and constants come from `base`; constants of `other`
/// are added if `base` has no constant of the same name.
///
/// # Errors
/// If the episodes differ, a column does not exist, or `base` already has a column of the same name.
pub fn merge(base: Arc<dyn Reader>, other: Arc<dyn Reader>, columns: &[&str]) -> Result<Arc<dyn Reader>> {
    let lengths = |reader: &Arc<dyn Reader>| reader.episodes().iter().map(|e| e.length).collect::<Vec<_>>();
    let (expected, given) = (lengths(&base), lengths(&other));
    if expected != given {
        let differs = expected.iter().zip(&given).position(|(a, b)| a != b);
        let (given, expected) = match differs {
            Some(i) => (format!("{} rows in episode {i}", given[i]), expected[i].to_string()),
            None => (format!("{} episodes", given.len()), expected.len().to_string()),
        };
        return Err(Error::mismatch("merging columns of another dataset", given, expected));
    }
    let mut all = base.schema().columns().to_vec();
    for name in columns {
        let column = other.schema().column(name)?;
        if base.schema().find(name).is_some() {
            return Err(Error::config(
                format!("merging column '{name}'"),
                "the dataset already has a column of that name",
                "leave one of the two out (select the columns to keep)",
            ));
        }
        all.push(column.clone());
    }
    Ok(Arc::new(Merge { schema: Schema::new(all)?, base, other }))
}

struct Merge {
    schema: Schema,
    base: Arc<dyn Reader>,
    other: Arc<dyn Reader>,
}

impl Merge {
    /// Names of the columns that come from `other`.
    fn added(&self) -> impl Iterator<Item = &str> {
        self.schema.columns().iter().skip(self.base.schema().columns().len()).map(|column| column.name.as_str())
    }
}

impl Reader for Merge {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.base.episodes()
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let reader =
            if self.schema.index(column)? < self.base.schema().columns().len() { &self.base } else { &self.other };
        reader.read_column(column, ranges, out)
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        let mut constants = self.other.constants(episode)?;
        constants.append(&mut self.base.constants(episode)?);
        Ok(constants)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        self.base.irregularities()
    }

    fn check_files(&self) -> Result<()> {
        self.base.check_files()?;
        self.other.check_files()
    }

    fn sources(&self) -> Vec<PathBuf> {
        [self.base.sources(), self.other.sources()].concat()
    }

    fn manifest(&self) -> Option<Manifest> {
        self.base.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let mut sizes = self.base.footprint()?;
        sizes.extend(self.other.footprint()?.into_iter().filter(|(name, _)| self.added().any(|added| added == name)));
        sizes.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(sizes)
    }

    /// A hash of the content hashes of the two datasets and of the names of the added columns.
    fn content_hash(&self) -> Result<String> {
        let hashes = [self.base.content_hash()?, self.other.content_hash()?];
        Ok(view_hash("merge", hashes.into_iter().chain(self.added().map(str::to_owned))))
    }

    fn cache_key(&self) -> Result<String> {
        let keys = [self.base.cache_key()?, self.other.cache_key()?];
        Ok(view_hash("merge", keys.into_iter().chain(self.added().map(str::to_owned))))
    }
}
