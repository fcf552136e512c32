//! Writing episodes: encode in the caller's thread (all pictures in parallel), commit in a thread of our own.
//!
//! Finished episodes gather until the [`CommitPolicy`] says that the group is due; the group becomes one
//! fragment (one data file) and one new version of the table, committed atomically. So a reader never sees a
//! part of an episode, and a killed process loses the current group at most.

use super::schema::{self, EPISODE, Kind, STEP, StoredColumn};
use super::store::{self, Store, Version, table_folder, wait};
use crate::Location;
use crate::clip::ACTION;
use crate::format::{CommitPolicy, Constants, WriteMode, WriteOptions, Writer};
use crate::image::ImageCodec;
use arrow_array::{ArrayRef, BinaryArray, FixedSizeListArray, Float32Array, Int32Array, RecordBatch};
use arrow_buffer::{Buffer, OffsetBuffer, ScalarBuffer};
use arrow_schema::Schema as ArrowSchema;
use lance_core::datatypes::Schema as LanceSchema;
use lance_file::version::ConcreteFileVersion;
use lance_file::versions::create_writer;
use lance_file::writer::FileWriterOptions;
use lance_table::format::{DataStorageFormat, Fragment, ManifestBuildConfig};
use lance_table::transaction::{Operation, UpdateMap, UpdateMapEntry};
use rayon::prelude::*;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Instant, SystemTime};
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};

/// The file format of new tables, which is also what the reference's tables have.
const FILE_VERSION: ConcreteFileVersion = ConcreteFileVersion::V2_2;

/// Episodes that may wait for the committing thread; bounds the memory together with the policy's bytes.
const WAITING: usize = 2;

/// Versions of our own that are kept, for readers that just opened one. Each holds the list of all fragments,
/// so keeping every version of a long collection would take space that grows with its square.
const KEPT_VERSIONS: usize = 8;

/// Creates, continues or replaces a table.
pub fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let path = location.local("lance")?;
    options.codec.check()?;
    let mut columns = schema::columns_to_write(schema)?;
    let folder = table_folder(path)?;
    let store = Store::new(&folder)?;
    let found = store.latest()?;
    let metadata = schema::metadata(schema, options.codec, options.manifest.as_ref())?;
    let mut fresh =
        LanceSchema::try_from(&schema::arrow_schema(&columns)).map_err(|e| Error::external("making the table", e))?;
    fresh.metadata = metadata;
    let overwrite =
        Operation::Overwrite { fragments: vec![], schema: fresh, config_upsert_values: None, initial_bases: None };
    let mut table = Table { store, version: None, file_version: FILE_VERSION, manifests: VecDeque::new() };
    let (mut episodes, mut next) = (0, 0);
    match (options.mode, found) {
        (_, None) => table.commit(overwrite)?,
        (WriteMode::Create, Some(_)) => {
            return Err(Error::config(
                "dataset",
                format!("{} exists already", folder.display()),
                "choose another path, or say whether to append to it or to overwrite it",
            ));
        }
        (WriteMode::Overwrite, Some(old)) => {
            table.version = Some(old.clone());
            table.commit(overwrite)?;
            table.remove_replaced(&old);
        }
        (WriteMode::Append, Some(old)) => {
            let known = super::reader::open(&Location::from(&folder))?;
            columns = continued(&folder, columns, &old, known.schema())?;
            episodes = known.episodes().len();
            next = known.episodes().iter().map(|episode| episode.index + 1).max().unwrap_or(0);
            table.file_version = old.manifest.data_storage_format.lance_file_format();
            table.version = Some(old);
            if let Some(manifest) = &options.manifest {
                table.describe(schema::json(manifest)?)?;
            }
        }
    }
    let state = Arc::new(Mutex::new(None));
    let arrow = Arc::new(schema::arrow_schema(&columns));
    let (sender, receiver) = sync_channel(WAITING);
    let committer = Committer {
        table,
        schema: Arc::clone(&arrow),
        policy: options.commit,
        group: vec![],
        bytes: 0,
        failure: Arc::clone(&state),
    };
    let thread = std::thread::Builder::new()
        .name("swm-commit".to_owned())
        .spawn(move || committer.run(&receiver))
        .map_err(|e| Error::io(&folder, "starting the committing thread", e))?;
    Ok(Box::new(LanceWriter {
        folder,
        incoming: schema.clone(),
        columns,
        arrow,
        codec: options.codec,
        episodes,
        next,
        queue: Some(sender),
        thread: Some(thread),
        failure: state,
        reported: false,
    }))
}

