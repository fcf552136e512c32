//! Locates, verifies and opens the data files of a table.

use super::lance_reader::{LanceReader, lock};
use crate::dataset::Irregularity;
use crate::dataset::objects::ObjectRanges;
use crate::formats::lance::errors::damaged;
use crate::formats::lance::record::{EPISODES_KEY, Record};
use crate::formats::lance::store::{self, block_on};
use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use lance_core::datatypes::Schema as LanceSchema;
use lance_file::reader::{FileReader, ReaderProjection};
use lance_file::versions::reader_projection_from_field_ids;
use lance_table::format::DataFile;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use swm_core::{Error, Result, files};

/// Maximum number of data files in an object store that are opened concurrently.
const OPENED_TOGETHER: usize = 16;

/// Size in bytes up to which a data file is verified before any of its data is read, including the episode indices.
const SMALL_FILE: u64 = 1 << 20;

/// What is wrong with a data file that has another hash.
pub(super) const OTHER_CONTENT: &str = "its content does not match the hash in its name";

impl LanceReader {
    /// Opens data files in an object store concurrently, because opening one file takes several requests.
    /// Skips files that are already open.
    pub(super) fn open_together(&self, files: Vec<DataFile>) -> Result<()> {
        let store = self.store.clone();
        let missing: Vec<DataFile> = {
            let known = lock(&self.files);
            files.into_iter().filter(|file| known.get(&file.path).is_none()).collect()
        };
        let opened: Vec<(String, FileReader)> = block_on(self.folder(), "opening data files", async move {
            let opening = futures::stream::iter(missing).map(|file| {
                let store = store.clone();
                async move { Ok((file.path.clone(), store.open_file(&file).await?)) }
            });
            opening.buffered(OPENED_TOGETHER).try_collect().await
        })?;
        for (path, reader) in opened {
            lock(&self.files).insert(&path, &Arc::new(reader));
        }
        Ok(())
    }

    /// The file of a fragment that contains a column, and the table's schema of that column.
    pub(super) fn data_file(&self, fragment: usize, stored_name: &str) -> Result<(&DataFile, LanceSchema)> {
        let missing = || damaged(self.folder(), format!("fragment {fragment} has no column '{stored_name}'"));
        let projected = self.table.schema.project(&[stored_name]).map_err(|_| missing())?;
        let id = projected.fields.first().ok_or_else(missing)?.id;
        let holds = |file: &&DataFile| file.fields.contains(&id);
        let file = self.table.fragments[fragment].files.iter().find(holds).ok_or_else(missing)?;
        Ok((file, projected))
    }

    /// Verifies a local file against the hash in its name, once, before any of the file's data is decoded. Lance does
    /// not validate the file, so a flipped bit could cause an allocation of any size. A large file is verified only
    /// when data other than the episode indices is read (`reads_data`), so that opening a dataset does not read large
    /// files completely. Files in an object store are compared by [`LanceReader::false_names`] only, because reading a few of
    /// their bytes would transfer all of them.
    pub(super) fn verify(&self, file: &DataFile, reads_data: bool) -> Result<()> {
        let Some(expected) = store::hash_in_name(&file.path).filter(|_| !self.store.remote) else { return Ok(()) };
        if lock(&self.verified).contains(&file.path) {
            return Ok(());
        }
        let path = self.store.local(&self.store.data_path(&file.path));
        check_regular(&path)?;
        let io = |e: std::io::Error| self.file_error(&path, e);
        if !reads_data && std::fs::metadata(&path).map_err(io)?.len() > SMALL_FILE {
            return Ok(());
        }
        if store::hash_file(&path).map_err(io)? != expected {
            return Err(damaged(&path, OTHER_CONTENT));
        }
        lock(&self.verified).insert(file.path.clone());
        Ok(())
    }

    /// Finds the data files in an object store that do not have the hash in their name: their fragments and names.
    pub(super) fn false_names(&self) -> Result<Vec<(usize, String)>> {
        let mut found = vec![];
        for (index, fragment) in self.table.fragments.iter().enumerate().filter(|_| self.store.remote) {
            for file in &fragment.files {
                let Some(expected) = store::hash_in_name(&file.path) else { continue };
                if lock(&self.verified).contains(&file.path) {
                    continue;
                }
                let path = self.store.data_path(&file.path);
                if self.store.hash_object(&path).map_err(|error| self.explained(error))? == expected {
                    lock(&self.verified).insert(file.path.clone());
                } else {
                    found.push((index, file.path.clone()));
                }
            }
        }
        Ok(found)
    }

