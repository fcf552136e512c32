//! A table that is being written: its data files and its versions.

use super::encode::EncodedEpisode;
use super::reader::LanceReader;
use super::record::{CONSTANTS_KEY, EPISODES_KEY, Record};
use super::schema;
use super::store::{self, Store, Version, block_on};
use arrow_array::{ArrayRef, Int32Array, RecordBatch};
use arrow_schema::Schema as ArrowSchema;
use bytes::Bytes;
use lance_core::datatypes::Schema as LanceSchema;
use lance_file::version::ConcreteFileVersion;
use lance_file::versions::create_writer;
use lance_file::writer::FileWriterOptions;
use lance_io::object_store::ObjectStore;
use lance_table::format::{DataFile, DataStorageFormat, Fragment, ManifestBuildConfig};
use lance_table::transaction::{Operation, UpdateMap, UpdateMapEntry};
use object_store::path::Path as StorePath;
use std::collections::VecDeque;
use std::num::NonZero;
use std::sync::Arc;
use std::time::SystemTime;
use swm_core::columns::EPISODE_IDX;
use swm_core::{Error, Result};

/// The version of the file format of new tables; the reference implementation uses the same version.
const FILE_VERSION: ConcreteFileVersion = ConcreteFileVersion::V2_2;

/// Number of this writer's versions that are retained for readers that have just opened one of these versions. Every
/// version lists all fragments, so retaining all versions would take space quadratic in the number of commits.
const RETAINED_VERSIONS: usize = 8;

/// The key in a data file's metadata whose value makes every file unique.
const MADE_KEY: &str = "stable_worldmodel.made";

/// Maximum number of attempts per commit. Each failed attempt means that another writer committed.
pub const MAX_ATTEMPTS: usize = 1000;

/// A table and its newest version.
pub struct Table {
    pub store: Store,
    pub version: Option<Version>,
    /// The schema of a new or replaced table.
    fresh: LanceSchema,
    /// Whether the next commit replaces the version, so that data files have the columns of `fresh`.
    pub replaces: bool,
    file_version: ConcreteFileVersion,
    /// Manifests of versions that this writer committed, oldest first.
    manifests: VecDeque<StorePath>,
}

impl Table {
    /// The table at `version`, or for `None` a new table with the schema `fresh`.
    pub fn new(store: Store, version: Option<Version>, fresh: LanceSchema) -> Self {
        let file_version =
            version.as_ref().map_or(FILE_VERSION, |version| version.manifest.data_storage_format.lance_file_format());
        Self { store, version, fresh, replaces: false, file_version, manifests: VecDeque::new() }
    }

    /// The schema, with the field ids of the existing table if the table exists and is not replaced.
    pub fn fields(&self) -> &LanceSchema {
        let kept = self.version.as_ref().filter(|_| !self.replaces);
        kept.map_or(&self.fresh, |version| &version.manifest.schema)
    }

    /// The operation that replaces the table's content with `fragments`.
    pub fn overwrite_operation(&self, fragments: Vec<Fragment>) -> Operation {
        Operation::Overwrite { fragments, schema: self.fresh.clone(), config_upsert_values: None, initial_bases: None }
    }

