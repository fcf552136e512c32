//! Reads the images of a batch from their locations and decodes them in parallel.

use super::lance_reader::{FileImages, LanceReader, RowSlot, lock, max_open_files, merged};
use crate::dataset::objects::{self, ObjectRanges};
use crate::formats::lance::convert::image_bytes;
use crate::formats::lance::errors::damaged;
use crate::formats::lance::image_locations::{ImageLocation, ImageLocations};
use crate::formats::lance::schema::StoredColumn;
use crate::formats::lance::store::block_on;
use rayon::prelude::*;
use std::cell::RefCell;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::Arc;
use swm_core::Result;

impl LanceReader {
    /// Locations of a column's images in a fragment; `None` if the column needs Lance's decoder.
    pub(super) fn locate_images(&self, fragment: usize, column: &str) -> Result<Option<Arc<FileImages>>> {
        let key = (fragment, column.to_owned());
        if let Some(known) = lock(&self.image_locations).get(&key) {
            return Ok(known.clone());
        }
        let (file, _) = self.data_file(fragment, column)?;
        self.verify(file, true)?;
        let (reader, projection) = self.locate(fragment, column)?;
        let metadata = reader.metadata();
        let found = match projection.column_indices[..] {
            [index] => match metadata.column_infos.get(index as usize) {
                Some(info) => ImageLocations::read(info, metadata.file_size_bytes, |ranges| {
                    let store = self.store.clone();
                    let (path, ranges) = (store.data_path(&file.path), ranges.to_vec());
                    block_on(self.folder(), "reading the locations of images", async move {
                        Ok(objects::fetch(store.inner(), &path, &ranges).await?)
                    })
                })?,
                None => None,
            },
            _ => None,
        };
        let found = found.map(|locations| {
            Arc::new(FileImages { path: file.path.clone(), size: metadata.file_size_bytes, locations })
        });
        lock(&self.image_locations).insert(key, found.clone());
        Ok(found)
    }

    /// A request for a data file, without byte ranges so far.
    pub(super) fn ranges_of(&self, file: &FileImages) -> ObjectRanges {
        ObjectRanges { path: self.store.data_path(&file.path), size: file.size, ranges: vec![] }
    }

    pub(super) fn read_images(&self, column: &StoredColumn, requested: &mut [RowSlot]) -> Result<()> {
        let mut located = vec![];
        let mut unlocated: Vec<&mut RowSlot> = vec![];
        for rows in requested.chunk_by_mut(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
            let fragment = self.fragment_of(rows[0].0);
            match self.locate_images(fragment, &column.name)? {
                Some(images) => located.push((self.fragment_rows[fragment], images, rows)),
                None => unlocated.extend(rows),
            }
        }
        for fragments in located.chunks_mut(max_open_files(&self.store)) {
            self.read_located_images(column, fragments)?;
        }
        let stored = self.stored_rows(&column.name, &merged(&unlocated))?;
        let mut groups = unlocated.chunk_by_mut(|a, b| a.0 == b.0);
        let mut jobs = vec![];
        for rows in &stored {
            for (i, group) in (0..rows.rows).zip(groups.by_ref()) {
                jobs.push((image_bytes(&rows.values, i)?, group));
            }
        }
        jobs.into_par_iter().with_max_len(1).try_for_each(|(bytes, group)| {
            let Some(((row, first), repeats)) = group.split_first_mut().map(|(a, b)| ((a.0, &mut *a.1), b)) else {
                return Ok(());
            };
            self.decode(column, row, bytes, first)?;
            repeats.iter_mut().for_each(|(_, slot)| slot.copy_from_slice(first));
            Ok(())
        })
    }

    /// Reads and decodes images with known locations. Each fragment is `(first row, images, requested rows)`.
    pub(super) fn read_located_images(
        &self,
        column: &StoredColumn,
        fragments: &mut [(u64, Arc<FileImages>, &mut [RowSlot])],
    ) -> Result<()> {
        let files: Vec<Arc<FileImages>> = fragments.iter().map(|(_, images, _)| Arc::clone(images)).collect();
        let mut jobs = vec![];
        for (at, (first_row, images, rows)) in fragments.iter_mut().enumerate() {
            for group in rows.chunk_by_mut(|a, b| a.0 == b.0) {
                let row = group[0].0;
                let location = images.locations.find(row - *first_row).ok_or_else(|| {
                    damaged(self.folder(), format!("row {row} of column '{}' lies outside its data file", column.name))
                })?;
                jobs.push((at, location, group));
            }
        }
        let finish = |location: &ImageLocation, bytes: &[u8], group: &mut [RowSlot]| {
            let Some(((row, first), repeats)) = group.split_first_mut() else { return Ok(()) };
            let image = location.image(bytes).ok_or_else(|| {
                damaged(self.folder(), format!("row {row} of column '{}' has a wrong length prefix", column.name))
            })?;
            self.decode(column, *row, image, first)?;
            repeats.iter_mut().for_each(|(_, slot)| slot.copy_from_slice(first));
            Ok(())
        };
        if self.store.remote {
            let mut requested: Vec<ObjectRanges> = files.iter().map(|file| self.ranges_of(file)).collect();
            jobs.iter().for_each(|(at, location, _)| requested[*at].ranges.push(location.bytes.clone()));
            let fetched = self.bytes(requested)?.into_iter().flatten();
            let jobs: Vec<_> = jobs.into_iter().zip(fetched).collect();
            return jobs
                .into_par_iter()
                .with_max_len(1)
                .try_for_each(|((_, location, group), bytes)| finish(&location, &bytes, group));
        }
        let handles = files.iter().map(|file| self.handle(&file.path)).collect::<Result<Vec<_>>>()?;
        jobs.into_par_iter().with_max_len(1).try_for_each(|(at, location, group)| {
            SCRATCH.with_borrow_mut(|scratch| {
                scratch.resize((location.bytes.end - location.bytes.start) as usize, 0);
                handles[at]
                    .read_exact_at(scratch, location.bytes.start)
                    .map_err(|e| self.file_error(Path::new(&files[at].path), e))?;
                finish(&location, scratch, group)
            })
        })
    }

    pub(super) fn decode(&self, column: &StoredColumn, row: u64, bytes: &[u8], out: &mut [u8]) -> Result<()> {
        let (height, width) = (column.spec.shape[0], column.spec.shape[1]);
        swm_image::decode(bytes, height, width, out).map_err(|problem| {
            damaged(self.folder(), format!("image of row {row}, column '{}': {problem}", column.spec.name))
        })
    }
}

thread_local! {
    /// Buffer for an encoded image between reading and decoding.
    static SCRATCH: RefCell<Vec<u8>> = const { RefCell::new(vec![]) };
}
