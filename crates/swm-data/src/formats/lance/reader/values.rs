//! Numbers of a batch. They are small: those of a data file are decoded whole when the first of them is wanted, and kept
//! as long as there is room.

use super::super::convert::convert;
use super::super::schema::StoredColumn;
use super::super::store::damaged;
use super::pieces::Piece;
use super::{LanceReader, Wanted, lock, merged};
use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;
use swm_core::Result;

/// Bytes of decoded numbers that are kept. A hundred thousand steps of sixty numbers take a quarter of it.
const KEPT_NUMBERS: usize = 128 << 20;

/// Decoded numbers, by fragment and name of the column.
#[derive(Default)]
pub(super) struct Numbers {
    kept: HashMap<(usize, String), Arc<Vec<u8>>>,
    bytes: usize,
}

impl LanceReader {
    pub(super) fn read_numbers(&self, column: &StoredColumn, wanted: &mut [Wanted]) -> Result<()> {
        self.keep_numbers(column, wanted)?;
        let n = column.spec.row_bytes();
        let mut others = vec![];
        for rows in wanted.chunk_by_mut(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
            let fragment = self.fragment_of(rows[0].0);
            let kept = lock(&self.numbers).kept.get(&(fragment, column.name.clone())).map(Arc::clone);
            match kept {
                Some(values) => {
                    for (row, place) in rows {
                        let at = (*row - self.fragment_rows[fragment]) as usize * n;
                        place.copy_from_slice(&values[at..at + n]);
                    }
                }
                None => others.extend(rows),
            }
        }
        let pieces = self.pieces(&column.name, &merged(&others))?;
        // One group for every stored row: the places that want it.
        let mut groups = others.chunk_by_mut(|a, b| a.0 == b.0);
        let mut bytes = vec![];
        for piece in &pieces {
            bytes.resize(piece.rows * n, 0);
            self.convert(column, piece, &mut bytes)?;
            for (value, group) in bytes.chunks_exact(n).zip(groups.by_ref()) {
                group.iter_mut().for_each(|(_, place)| place.copy_from_slice(value));
            }
        }
        Ok(())
    }

    pub(super) fn convert(&self, column: &StoredColumn, piece: &Piece, out: &mut [u8]) -> Result<()> {
        convert(&piece.values, column.spec.len(), column.spec.dtype, out)
            .map_err(|problem| damaged(self.folder(), format!("column '{}': {problem}", column.spec.name)))
    }

    /// Decodes the numbers of all fragments that have a wanted row, as long as there is room for them.
    pub(super) fn keep_numbers(&self, column: &StoredColumn, wanted: &[Wanted]) -> Result<()> {
        let n = column.spec.row_bytes();
        let mut ranges: Vec<Range<u64>> = vec![];
        {
            let numbers = lock(&self.numbers);
            let mut room = KEPT_NUMBERS.saturating_sub(numbers.bytes);
            for rows in wanted.chunk_by(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
                let fragment = self.fragment_of(rows[0].0);
                let range = self.fragment_rows[fragment]..self.fragment_rows[fragment + 1];
                let size = (range.end - range.start).saturating_mul(n as u64);
                let known = numbers.kept.contains_key(&(fragment, column.name.clone()));
                if !known && size <= room as u64 {
                    room -= size as usize;
                    ranges.push(range);
                }
            }
        }
        let mut pieces = self.pieces(&column.name, &ranges)?.into_iter();
        for range in ranges {
            let mut values = vec![0; (range.end - range.start) as usize * n];
            let mut at = 0;
            while at < values.len() {
                let Some(piece) = pieces.next() else { break };
                let end = (at + piece.rows * n).min(values.len());
                self.convert(column, &piece, &mut values[at..end])?;
                at = end;
            }
            let mut numbers = lock(&self.numbers);
            numbers.bytes += values.len();
            let key = (self.fragment_of(range.start), column.name.clone());
            if let Some(twice) = numbers.kept.insert(key, Arc::new(values)) {
                numbers.bytes -= twice.len();
            }
        }
        Ok(())
    }
}