    /// Commits an operation. Returns `false`, without any effect, if another process committed in the meantime.
    ///
    /// # Errors
    /// If writing fails.
    pub fn commit(&mut self, operation: Operation) -> Result<bool> {
        let config = ManifestBuildConfig {
            auto_set_feature_flags: true,
            timestamp_nanos: SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_nanos()),
            use_stable_row_ids: false,
            use_legacy_format: None,
            storage_format: Some(DataStorageFormat::new(self.file_version)),
            disable_transaction_file: false,
            migration_next_row_id: None,
            activate_non_reusable_field_ids: false,
            spilled_row_lineage: Arc::default(),
        };
        let Some((version, manifest)) = self.store.commit(self.version.as_ref(), operation, config)? else {
            return Ok(false);
        };
        self.version = Some(version);
        self.manifests.push_back(manifest);
        if self.manifests.len() > RETAINED_VERSIONS
            && let Some(oldest) = self.manifests.pop_front()
        {
            self.store.remove(&oldest);
        }
        Ok(true)
    }

    /// Loads the version that another process committed, and returns the next free `episode_idx`.
    ///
    /// # Errors
    /// If the table was removed or its columns changed.
    pub fn refresh(&mut self) -> Result<i64> {
        let replaced = || {
            let problem = format!("another process replaced {} meanwhile", self.store.label.display());
            Error::config("dataset", problem, "write to a dataset with another name, or collect these episodes again")
        };
        let latest = self.store.latest()?.ok_or_else(replaced)?;
        let columns = |schema: &LanceSchema| {
            let fields = ArrowSchema::from(schema).fields;
            fields.iter().map(|field| (field.name().clone(), field.data_type().clone())).collect::<Vec<_>>()
        };
        if columns(self.fields()) != columns(&latest.manifest.schema) {
            return Err(replaced());
        }
        let reader = LanceReader::of(self.store.clone(), Arc::clone(&latest.manifest))?;
        self.version = Some(latest);
        Ok(reader.next_episode())
    }

    /// The operation that replaces the stored manifest, or `None` if `manifest` is stored already.
    pub fn manifest_operation(&self, manifest: String) -> Option<Operation> {
        if self.fields().metadata.get(schema::MANIFEST_KEY) == Some(&manifest) {
            return None;
        }
        let entry = UpdateMapEntry { key: schema::MANIFEST_KEY.to_owned(), value: Some(manifest) };
        Some(Operation::UpdateConfig {
            config_updates: None,
            table_metadata_updates: None,
            schema_metadata_updates: Some(UpdateMap { update_entries: vec![entry], replace: false }),
            field_metadata_updates: Default::default(),
        })
    }

    /// Writes episodes to a new data file. Episodes are numbered from `first` on; with `None`, the file contains no
    /// `episode_idx`, and [`Table::write_episode_indices`] must add it.
    ///
    /// # Errors
    /// If there are too many episodes, or writing fails.
    pub fn write_episodes(&self, episodes: &[EncodedEpisode], first: Option<i64>) -> Result<Fragment> {
        let mut record = Record::default();
        let mut batches = vec![];
        let all = ArrowSchema::from(self.fields());
        let (skipped, fields) = match first {
            Some(_) => (0, self.fields().clone()),
            None => {
                let names: Vec<&str> = all.fields().iter().skip(1).map(|field| field.name().as_str()).collect();
                (1, self.fields().project(&names).map_err(|e| Error::external("writing a data file", e))?)
            }
        };
        let arrow = Arc::new(ArrowSchema::new(all.fields().iter().skip(skipped).cloned().collect::<Vec<_>>()));
        for (at, episode) in (0_i64..).zip(episodes) {
            let indices = first.map(|first| episode_indices(first + at, episode.rows as usize)).transpose()?;
            let values = indices.into_iter().chain(episode.values.iter().cloned()).collect();
            let batch = RecordBatch::try_new(Arc::clone(&arrow), values);
            batches.push(batch.map_err(|e| Error::external("writing an episode", e))?);
            record.push(episode.rows as u64, episode.hash.clone(), &episode.constants);
        }
        let rows: usize = batches.iter().map(RecordBatch::num_rows).sum();
        let file = self.write_file(fields, batches, Some(record.encode()?))?;
        Ok(Fragment { files: vec![file], ..Fragment::new(0) }.with_physical_rows(rows))
    }

    /// Writes `episode_idx` of a fragment to a separate data file. `rows` are the lengths of the fragment's episodes.
    ///
    /// # Errors
    /// As [`Table::write_episodes`].
    pub fn write_episode_indices(&self, rows: &[u64], first: i64) -> Result<DataFile> {
        let fields = self.fields().project(&[EPISODE_IDX]).map_err(|e| Error::external("numbering episodes", e))?;
        let arrow = Arc::new(ArrowSchema::from(&fields));
        let batches: Result<Vec<RecordBatch>> = (first..)
            .zip(rows)
            .map(|(index, &rows)| {
                let batch = RecordBatch::try_new(Arc::clone(&arrow), vec![episode_indices(index, rows as usize)?]);
                batch.map_err(|e| Error::external("numbering episodes", e))
            })
            .collect();
        self.write_file(fields, batches?, None)
    }

    /// Writes a data file. The file is assembled in memory, because its name is the hash of its content, and becomes
    /// visible only when it is complete.
    fn write_file(
        &self,
        fields: LanceSchema,
        batches: Vec<RecordBatch>,
        record: Option<(Bytes, Option<Bytes>)>,
    ) -> Result<DataFile> {
        let version = self.file_version;
        let (file, ids, columns) = block_on(&self.store.label, "writing a data file", async move {
            let (memory, path) = (ObjectStore::memory(), StorePath::from("file"));
            let mut writer = create_writer(version, memory.create(&path).await?, fields, FileWriterOptions::default())?;
            for batch in &batches {
                writer.write_batch(batch).await?;
            }
            if let Some((episodes, constants)) = record {
                let buffer = writer.add_global_buffer(episodes).await?;
                writer.add_schema_metadata(EPISODES_KEY, buffer.to_string());
                if let Some(constants) = constants {
                    let buffer = writer.add_global_buffer(constants).await?;
                    writer.add_schema_metadata(CONSTANTS_KEY, buffer.to_string());
                }
            }
            // The value is unique, so that two writers never produce files with the same name, and no writer removes a
            // file of another writer.
            writer.add_schema_metadata(MADE_KEY, uuid::Uuid::new_v4().simple().to_string());
            writer.finish().await?;
            let indices = writer.field_id_to_column_indices().iter().copied();
            let (ids, columns): (Vec<i32>, Vec<i32>) = indices.map(|(id, column)| (id as i32, column as i32)).unzip();
            Ok((memory.read_one_all(&path).await?, ids, columns))
        })?;
        let name = store::name_of_hash(blake3::hash(&file));
        let size = NonZero::new(file.len() as u64);
        self.store.write(&self.store.data_path(&name), file)?;
        Ok(DataFile::new(name, ids, columns, version, size, None))
    }

    /// Removes the data files of a fragment that was not committed.
    pub fn discard(&self, fragment: &Fragment) {
        for file in &fragment.files {
            self.store.remove(&self.store.data_path(&file.path));
        }
    }

    /// Removes data files and manifests of replaced versions, after the new version is committed. After a kill in between,
    /// the remaining files only waste space.
    pub fn remove_replaced(&self, old: &Version) {
        old.manifest.fragments.iter().for_each(|fragment| self.discard(fragment));
        for version in self.store.list("_versions").unwrap_or_default() {
            let is_version = version.location.filename().is_some_and(store::is_version);
            let old = is_version && !self.manifests.contains(&version.location);
            if old {
                self.store.remove(&version.location);
            }
        }
    }
}

/// An `episode_idx` column: the same value in every row.
fn episode_indices(index: i64, rows: usize) -> Result<ArrayRef> {
    let Ok(index) = i32::try_from(index) else {
        return Err(Error::mismatch("writing an episode", "2^31 or more episodes", "fewer episodes"));
    };
    Ok(Arc::new(Int32Array::from(vec![index; rows])))
}
