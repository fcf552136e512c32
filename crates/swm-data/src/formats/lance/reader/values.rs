//! Reads the numeric values of a batch. Numeric values are small, so the first access decodes the whole column of a
//! fragment, and caches it if the size limit allows.

use super::lance_reader::{LanceReader, RowSlot, lock, merged};
use super::stored_rows::StoredRows;
use crate::formats::lance::convert::convert;
use crate::formats::lance::errors::damaged;
use crate::formats::lance::schema::StoredColumn;
use std::ops::Range;
use std::sync::Arc;
use swm_core::Result;

/// Maximum size of cached values in bytes. 100,000 steps with 60 `float32` elements take 24 MB.
const CACHED_BYTES: usize = 128 << 20;

impl LanceReader {
    pub(super) fn read_values(&self, column: &StoredColumn, requested: &mut [RowSlot]) -> Result<()> {
        self.cache_values(column, requested)?;
        let n = column.spec.row_bytes();
        let mut uncached = vec![];
        for rows in requested.chunk_by_mut(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
            let fragment = self.fragment_of(rows[0].0);
            let cached = lock(&self.value_cache).columns.get(&(fragment, column.name.clone())).map(Arc::clone);
            match cached {
                Some(values) => {
                    for (row, slot) in rows {
                        let at = (*row - self.fragment_rows[fragment]) as usize * n;
                        slot.copy_from_slice(&values[at..at + n]);
                    }
                }
                None => uncached.extend(rows),
            }
        }
        let stored = self.stored_rows(&column.name, &merged(&uncached))?;
        // One group per stored row: the output slots that receive the row.
        let mut groups = uncached.chunk_by_mut(|a, b| a.0 == b.0);
        let mut bytes = vec![];
        for rows_read in &stored {
            bytes.resize(rows_read.rows * n, 0);
            self.convert(column, rows_read, &mut bytes)?;
            for (value, group) in bytes.chunks_exact(n).zip(groups.by_ref()) {
                group.iter_mut().for_each(|(_, slot)| slot.copy_from_slice(value));
            }
        }
        Ok(())
    }

    pub(super) fn convert(&self, column: &StoredColumn, rows_read: &StoredRows, out: &mut [u8]) -> Result<()> {
        convert(&rows_read.values, column.spec.len(), column.spec.dtype, out)
            .map_err(|problem| damaged(self.folder(), format!("column '{}': {problem}", column.spec.name)))
    }

    /// Decodes and caches the column in all fragments with a requested row, if the size limit allows.
    pub(super) fn cache_values(&self, column: &StoredColumn, requested: &[RowSlot]) -> Result<()> {
        let n = column.spec.row_bytes();
        let mut ranges: Vec<Range<u64>> = vec![];
        {
            let cache = lock(&self.value_cache);
            let mut remaining = CACHED_BYTES.saturating_sub(cache.bytes);
            for rows in requested.chunk_by(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
                let fragment = self.fragment_of(rows[0].0);
                let range = self.fragment_rows[fragment]..self.fragment_rows[fragment + 1];
                let size = (range.end - range.start).saturating_mul(n as u64);
                let known = cache.columns.contains_key(&(fragment, column.name.clone()));
                if !known && size <= remaining as u64 {
                    remaining -= size as usize;
                    ranges.push(range);
                }
            }
        }
        let mut stored = self.stored_rows(&column.name, &ranges)?.into_iter();
        for range in ranges {
            let mut values = vec![0; (range.end - range.start) as usize * n];
            let mut at = 0;
            while at < values.len() {
                let Some(rows_read) = stored.next() else { break };
                let end = (at + rows_read.rows * n).min(values.len());
                self.convert(column, &rows_read, &mut values[at..end])?;
                at = end;
            }
            let mut cache = lock(&self.value_cache);
            cache.bytes += values.len();
            let key = (self.fragment_of(range.start), column.name.clone());
            if let Some(duplicate) = cache.columns.insert(key, Arc::new(values)) {
                cache.bytes -= duplicate.len();
            }
        }
        Ok(())
    }
}