/// The incoming columns in the order of the table to continue.
fn continued(
    folder: &Path,
    mut incoming: Vec<StoredColumn>,
    old: &Version,
    known: &Schema,
) -> Result<Vec<StoredColumn>> {
    let stored = ArrowSchema::from(&old.manifest.schema);
    let offered = schema::arrow_schema(&incoming);
    let describe = |schema: &ArrowSchema| {
        let columns: Vec<String> = schema.fields().iter().map(|f| format!("{} {}", f.name(), f.data_type())).collect();
        columns.join(", ")
    };
    let same = |a: &ArrowSchema, b: &ArrowSchema| {
        a.fields().iter().all(|field| b.field_with_name(field.name()).is_ok_and(|o| o.data_type() == field.data_type()))
    };
    if !same(&stored, &offered) || !same(&offered, &stored) {
        return Err(Error::mismatch(
            format!("appending to {}", folder.display()),
            describe(&offered),
            format!("the columns it has: {}", describe(&stored)),
        ));
    }
    // Types and picture sizes are recorded too, where the table was written here.
    for column in &incoming {
        if let Ok(spec) = known.column(&column.spec.name)
            && (spec.dtype, &spec.shape) != (column.spec.dtype, &column.spec.shape)
            && (column.kind == Kind::Image || schema::codec(&old.manifest.schema).is_some())
        {
            let words = |spec: &ColumnSpec| format!("{} {}{:?}", spec.name, spec.dtype.name(), spec.shape);
            return Err(Error::mismatch(
                format!("appending to {}", folder.display()),
                words(&column.spec),
                format!("what it has: {}", words(spec)),
            ));
        }
    }
    incoming.sort_by_key(|column| stored.index_of(&column.name).unwrap_or(usize::MAX));
    // The numbers lead in every table we write; foreign tables could have them elsewhere.
    let leads = stored.fields().iter().take(2).map(|field| field.name().as_str()).eq([EPISODE, STEP]);
    if !leads {
        return Err(Error::mismatch(
            format!("appending to {}", folder.display()),
            describe(&stored),
            format!("a table that begins with {EPISODE} and {STEP}; convert it first"),
        ));
    }
    Ok(incoming)
}

/// Shared between the writer and its committing thread: the error that stopped the thread.
type Failure = Arc<Mutex<Option<Error>>>;

struct LanceWriter {
    folder: PathBuf,
    incoming: Schema,
    columns: Vec<StoredColumn>,
    arrow: Arc<ArrowSchema>,
    codec: ImageCodec,
    episodes: usize,
    next: i64,
    queue: Option<SyncSender<RecordBatch>>,
    thread: Option<JoinHandle<()>>,
    failure: Failure,
    /// Whether the caller knows of the failure.
    reported: bool,
}

impl Writer for LanceWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        if let Some(name) = constants.keys().next() {
            return Err(Error::config("episode constant", format!("{name} cannot be stored in Lance"), "leave it out"));
        }
        if *episode.schema() != self.incoming {
            let words = |schema: &Schema| {
                let columns: Vec<String> =
                    schema.columns().iter().map(|c| format!("{} {}{:?}", c.name, c.dtype.name(), c.shape)).collect();
                columns.join(", ")
            };
            let expected = words(&self.incoming);
            return Err(Error::mismatch("writing an episode", words(episode.schema()), expected));
        }
        check_actions(episode)?;
        let record = self.record(episode)?;
        let queue = self.queue.as_ref();
        if queue.is_none_or(|queue| queue.send(record).is_err()) {
            return Err(self.failed());
        }
        self.episodes += 1;
        self.next += 1;
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.episodes
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.close()
    }
}

