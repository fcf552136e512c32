//! The newest version of a table, which another process may replace while it is read.

use super::{Store, Version, block_on};
use crate::formats::lance::manifest_file;
use arrow_schema::Schema as ArrowSchema;
use bytes::Bytes;
use lance_io::object_store::ObjectStore;
use lance_table::feature_flags::ensure_can_read_manifest;
use lance_table::io::commit::ManifestLocation;
use lance_table::io::manifest::{read_manifest, read_manifest_indexes};
use std::sync::Arc;
use swm_core::Result;

impl Store {
    /// The newest version; `None` if there is no table yet.
    ///
    /// # Errors
    /// If the folder holds other files, or the newest version cannot be read.
    pub fn latest(&self) -> Result<Option<Version>> {
        if self.lists && !self.has_versions()? {
            return self.check_free().map(|()| None);
        }
        let store = self.clone();
        block_on(&self.label, "reading the newest version", async move {
            let (location, bytes) = store.newest_manifest().await?;
            manifest_file::verify_checksum(&bytes)?;
            // Lance parses the verified bytes, not the object, which may have changed.
            let memory = ObjectStore::memory();
            memory.put(&location.path, &bytes).await?;
            let manifest = read_manifest(&memory, &location.path, Some(bytes.len() as u64)).await?;
            if manifest.version != location.version {
                return Err(manifest_file::corrupt(format!(
                    "version {} is stored as version {}",
                    manifest.version, location.version
                )));
            }
            ensure_can_read_manifest(&manifest)?;
            let indices = read_manifest_indexes(&memory, &location, &manifest).await?;
            // Converting the schema here turns Lance's panic on unknown types into an error.
            let _ = ArrowSchema::from(&manifest.schema);
            Ok(Some(Version { manifest: Arc::new(manifest), indices }))
        })
    }

    /// Calls `work` with the newest version, and again if it fails after another process committed a newer one: the files of a
    /// version that was replaced are gone.
    ///
    /// # Errors
    /// Those of [`Store::latest`] and of `work`.
    pub fn with_latest<T>(&self, mut work: impl FnMut(Option<Version>) -> Result<T>) -> Result<T> {
        let number = |found: &Option<Version>| found.as_ref().map(|found| found.manifest.version);
        let mut found = self.latest()?;
        loop {
            let tried = number(&found);
            let result = work(found);
            if result.is_ok() {
                return result;
            }
            found = self.latest()?;
            if number(&found) == tried {
                return result;
            }
        }
    }

    /// The manifest of the newest version. One that is gone when it is read was replaced by a newer one.
    async fn newest_manifest(&self) -> lance_core::Result<(ManifestLocation, Bytes)> {
        let mut newest = self.latest_location().await?;
        loop {
            let read = manifest_file::read_whole(&self.objects, &newest.path).await;
            if !matches!(read, Err(lance_core::Error::NotFound { .. })) {
                return Ok((newest, read?));
            }
            let now = self.latest_location().await?;
            if now.version == newest.version {
                return Ok((now, read?));
            }
            newest = now;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Location, WriteMode, WriteOptions};
    use std::path::Path;
    use swm_core::{Batch, ColumnSpec, DType, Error, Schema};

    fn write(path: &Path, mode: WriteMode) {
        let schema = Schema::new([ColumnSpec::new("x", DType::Float32, [])]).expect("a schema");
        let options = WriteOptions { mode, ..WriteOptions::default() };
        let mut writer = crate::create(path, &schema, options).expect("creating the table");
        writer.write_episode(&Batch::zeros(&schema, 3)).expect("writing an episode");
        writer.finish().expect("finishing the table");
    }

    #[test]
    fn work_that_fails_in_a_version_that_was_replaced_starts_again() {
        let folder = tempfile::tempdir().expect("creating a folder");
        let path = folder.path().join("d.lance");
        write(&path, WriteMode::Create);
        let store = Store::new(&Location::from(&path)).expect("a table");
        let failed = || Error::config("work", "failed", "try again");
        let mut seen = vec![];
        let worked = store.with_latest(|found| {
            seen.push(found.expect("a version").manifest.version);
            if seen.len() == 1 {
                write(&path, WriteMode::Overwrite);
                return Err(failed());
            }
            Ok(())
        });
        worked.expect("the second attempt");
        assert!(seen.len() == 2 && seen[1] > seen[0], "{seen:?}");
        let mut calls = 0;
        let result: Result<()> = store.with_latest(|_| {
            calls += 1;
            Err(failed())
        });
        assert!(result.is_err() && calls == 1, "{calls}");
    }
}
