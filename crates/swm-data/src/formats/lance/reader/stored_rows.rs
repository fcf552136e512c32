//! Reads any rows of a column with Lance's decoder.

use super::lance_reader::{LanceReader, max_open_files};
use crate::formats::lance::store::block_on;
use arrow_array::ArrayRef;
use futures::{StreamExt as _, TryStreamExt as _};
use lance_encoding::decoder::FilterExpression;
use lance_io::ReadBatchParams;
use std::ops::Range;
use std::sync::Arc;
use swm_core::Result;
use swm_core::columns::EPISODE_IDX;

/// Rows per decoded chunk; a larger value only increases memory use.
const ROWS_PER_CHUNK: u32 = 4096;

/// Consecutive stored rows of one fragment.
pub(super) struct StoredRows {
    pub(super) values: ArrayRef,
    pub(super) rows: usize,
}

impl LanceReader {
    /// Reads the stored values of disjoint, ascending ranges of rows, counted over the table.
    pub(super) fn stored_rows(&self, stored_name: &str, ranges: &[Range<u64>]) -> Result<Vec<StoredRows>> {
        // Splits the ranges at fragment boundaries.
        let mut jobs: Vec<(usize, Vec<Range<u64>>)> = vec![];
        for range in ranges.iter().filter(|range| !range.is_empty()) {
            let mut start = range.start;
            let mut fragment = self.fragment_of(start);
            while start < range.end {
                let (first, end) = (self.fragment_rows[fragment], self.fragment_rows[fragment + 1]);
                let part = start - first..range.end.min(end) - first;
                start = first + part.end;
                match jobs.last_mut() {
                    Some((last, parts)) if *last == fragment => parts.push(part),
                    _ if !part.is_empty() => jobs.push((fragment, vec![part])),
                    _ => {}
                }
                fragment += 1;
            }
        }
        let mut chunks = vec![];
        for jobs in jobs.chunks(max_open_files(&self.store)) {
            chunks.extend(self.read_stored_rows(stored_name, jobs)?);
        }
        Ok(chunks)
    }

    /// Reads the stored values of jobs. A job is a fragment, and ranges of rows within this fragment.
    pub(super) fn read_stored_rows(
        &self,
        stored_name: &str,
        jobs: &[(usize, Vec<Range<u64>>)],
    ) -> Result<Vec<StoredRows>> {
        if self.store.remote {
            let files = jobs.iter().map(|(fragment, _)| Ok(self.data_file(*fragment, stored_name)?.0.clone()));
            self.open_together(files.collect::<Result<_>>()?)?;
        }
        let mut reads = vec![];
        for (fragment, parts) in jobs {
            self.verify(self.data_file(*fragment, stored_name)?.0, stored_name != EPISODE_IDX)?;
            let (file, projection) = self.locate(*fragment, stored_name)?;
            let expected: u64 = parts.iter().map(|part| part.end - part.start).sum();
            reads.push((file, projection, parts.clone(), expected));
        }
        let action = format!("reading column '{stored_name}'");
        let lists = block_on(self.folder(), &action, async move {
            futures::stream::iter(reads.into_iter().map(|(file, projection, parts, expected)| async move {
                let params = ReadBatchParams::Ranges(parts.into());
                let mut tasks =
                    file.read_tasks(params, ROWS_PER_CHUNK, Some(projection), FilterExpression::no_filter()).await?;
                let mut chunks = vec![];
                while let Some(task) = tasks.next().await {
                    let batch = task.task.await?;
                    chunks.push(StoredRows { rows: batch.num_rows(), values: Arc::clone(batch.column(0)) });
                }
                let rows: u64 = chunks.iter().map(|chunk| chunk.rows as u64).sum();
                if rows != expected {
                    return Err(lance_core::Error::internal(format!("got {rows} rows instead of {expected}")));
                }
                Ok(chunks)
            }))
            .buffered(16)
            .try_collect::<Vec<Vec<StoredRows>>>()
            .await
        })?;
        Ok(lists.into_iter().flatten().collect())
    }
}
