//! A table that is written to: its data files, its versions.

use super::encode::Encoded;
use super::reader::LanceReader;
use super::record::{CONSTANTS_KEY, EPISODES_KEY, Record};
use super::schema::{self, EPISODE};
use super::store::{self, Store, Version, wait};
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
use swm_core::{Error, Result};

/// The file format of new tables, which is also what the reference's tables have.
const FILE_VERSION: ConcreteFileVersion = ConcreteFileVersion::V2_2;

/// Versions of our own that are kept, for readers that just opened one. Each holds the list of all fragments,
/// so keeping every version of a long collection would take space that grows with its square.
const KEPT_VERSIONS: usize = 8;

/// The key in a data file's metadata that makes it unlike all others.
const MADE_KEY: &str = "stable_worldmodel.made";

/// How often a commit is tried again because others were faster. Each of them got something done.
pub const TRIES: usize = 1000;

/// A table and its newest version.
pub struct Table {
    pub store: Store,
    pub version: Option<Version>,
    /// The fields of new tables, as the first version will have them.
    fresh: LanceSchema,
    file_version: ConcreteFileVersion,
    /// Manifests of versions that this writer committed, oldest first.
    manifests: VecDeque<StorePath>,
}

impl Table {
    /// The table of a store: in this version, or one that is not there yet, with these fields.
    pub fn new(store: Store, version: Option<Version>, fresh: LanceSchema) -> Self {
        let file_version =
            version.as_ref().map_or(FILE_VERSION, |version| version.manifest.data_storage_format.lance_file_format());
        Self { store, version, fresh, file_version, manifests: VecDeque::new() }
    }

    /// The fields; their ids are those of the table, which a foreign table may number differently.
    pub fn fields(&self) -> &LanceSchema {
        self.version.as_ref().map_or(&self.fresh, |version| &version.manifest.schema)
    }

    /// The operation that makes the table anew, of these fragments.
    pub fn made_anew(&self, fragments: Vec<Fragment>) -> Operation {
        Operation::Overwrite { fragments, schema: self.fresh.clone(), config_upsert_values: None, initial_bases: None }
    }

    /// Commits an operation; `false` when somebody else committed meanwhile, and nothing was done.
    ///
    /// # Errors
    /// When the system refuses.
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
        if self.manifests.len() > KEPT_VERSIONS
            && let Some(oldest) = self.manifests.pop_front()
        {
            self.store.remove(&oldest);
        }
        Ok(true)
    }

    /// Looks what others committed, and gives the number of the next episode.
    ///
    /// # Errors
    /// When they removed the table or gave it other columns.
    pub fn refresh(&mut self) -> Result<i64> {
        let replaced = || {
            let problem = format!("another process replaced {} meanwhile", self.store.label.display());
            Error::config("dataset", problem, "write to one of another name, or collect these episodes again")
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

    /// The operation that replaces the stored manifest (where the data come from), unless it is the same.
    pub fn described(&self, manifest: String) -> Option<Operation> {
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

    /// Writes episodes to a new data file: numbered from `first` on, or without numbers, which are then to be added by
    /// [`Table::write_numbers`].
    ///
    /// # Errors
    /// When there are too many episodes, or the system refuses.
    pub fn write_episodes(&self, episodes: &[Encoded], first: Option<i64>) -> Result<Fragment> {
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
            let numbers = first.map(|first| numbers(first + at, episode.rows as usize)).transpose()?;
            let values = numbers.into_iter().chain(episode.values.iter().cloned()).collect();
            let batch = RecordBatch::try_new(Arc::clone(&arrow), values);
            batches.push(batch.map_err(|e| Error::external("writing an episode", e))?);
            record.push(episode.rows as u64, episode.hash.clone(), &episode.constants);
        }
        let rows: usize = batches.iter().map(RecordBatch::num_rows).sum();
        let file = self.write_file(fields, batches, Some(record.encode()?))?;
        Ok(Fragment { files: vec![file], ..Fragment::new(0) }.with_physical_rows(rows))
    }

    /// Writes the numbers of a fragment's episodes, which have so many rows each, to a data file of their own.
    ///
    /// # Errors
    /// As [`Table::write_episodes`].
    pub fn write_numbers(&self, rows: &[u64], first: i64) -> Result<DataFile> {
        let fields = self.fields().project(&[EPISODE]).map_err(|e| Error::external("numbering episodes", e))?;
        let arrow = Arc::new(ArrowSchema::from(&fields));
        let batches: Result<Vec<RecordBatch>> = (first..)
            .zip(rows)
            .map(|(number, &rows)| {
                let batch = RecordBatch::try_new(Arc::clone(&arrow), vec![numbers(number, rows as usize)?]);
                batch.map_err(|e| Error::external("numbering episodes", e))
            })
            .collect();
        self.write_file(fields, batches?, None)
    }

    /// Writes a data file. It is made in memory, as its name is the hash of its content; and so it is there as a whole
    /// or not at all.
    fn write_file(
        &self,
        fields: LanceSchema,
        batches: Vec<RecordBatch>,
        record: Option<(Bytes, Option<Bytes>)>,
    ) -> Result<DataFile> {
        let version = self.file_version;
        let (file, ids, columns) = wait(&self.store.label, "writing a data file", async move {
            let (memory, path) = (ObjectStore::memory(), StorePath::from("file"));
            let mut writer = create_writer(version, memory.create(&path).await?, fields, FileWriterOptions::default())?;
            for batch in &batches {
                writer.write_batch(batch).await?;
            }
            if let Some((episodes, constants)) = record {
                let number = writer.add_global_buffer(episodes).await?;
                writer.add_schema_metadata(EPISODES_KEY, number.to_string());
                if let Some(constants) = constants {
                    let number = writer.add_global_buffer(constants).await?;
                    writer.add_schema_metadata(CONSTANTS_KEY, number.to_string());
                }
            }
            // Two writers never make the same file, of which one would be the other's to remove.
            writer.add_schema_metadata(MADE_KEY, uuid::Uuid::new_v4().simple().to_string());
            writer.finish().await?;
            let places = writer.field_id_to_column_indices().iter().copied();
            #[allow(clippy::cast_possible_wrap)]
            let (ids, columns): (Vec<i32>, Vec<i32>) = places.map(|(id, column)| (id as i32, column as i32)).unzip();
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

    /// Removes what only older versions use, after everything was replaced.
    pub fn remove_replaced(&self, old: &Version) {
        old.manifest.fragments.iter().for_each(|fragment| self.discard(fragment));
        for version in self.store.list("_versions").unwrap_or_default() {
            let old = version.location.extension() == Some("manifest") && !self.manifests.contains(&version.location);
            if old {
                self.store.remove(&version.location);
            }
        }
    }
}

/// The number of an episode, once a row.
fn numbers(number: i64, rows: usize) -> Result<ArrayRef> {
    let Ok(number) = i32::try_from(number) else {
        return Err(Error::mismatch("writing an episode", "2^31 episodes or more", "fewer"));
    };
    Ok(Arc::new(Int32Array::from(vec![number; rows])))
}
