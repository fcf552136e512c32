//! Pictures of a batch, read from where they lie and decoded in parallel.

use super::super::convert::blob;
use super::super::image_locations::{Place, Places};
use super::super::schema::StoredColumn;
use super::super::store::{damaged, wait};
use super::files::open_at_once;
use super::{LanceReader, Wanted, lock, merged};
use crate::dataset::objects::{self, Pieces};
use rayon::prelude::*;
use std::cell::RefCell;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::Arc;
use swm_core::Result;

/// The pictures of one column in one data file.
pub(super) struct LaidOut {
    /// The data file.
    path: String,
    /// Its bytes.
    size: u64,
    places: Places,
}

impl LanceReader {
    /// Where the pictures of a column are in a fragment; `None` where they are not laid out one by one.
    pub(super) fn places(&self, fragment: usize, column: &str) -> Result<Option<Arc<LaidOut>>> {
        let key = (fragment, column.to_owned());
        if let Some(known) = lock(&self.places).get(&key) {
            return Ok(known.clone());
        }
        let (file, _) = self.data_file(fragment, column)?;
        self.verify(file, true)?;
        let (reader, projection) = self.locate(fragment, column)?;
        let metadata = reader.metadata();
        let found = match projection.column_indices[..] {
            [index] => match metadata.column_infos.get(index as usize) {
                Some(info) => Places::read(info, metadata.file_size_bytes, |ranges| {
                    let store = self.store.clone();
                    let (path, ranges) = (store.data_path(&file.path), ranges.to_vec());
                    wait(self.folder(), "reading where pictures are", async move {
                        Ok(objects::fetch(store.inner(), &path, &ranges).await?)
                    })
                })?,
                None => None,
            },
            _ => None,
        };
        let found =
            found.map(|places| Arc::new(LaidOut { path: file.path.clone(), size: metadata.file_size_bytes, places }));
        lock(&self.places).insert(key, found.clone());
        Ok(found)
    }

    /// No pieces yet of a data file.
    pub(super) fn pieces_of(&self, file: &LaidOut) -> Pieces {
        Pieces { path: self.store.data_path(&file.path), size: file.size, ranges: vec![] }
    }

    pub(super) fn read_pictures(&self, column: &StoredColumn, wanted: &mut [Wanted]) -> Result<()> {
        let mut laid_out = vec![];
        let mut others: Vec<&mut Wanted> = vec![];
        for rows in wanted.chunk_by_mut(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
            let fragment = self.fragment_of(rows[0].0);
            match self.places(fragment, &column.name)? {
                Some(pictures) => laid_out.push((self.fragment_rows[fragment], pictures, rows)),
                None => others.extend(rows),
            }
        }
        for fragments in laid_out.chunks_mut(open_at_once(&self.store)) {
            self.read_laid_out(column, fragments)?;
        }
        let pieces = self.pieces(&column.name, &merged(&others))?;
        let mut groups = others.chunk_by_mut(|a, b| a.0 == b.0);
        let mut jobs = vec![];
        for piece in &pieces {
            for (i, group) in (0..piece.rows).zip(groups.by_ref()) {
                jobs.push((blob(&piece.values, i)?, group));
            }
        }
        jobs.into_par_iter().with_max_len(1).try_for_each(|(bytes, group)| {
            let Some(((row, first), others)) = group.split_first_mut().map(|(a, b)| ((a.0, &mut *a.1), b)) else {
                return Ok(());
            };
            self.decode(column, row, bytes, first)?;
            others.iter_mut().for_each(|(_, place)| place.copy_from_slice(first));
            Ok(())
        })
    }

    /// Reads and decodes pictures whose places are known, of some fragments.
    pub(super) fn read_laid_out(
        &self,
        column: &StoredColumn,
        fragments: &mut [(u64, Arc<LaidOut>, &mut [Wanted])],
    ) -> Result<()> {
        let files: Vec<Arc<LaidOut>> = fragments.iter().map(|(_, pictures, _)| Arc::clone(pictures)).collect();
        let mut jobs = vec![];
        for (at, (first_row, pictures, rows)) in fragments.iter_mut().enumerate() {
            for group in rows.chunk_by_mut(|a, b| a.0 == b.0) {
                let row = group[0].0;
                let place = pictures.places.find(row - *first_row).ok_or_else(|| {
                    damaged(self.folder(), format!("row {row} of column '{}' is not in its data file", column.name))
                })?;
                jobs.push((at, place, group));
            }
        }
        let finish = |place: &Place, bytes: &[u8], group: &mut [Wanted]| {
            let Some(((row, first), others)) = group.split_first_mut() else { return Ok(()) };
            let picture = place.picture(bytes).ok_or_else(|| {
                damaged(self.folder(), format!("row {row} of column '{}' states another length", column.name))
            })?;
            self.decode(column, *row, picture, first)?;
            others.iter_mut().for_each(|(_, place)| place.copy_from_slice(first));
            Ok(())
        };
        if self.store.remote {
            let mut wanted: Vec<Pieces> = files.iter().map(|file| self.pieces_of(file)).collect();
            jobs.iter().for_each(|(at, place, _)| wanted[*at].ranges.push(place.bytes.clone()));
            let fetched = self.bytes(wanted)?.into_iter().flatten();
            let jobs: Vec<_> = jobs.into_iter().zip(fetched).collect();
            return jobs
                .into_par_iter()
                .with_max_len(1)
                .try_for_each(|((_, place, group), bytes)| finish(&place, &bytes, group));
        }
        let handles = files.iter().map(|file| self.handle(&file.path)).collect::<Result<Vec<_>>>()?;
        jobs.into_par_iter().with_max_len(1).try_for_each(|(at, place, group)| {
            SCRATCH.with_borrow_mut(|scratch| {
                scratch.resize((place.bytes.end - place.bytes.start) as usize, 0);
                handles[at]
                    .read_exact_at(scratch, place.bytes.start)
                    .map_err(|e| self.missing(Path::new(&files[at].path), e))?;
                finish(&place, scratch, group)
            })
        })
    }

    pub(super) fn decode(&self, column: &StoredColumn, row: u64, bytes: &[u8], out: &mut [u8]) -> Result<()> {
        let (height, width) = (column.spec.shape[0], column.spec.shape[1]);
        swm_image::decode(bytes, height, width, out).map_err(|problem| {
            damaged(self.folder(), format!("picture of row {row}, column '{}': {problem}", column.spec.name))
        })
    }
}

thread_local! {
    /// An encoded picture, between reading and decoding.
    static SCRATCH: RefCell<Vec<u8>> = const { RefCell::new(vec![]) };
}
