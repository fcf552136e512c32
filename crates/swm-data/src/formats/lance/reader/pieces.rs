//! Values as Lance decodes them, from any rows of the table.

use super::super::store::wait;
use super::LanceReader;
use super::files::open_at_once;
use crate::formats::lance::schema::EPISODE;
use arrow_array::ArrayRef;
use futures::{StreamExt as _, TryStreamExt as _};
use lance_encoding::decoder::FilterExpression;
use lance_io::ReadBatchParams;
use std::ops::Range;
use std::sync::Arc;
use swm_core::Result;

/// Rows per decoded piece; more only costs memory.
const ROWS_PER_PIECE: u32 = 4096;

/// Consecutive rows of one fragment, as stored.
pub(super) struct Piece {
    pub(super) values: ArrayRef,
    pub(super) rows: usize,
}

impl LanceReader {
    /// The stored values of disjoint rising ranges of rows of the whole table.
    pub(super) fn pieces(&self, stored_name: &str, ranges: &[Range<u64>]) -> Result<Vec<Piece>> {
        // Cut the ranges at the fragments' borders.
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
        let mut pieces = vec![];
        for jobs in jobs.chunks(open_at_once(&self.store)) {
            pieces.extend(self.read_pieces(stored_name, jobs)?);
        }
        Ok(pieces)
    }

    /// The stored values of some rows of some fragments.
    pub(super) fn read_pieces(&self, stored_name: &str, jobs: &[(usize, Vec<Range<u64>>)]) -> Result<Vec<Piece>> {
        if self.store.remote {
            let files = jobs.iter().map(|(fragment, _)| Ok(self.data_file(*fragment, stored_name)?.0.clone()));
            self.open_together(files.collect::<Result<_>>()?)?;
        }
        let mut reads = vec![];
        for (fragment, parts) in jobs {
            self.verify(self.data_file(*fragment, stored_name)?.0, stored_name != EPISODE)?;
            let (file, projection) = self.locate(*fragment, stored_name)?;
            let wanted: u64 = parts.iter().map(|part| part.end - part.start).sum();
            reads.push((file, projection, parts.clone(), wanted));
        }
        let action = format!("reading column '{stored_name}'");
        let lists = wait(self.folder(), &action, async move {
            futures::stream::iter(reads.into_iter().map(|(file, projection, parts, wanted)| async move {
                let params = ReadBatchParams::Ranges(parts.into());
                let mut tasks =
                    file.read_tasks(params, ROWS_PER_PIECE, Some(projection), FilterExpression::no_filter()).await?;
                let mut pieces = vec![];
                while let Some(task) = tasks.next().await {
                    let batch = task.task.await?;
                    pieces.push(Piece { rows: batch.num_rows(), values: Arc::clone(batch.column(0)) });
                }
                let rows: u64 = pieces.iter().map(|piece| piece.rows as u64).sum();
                if rows != wanted {
                    return Err(lance_core::Error::internal(format!("got {rows} rows instead of {wanted}")));
                }
                Ok(pieces)
            }))
            .buffered(16)
            .try_collect::<Vec<Vec<Piece>>>()
            .await
        })?;
        Ok(lists.into_iter().flatten().collect())
    }
}