impl LanceWriter {
    /// The rows of an episode as they are stored.
    fn record(&self, episode: &Batch) -> Result<RecordBatch> {
        let rows = episode.rows();
        let (Ok(number), Ok(count)) = (i32::try_from(self.next), i32::try_from(rows)) else {
            return Err(Error::mismatch("writing an episode", "more than 2^31 - 1", "fewer episodes and rows"));
        };
        let mut arrays: Vec<ArrayRef> =
            vec![Arc::new(Int32Array::from(vec![number; rows])), Arc::new(Int32Array::from_iter_values(0..count))];
        for column in &self.columns {
            let index = episode.schema().index(&column.spec.name)?;
            arrays.push(match column.kind {
                Kind::Image => Arc::new(encode(episode, index, self.codec)?),
                Kind::Numbers => Arc::new(numbers(episode, index)?),
            });
        }
        RecordBatch::try_new(Arc::clone(&self.arrow), arrays).map_err(|e| Error::external("writing an episode", e))
    }

    /// Why the committing thread stopped.
    fn failed(&mut self) -> Error {
        self.reported = true;
        let known = self.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        known.unwrap_or_else(|| Error::external("writing an episode", "an earlier commit failed; nothing more is kept"))
    }

    fn close(&mut self) -> Result<()> {
        drop(self.queue.take());
        let Some(thread) = self.thread.take() else { return Ok(()) };
        if thread.join().is_err() {
            return Err(Error::external("committing episodes", "the committing thread panicked; this is a bug"));
        }
        let failed = self.reported || self.failure.lock().unwrap_or_else(PoisonError::into_inner).is_some();
        if failed { Err(self.failed()) } else { Ok(()) }
    }
}

impl Drop for LanceWriter {
    fn drop(&mut self) {
        let reported = self.reported;
        if let Err(error) = self.close()
            && !reported
        {
            tracing::error!(dataset = %self.folder.display(), "the last episodes are lost: {error}");
        }
    }
}

/// Checks the time convention: the last row's action is missing, all others are there.
fn check_actions(episode: &Batch) -> Result<()> {
    let rows = episode.rows();
    if rows == 0 {
        return Err(Error::mismatch("writing an episode", "no rows", "at least the final observation"));
    }
    let Some(index) = episode.schema().find(ACTION) else { return Ok(()) };
    let dtype = episode.schema().columns()[index].dtype;
    let float = matches!(dtype, DType::Float32 | DType::Float64);
    if !float && !matches!(dtype, DType::Int32 | DType::Int64) {
        return Ok(());
    }
    for row in 0..rows {
        let action = episode.row(row).to_f64(ACTION)?;
        let last = row + 1 == rows;
        let fine = match (float, last) {
            (true, true) => action.iter().all(|v| v.is_nan()),
            (true, false) => action.iter().all(|v| v.is_finite()),
            (false, true) => action.iter().all(|&v| v == -1.0),
            (false, false) => !action.iter().all(|&v| v == -1.0),
        };
        if !fine {
            let missing = if float { "NaN" } else { "-1" };
            return Err(Error::mismatch(
                "writing an episode",
                format!("action {action:?} in row {row} of {rows}"),
                if last {
                    format!("{missing}: the last row is the final observation, from which no action is taken")
                } else {
                    "the action taken from this row's observation".to_owned()
                },
            ));
        }
    }
    Ok(())
}

/// Encodes the pictures of a column, in parallel. A picture equal to the one before (a goal) is encoded once.
fn encode(episode: &Batch, index: usize, codec: ImageCodec) -> Result<BinaryArray> {
    let spec = &episode.schema().columns()[index];
    let (height, width) = (spec.shape[0], spec.shape[1]);
    let frames: Vec<&[u8]> = episode.bytes(index).chunks_exact(spec.row_bytes()).collect();
    let repeats: Vec<bool> = (0..frames.len()).into_par_iter().map(|i| i > 0 && frames[i] == frames[i - 1]).collect();
    let encoded: Result<Vec<Vec<u8>>> = (0..frames.len())
        .into_par_iter()
        .map(|i| {
            let mut bytes = vec![];
            if !repeats[i] {
                bytes.reserve(frames[i].len() / 8);
                codec.encode(frames[i], height, width, &mut bytes)?;
            }
            Ok(bytes)
        })
        .collect();
    let encoded = encoded?;
    // Where each row's bytes are.
    let sources: Vec<usize> = repeats
        .iter()
        .enumerate()
        .scan(0, |source, (i, &repeat)| {
            *source = if repeat { *source } else { i };
            Some(*source)
        })
        .collect();
    let total: usize = sources.iter().map(|&i| encoded[i].len()).sum();
    if i32::try_from(total).is_err() {
        return Err(Error::mismatch(
            format!("writing column '{}'", spec.name),
            format!("{total} bytes in one episode"),
            "less than 2 GiB; write shorter episodes or smaller pictures",
        ));
    }
    let mut values = Vec::with_capacity(total);
    for &i in &sources {
        values.extend_from_slice(&encoded[i]);
    }
    let offsets = OffsetBuffer::from_lengths(sources.iter().map(|&i| encoded[i].len()));
    BinaryArray::try_new(offsets, Buffer::from_vec(values), None).map_err(|e| Error::external("storing pictures", e))
}