    /// Finds the episodes of data files in an object store that have other content than their name says.
    pub(super) fn false_files(&self) -> Result<Vec<Irregularity>> {
        let fragments: Vec<_> = self.episodes_of_fragments().collect();
        let of_file = |(fragment, name): (usize, String)| {
            let episodes = fragments[fragment].clone();
            // A fragment may have rows of an earlier episode only.
            let affected = if episodes.is_empty() { vec![None] } else { episodes.map(Some).collect() };
            let what = format!("its data file {name}: {}", OTHER_CONTENT);
            affected.into_iter().map(move |episode| Irregularity { episode, what: what.clone() })
        };
        Ok(self.false_names()?.into_iter().flat_map(of_file).collect())
    }

    pub(super) fn file_error(&self, path: &Path, error: std::io::Error) -> Error {
        match error.kind() {
            std::io::ErrorKind::NotFound => damaged(path, "a data file is missing"),
            std::io::ErrorKind::UnexpectedEof => damaged(path, "a data file is too short"),
            _ => Error::io(path, "reading a data file", error),
        }
    }

    /// The open file of a fragment that contains a column, and the column's projection in it.
    pub(super) fn locate(&self, fragment: usize, stored_name: &str) -> Result<(Arc<FileReader>, ReaderProjection)> {
        let (file, projected) = self.data_file(fragment, stored_name)?;
        let indices: BTreeMap<u32, u32> = file
            .fields
            .iter()
            .zip(file.column_indices.iter())
            .filter(|&(&field, &column)| field >= 0 && column >= 0)
            .map(|(&field, &column)| (field as u32, column as u32))
            .collect();
        let reader = self.file(file)?;
        let projection = reader_projection_from_field_ids(reader.version(), &projected, &indices)
            .map_err(|e| damaged(self.folder(), e.to_string()))?;
        Ok((reader, projection))
    }

    pub(super) fn file(&self, file: &DataFile) -> Result<Arc<FileReader>> {
        if let Some(reader) = lock(&self.files).get(&file.path) {
            return Ok(reader);
        }
        if !self.store.remote {
            check_regular(&self.store.local(&self.store.data_path(&file.path)))?;
        }
        let (store, data_file) = (self.store.clone(), file.clone());
        let path = self.folder().join("data").join(&file.path);
        let reader = block_on(&path, "opening a data file", async move { store.open_file(&data_file).await })?;
        let reader = Arc::new(reader);
        lock(&self.files).insert(&file.path, &reader);
        Ok(reader)
    }

    /// A local data file, opened for reading at offsets.
    pub(super) fn handle(&self, path: &str) -> Result<Arc<File>> {
        if let Some(file) = lock(&self.handles).get(path) {
            return Ok(file);
        }
        let local = self.store.local(&self.store.data_path(path));
        check_regular(&local)?;
        let file = Arc::new(File::open(&local).map_err(|e| self.file_error(&local, e))?);
        lock(&self.handles).insert(path, &file);
        Ok(file)
    }

    /// Reads byte ranges of data files in an object store.
    pub(super) fn bytes(&self, ranges: Vec<ObjectRanges>) -> Result<Vec<Vec<Bytes>>> {
        let (store, blocks) = (self.store.clone(), Arc::clone(&self.blocks));
        block_on(self.folder(), "reading data files", async move { Ok(blocks.read(store.inner(), &ranges).await?) })
    }

    /// The record of a fragment's data file, and the file that contains it.
    pub(super) fn record(&self, fragment: usize) -> Result<Option<(Arc<FileReader>, Record)>> {
        for file in &self.table.fragments[fragment].files {
            self.verify(file, false)?;
            let reader = self.file(file)?;
            if let Some(stored) = self.buffer(&reader, EPISODES_KEY)? {
                let record = Record::decode(&stored).map_err(|problem| damaged(self.folder(), problem))?;
                return Ok(Some((reader, record)));
            }
        }
        Ok(None)
    }

    /// The global buffer whose index is stored under `key` in the file's metadata.
    pub(super) fn buffer(&self, reader: &Arc<FileReader>, key: &str) -> Result<Option<Bytes>> {
        let Some(index) = reader.schema().metadata.get(key).and_then(|index| index.parse::<u32>().ok()) else {
            return Ok(None);
        };
        let reader = Arc::clone(reader);
        let read = async move { reader.read_global_buffer(index).await.map(Some) };
        block_on(self.folder(), "reading the record of a data file", read)
    }
}

/// Checks that a local data file is a regular file, if it exists: reading a pipe would block, and a device never ends.
fn check_regular(path: &Path) -> Result<()> {
    if path.exists() { files::open(path).map(drop) } else { Ok(()) }
}