/// A column of numbers as lists of `float32`.
fn numbers(episode: &Batch, index: usize) -> Result<FixedSizeListArray> {
    let spec = &episode.schema().columns()[index];
    let values = episode.to_f32(&spec.name)?;
    // Whole numbers must survive: float32 holds them up to 2^24.
    let exact = |v: i64| v.unsigned_abs() <= 1 << 24;
    let bytes = episode.bytes(index);
    let lossy = match spec.dtype {
        DType::Int32 => values_of::<i32>(bytes).find(|&v| !exact(v.into())).map(i64::from),
        DType::Int64 => values_of::<i64>(bytes).find(|&v| !exact(v)),
        _ => None,
    };
    if let Some(value) = lossy {
        return Err(Error::OutOfSpace {
            what: format!("a value of column '{}'", spec.name),
            given: value.to_string(),
            expected: "whole numbers within ±2^24, as the table stores float32; split larger ones into two columns"
                .to_owned(),
        });
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
    let n = spec.len() as i32;
    let values = Float32Array::new(ScalarBuffer::from(values), None);
    FixedSizeListArray::try_new(schema::list_item(), n, Arc::new(values), None)
        .map_err(|e| Error::external("storing numbers", e))
}

fn values_of<T: bytemuck::Pod>(bytes: &[u8]) -> impl Iterator<Item = T> {
    bytemuck::cast_slice::<u8, T>(bytes).iter().copied()
}

/// The thread that turns groups of episodes into fragments.
struct Committer {
    table: Table,
    schema: Arc<ArrowSchema>,
    policy: CommitPolicy,
    group: Vec<RecordBatch>,
    bytes: usize,
    failure: Failure,
}

impl Committer {
    fn run(mut self, episodes: &Receiver<RecordBatch>) {
        if let Err(error) = self.receive(episodes) {
            *self.failure.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
        }
    }

    fn receive(&mut self, episodes: &Receiver<RecordBatch>) -> Result<()> {
        let mut due = None;
        loop {
            let received = match due {
                None => episodes.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(due) => episodes.recv_timeout(Instant::saturating_duration_since(&due, Instant::now())),
            };
            match received {
                Ok(episode) => {
                    self.bytes += episode.get_array_memory_size();
                    self.group.push(episode);
                    due.get_or_insert_with(|| Instant::now() + self.policy.interval);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return self.commit(),
            }
            let full = self.group.len() >= self.policy.episodes || self.bytes >= self.policy.bytes;
            if full || due.is_some_and(|due| Instant::now() >= due) {
                self.commit()?;
                due = None;
            }
        }
    }

    fn commit(&mut self) -> Result<()> {
        self.bytes = 0;
        let group = std::mem::take(&mut self.group);
        self.commit_episodes(&group)
    }

    /// Commits some episodes. Those for which there is no room together are tried in halves, so that a disk that
    /// fills up keeps as many finished episodes as it has room for.
    fn commit_episodes(&mut self, episodes: &[RecordBatch]) -> Result<()> {
        if episodes.is_empty() {
            return Ok(());
        }
        let fragment = self.table.write_fragment(&self.schema, episodes.to_vec());
        let committed = fragment.and_then(|fragment| {
            let files: Vec<PathBuf> =
                fragment.files.iter().map(|file| self.table.store.folder.join("data").join(&file.path)).collect();
            let committed = self.table.commit(Operation::Append { fragments: vec![fragment] });
            if matches!(&committed, Err(error) if is_full(error)) {
                // The manifest had no room: what it would have named is of no use.
                files.iter().for_each(|file| remove(file));
            }
            committed
        });
        match committed {
            Err(error) if is_full(&error) && episodes.len() > 1 => {
                let (first, second) = episodes.split_at(episodes.len() / 2);
                self.commit_episodes(first)?;
                self.commit_episodes(second)
            }
            committed => committed,
        }
    }
}

/// Whether an error says that the disk is full.
fn is_full(error: &Error) -> bool {
    use std::io::ErrorKind::{QuotaExceeded, StorageFull};
    matches!(error, Error::Io { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded))
}

/// A table and its newest version.
struct Table {
    store: Store,
    version: Option<Version>,
    file_version: ConcreteFileVersion,
    /// Manifests of versions that this writer committed, oldest first.
    manifests: VecDeque<PathBuf>,
}

impl Table {
    fn commit(&mut self, operation: Operation) -> Result<()> {
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
        let (version, manifest) = self.store.commit(self.version.as_ref(), operation, config)?;
        self.version = Some(version);
        self.manifests.push_back(manifest);
        if self.manifests.len() > KEPT_VERSIONS
            && let Some(oldest) = self.manifests.pop_front()
        {
            remove(&oldest);
        }
        Ok(())
    }

    /// Replaces the stored manifest (where the data come from).
    fn describe(&mut self, manifest: String) -> Result<()> {
        let known = self.version.as_ref().and_then(|v| v.manifest.schema.metadata.get(schema::MANIFEST_KEY));
        if known == Some(&manifest) {
            return Ok(());
        }
        let entry = UpdateMapEntry { key: schema::MANIFEST_KEY.to_owned(), value: Some(manifest) };
        self.commit(Operation::UpdateConfig {
            config_updates: None,
            table_metadata_updates: None,
            schema_metadata_updates: Some(UpdateMap { update_entries: vec![entry], replace: false }),
            field_metadata_updates: Default::default(),
        })
    }

    /// Writes episodes to a new data file.
    fn write_fragment(&self, schema: &ArrowSchema, episodes: Vec<RecordBatch>) -> Result<Fragment> {
        // Written under a passing name, as the hash is known at the end; killed before, it is a file too many.
        let passing = format!("{}.lance", uuid::Uuid::new_v4().simple());
        let path = self.store.data_path(&passing);
        let data = self.store.folder.join("data");
        let objects = Arc::clone(self.store.objects());
        let version = self.file_version;
        // Field ids are those of the table, which a foreign table may number differently.
        let fields = match &self.version {
            Some(version) => Ok(version.manifest.schema.clone()),
            None => LanceSchema::try_from(schema),
        };
        wait(&self.store.folder, "writing a data file", async move {
            let object = objects.create(&path).await?;
            let mut writer = create_writer(version, object, fields?, FileWriterOptions::default())?;
            let result = async {
                for episode in &episodes {
                    writer.write_batch(episode).await?;
                }
                writer.finish().await
            }
            .await;
            let summary = match result {
                Ok(summary) => summary,
                Err(error) => {
                    writer.abort().await;
                    return Err(error);
                }
            };
            let hash = store::hash_file(&data.join(&passing))?;
            let name = store::name_of_hash(&hash);
            std::fs::rename(data.join(&passing), data.join(&name))?;
            let mut ids = vec![];
            let mut columns = vec![];
            for &(id, column) in writer.field_id_to_column_indices() {
                #[allow(clippy::cast_possible_wrap)]
                ids.push(id as i32);
                #[allow(clippy::cast_possible_wrap)]
                columns.push(column as i32);
            }
            let size = std::num::NonZero::new(summary.size_bytes);
            #[allow(clippy::cast_possible_truncation)]
            let rows = summary.num_rows as usize;
            Ok(Fragment::new(0).with_file(name, ids, columns, version, size).with_physical_rows(rows))
        })
    }

    /// Removes what only older versions use, after everything was replaced.
    fn remove_replaced(&self, old: &Version) {
        for fragment in old.manifest.fragments.iter() {
            for file in &fragment.files {
                remove(&self.store.folder.join("data").join(&file.path));
            }
        }
        let keep: Vec<&PathBuf> = self.manifests.iter().collect();
        let versions = std::fs::read_dir(self.store.folder.join("_versions"));
        for entry in versions.into_iter().flatten().flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|suffix| suffix == "manifest") && !keep.contains(&&path) {
                remove(&path);
            }
        }
    }
}

/// Removes a file that nothing needs any more; that it stays does no harm but for its size.
fn remove(path: &Path) {
    if let Err(error) = std::fs::remove_file(path) {
        tracing::warn!(file = %path.display(), "an old file of the dataset stays: {error}");
    }
}
