//! Writes episodes: encodes them in the caller's thread (images in parallel), and commits in a background thread.
//!
//! Finished episodes accumulate until the [`CommitPolicy`] requires a commit. They then become one fragment (one data
//! file) and one new version of the table, committed atomically. Readers therefore never see a part of an episode, and
//! a killed process loses only uncommitted episodes.
//!
//! Several writers may append concurrently. If another writer commits first, this writer renumbers its episodes after the new ones
//! and retries. An exclusive writer (any that replaces a table) fails instead: on this machine it locks the folder, in an object
//! store it notices another writer at its next commit.

use super::ENTRY;
use super::encode::EncodedEpisode;
use super::reader::LanceReader;
use super::schema::{self, Kind, StoredColumn};
use super::shard::ShardLog;
use super::store::{Store, Version};
use super::table::{MAX_ATTEMPTS, Table};
use crate::dataset::{CommitPolicy, Constants, WriteMode, WriteOptions, Writer, is_full, with_stored};
use crate::dataset::{Location, episodes};
use arrow_schema::Schema as ArrowSchema;
use lance_core::datatypes::Schema as LanceSchema;
use lance_table::transaction::Operation;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::files::Lock;
use swm_core::{Batch, ColumnSpec, Error, Result, Schema};
use swm_image::ImageCodec;

/// Maximum number of episodes queued for the committing thread. This limit and the byte limit of
/// [`CommitPolicy`] bound the writer's memory.
const MAX_QUEUED: usize = 2;

/// Creates, continues or replaces a table.
pub fn create(location: &Location, schema: &Schema, mut options: WriteOptions) -> Result<Box<dyn Writer>> {
    options.codec.check()?;
    options.exclusive |= options.mode == WriteMode::Overwrite;
    // A new table is recognised by its versions, whatever its name; a folder that is none must not become one.
    if location.path().is_none_or(Path::exists) {
        ENTRY.check_suffix(location)?;
    }
    let store = Store::new(location)?;
    store.check_writable()?;
    store.check_no_links()?;
    let lock = if options.exclusive { store.lock("")? } else { None };
    for _ in 0..MAX_ATTEMPTS {
        // If another process creates, continues or replaces the table in between, the next attempt starts from the new
        // state.
        if let Some(prepared) = store.with_latest(|found| prepare(&store, found, schema, &options))? {
            return prepared.start(schema, &options, lock);
        }
    }
    Err(too_many_conflicts(&store.label))
}

pub fn too_many_conflicts(label: &Path) -> Error {
    let problem = format!("{MAX_ATTEMPTS} attempts to commit to {} conflicted with other writers", label.display());
    Error::config("dataset", problem, "try again, or write to a separate dataset and merge it")
}

/// A table that is ready for episodes.
pub struct PreparedWriter {
    pub sink: Sink,
    /// The columns in the order of the table.
    pub columns: Vec<StoredColumn>,
    /// Number of episodes in the table.
    pub episodes: usize,
}

/// The destination of committed episodes.
pub enum Sink {
    /// Each commit becomes a version of the table.
    Table {
        /// The table.
        table: Table,
        /// `episode_idx` of the next episode.
        next: i64,
        /// See [`WriteOptions::exclusive`].
        exclusive: bool,
        /// The version whose episodes the first commit replaces.
        replaced: Option<Version>,
    },
    /// Each commit becomes an entry in the log of a shard.
    Shard(ShardLog),
}

/// The Lance schema of a new table.
pub fn new_table_schema(columns: &[StoredColumn], schema: &Schema, options: &WriteOptions) -> Result<LanceSchema> {
    let mut fresh =
        LanceSchema::try_from(&schema::arrow_schema(columns)).map_err(|e| Error::external("creating the table", e))?;
    fresh.metadata = schema::metadata(schema, options.codec, options.manifest.as_ref())?;
    Ok(fresh)
}

/// Creates or continues the table, or prepares its replacement. Returns `None` if another process changed the table at the same time.
fn prepare(
    store: &Store,
    found: Option<Version>,
    schema: &Schema,
    options: &WriteOptions,
) -> Result<Option<PreparedWriter>> {
    let mut columns = schema::columns_to_write(schema)?;
    let fresh = new_table_schema(&columns, schema, options)?;
    let mut table = Table::new(store.clone(), found.clone(), fresh);
    let (mut episodes, mut next, mut replaced) = (0, 0, None);
    let committed = match (options.mode, found) {
        (_, None) => table.commit(table.overwrite_operation(vec![]))?,
        (WriteMode::Create, Some(_)) => {
            return Err(Error::config(
                "dataset",
                format!("{} exists already", store.label.display()),
                "choose another path, append to it, or overwrite it",
            ));
        }
        (WriteMode::Overwrite, Some(old)) => {
            (table.replaces, replaced) = (true, Some(old));
            true
        }
        (WriteMode::Append, Some(old)) => {
            let known = LanceReader::of(store.clone(), Arc::clone(&old.manifest))?;
            options.continues.iter().try_for_each(|continued| continued.check(&known, &store.label.display()))?;
            columns = match_table_columns(&store.label, columns, &old, crate::Reader::schema(&known))?;
            episodes = crate::Reader::episodes(&known).len();
            next = known.next_episode();
            let manifest = options.manifest.as_ref().map(schema::json).transpose()?;
            match manifest.and_then(|manifest| table.manifest_operation(manifest)) {
                Some(operation) => table.commit(operation)?,
                None => true,
            }
        }
    };
    Ok(committed.then_some(PreparedWriter {
        sink: Sink::Table { table, next, exclusive: options.exclusive, replaced },
        columns,
        episodes,
    }))
}

impl PreparedWriter {
    /// Starts the committing thread.
    pub fn start(self, schema: &Schema, options: &WriteOptions, lock: Option<Lock>) -> Result<Box<dyn Writer>> {
        let folder = match &self.sink {
            Sink::Table { table, .. } => table.store.label.clone(),
            Sink::Shard(log) => log.table.store.label.clone(),
        };
        let shared = Arc::<Shared>::default();
        let (sender, receiver) = sync_channel(MAX_QUEUED);
        let committer = Committer {
            sink: self.sink,
            policy: options.commit,
            group: vec![],
            bytes: 0,
            stored: self.episodes,
            waiting: None,
            shared: Arc::clone(&shared),
        };
        let thread = std::thread::Builder::new()
            .name("swm-commit".to_owned())
            .spawn(move || committer.run(&receiver))
            .map_err(|e| Error::io(&folder, "starting the committing thread", e))?;
        Ok(Box::new(LanceWriter {
            folder,
            incoming: schema.clone(),
            columns: self.columns,
            codec: options.codec,
            episodes: self.episodes,
            queue: Some(sender),
            thread: Some(thread),
            shared,
            reported: false,
            _lock: lock,
        }))
    }
}

/// Sorts the columns to append in the order of the existing table, and sets their precision to the stored precision.
pub fn match_table_columns(
    folder: &Path,
    mut incoming: Vec<StoredColumn>,
    old: &Version,
    known: &Schema,
) -> Result<Vec<StoredColumn>> {
    let stored = ArrowSchema::from(&old.manifest.schema);
    for column in &mut incoming {
        // The reference implementation, and older versions of this format, store all numeric columns as `float32`.
        let precision = stored.field_with_name(&column.name).ok().and_then(|f| schema::stored_precision(f.data_type()));
        if let (Kind::Values(own), Some(precision)) = (&mut column.kind, precision) {
            *own = precision;
        }
    }
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
    // Tables that this module writes also record types and image sizes.
    for column in &incoming {
        if let Ok(spec) = known.column(&column.spec.name)
            && (spec.dtype, &spec.shape) != (column.spec.dtype, &column.spec.shape)
            && (column.kind == Kind::Image || schema::codec(&old.manifest.schema).is_some())
        {
            let describe = |spec: &ColumnSpec| format!("{} {}{:?}", spec.name, spec.dtype.name(), spec.shape);
            return Err(Error::mismatch(
                format!("appending to {}", folder.display()),
                describe(&column.spec),
                format!("the existing column: {}", describe(spec)),
            ));
        }
    }
    incoming.sort_by_key(|column| stored.index_of(&column.name).unwrap_or(usize::MAX));
    // Tables that this module writes start with the index columns; third-party tables may not.
    let leads = stored.fields().iter().take(2).map(|field| field.name().as_str()).eq([EPISODE_IDX, STEP_IDX]);
    if !leads {
        return Err(Error::mismatch(
            format!("appending to {}", folder.display()),
            describe(&stored),
            format!("a table that begins with {EPISODE_IDX} and {STEP_IDX}; convert it first"),
        ));
    }
    Ok(incoming)
}

/// State shared by the writer and its committing thread.
#[derive(Default)]
struct Shared {
    /// The error that stopped the committing thread.
    failure: Mutex<Option<Error>>,
    /// Whether [`Writer::finish`] was called, as opposed to dropping the writer.
    complete: AtomicBool,
}

impl Shared {
    fn failure(&self) -> MutexGuard<'_, Option<Error>> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What the committing thread receives.
enum Message {
    Episode(EncodedEpisode),
    /// Commits the episodes so far, then answers.
    Commit(SyncSender<()>),
}

struct LanceWriter {
    folder: PathBuf,
    incoming: Schema,
    columns: Vec<StoredColumn>,
    codec: ImageCodec,
    episodes: usize,
    queue: Option<SyncSender<Message>>,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
    /// Whether the caller received the failure.
    reported: bool,
    _lock: Option<Lock>,
}

impl Writer for LanceWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check_episode(episode, &self.incoming)?;
        let encoded = EncodedEpisode::new(&self.columns, episode, self.codec, constants)?;
        let queue = self.queue.as_ref();
        if queue.is_none_or(|queue| queue.send(Message::Episode(encoded)).is_err()) {
            return Err(self.failed());
        }
        self.episodes += 1;
        Ok(())
    }

    fn sync(&mut self) -> Result<()> {
        let (done, committed) = sync_channel(1);
        let queue = self.queue.as_ref();
        // A failed thread drops the sender of the answer.
        let is_sent = queue.is_some_and(|queue| queue.send(Message::Commit(done)).is_ok());
        if is_sent && committed.recv().is_ok() { Ok(()) } else { Err(self.failed()) }
    }

    fn episodes(&self) -> usize {
        self.episodes
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.shared.complete.store(true, Ordering::Release);
        self.close()
    }

    fn pause(mut self: Box<Self>) -> Result<()> {
        self.close()
    }
}

impl LanceWriter {
    /// Takes the error that stopped the committing thread.
    fn failed(&mut self) -> Error {
        self.reported = true;
        let known = self.shared.failure().take();
        known.unwrap_or_else(|| {
            Error::external("writing an episode", "an earlier commit failed; later episodes are not stored")
        })
    }

    fn close(&mut self) -> Result<()> {
        drop(self.queue.take());
        let Some(thread) = self.thread.take() else { return Ok(()) };
        if thread.join().is_err() {
            return Err(Error::external("committing episodes", "the committing thread panicked; this is a bug"));
        }
        let failed = self.reported || self.shared.failure().is_some();
        if failed { Err(self.failed()) } else { Ok(()) }
    }
}

impl Drop for LanceWriter {
    fn drop(&mut self) {
        let reported = self.reported;
        if let Err(error) = self.close()
            && !reported
        {
            tracing::error!(dataset = %self.folder.display(), "the last episodes could not be stored: {error}");
        }
    }
}

/// The state of the committing thread.
struct Committer {
    sink: Sink,
    policy: CommitPolicy,
    group: Vec<EncodedEpisode>,
    bytes: usize,
    /// Number of stored episodes.
    stored: usize,
    /// Who waits for the present commit.
    waiting: Option<SyncSender<()>>,
    shared: Arc<Shared>,
}

impl Committer {
    fn run(mut self, messages: &Receiver<Message>) {
        if let Err(error) = self.receive(messages) {
            *self.shared.failure() = Some(with_stored(error, self.stored));
        }
    }

    fn receive(&mut self, messages: &Receiver<Message>) -> Result<()> {
        let mut due = None;
        loop {
            let received = match due {
                None => messages.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(due) => messages.recv_timeout(Instant::saturating_duration_since(&due, Instant::now())),
            };
            match received {
                Ok(Message::Commit(done)) => {
                    // Dropped with the committer if this fails, after the failure is known.
                    self.waiting = Some(done);
                    self.commit()?;
                    due = None;
                    if let Some(done) = self.waiting.take() {
                        // The writer waits for it.
                        let _ = done.send(());
                    }
                }
                Ok(Message::Episode(episode)) => {
                    self.bytes += episode.bytes();
                    self.group.push(episode);
                    due.get_or_insert_with(|| Instant::now() + self.policy.interval);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    self.commit()?;
                    if !self.shared.complete.load(Ordering::Acquire) {
                        return Ok(());
                    }
                    return match &mut self.sink {
                        Sink::Shard(log) => log.finish(),
                        Sink::Table { table, replaced, .. } => replace(table, replaced, &[]),
                    };
                }
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

    /// Commits episodes. If the disk is full, commits them in halves, so that as many finished episodes as possible are
    /// stored.
    fn commit_episodes(&mut self, episodes: &[EncodedEpisode]) -> Result<()> {
        if episodes.is_empty() {
            return Ok(());
        }
        let committed = match &mut self.sink {
            Sink::Table { table, next, replaced: replaced @ Some(_), .. } => {
                let stored = replace(table, replaced, episodes);
                *next = episodes.len() as i64;
                stored
            }
            Sink::Table { table, next, exclusive, .. } => append(table, next, *exclusive, episodes),
            Sink::Shard(log) => log.append(episodes),
        };
        match committed {
            Err(error) if is_full(&error) && episodes.len() > 1 => {
                let (first, second) = episodes.split_at(episodes.len() / 2);
                self.commit_episodes(first)?;
                self.commit_episodes(second)
            }
            committed => {
                self.stored += if committed.is_ok() { episodes.len() } else { 0 };
                committed
            }
        }
    }
}

/// Commits episodes as the version that replaces another one, if there is one to replace, and deletes its files.
fn replace(table: &mut Table, replaced: &mut Option<Version>, episodes: &[EncodedEpisode]) -> Result<()> {
    let Some(old) = replaced.as_ref() else { return Ok(()) };
    let fragment = (!episodes.is_empty()).then(|| table.write_episodes(episodes, Some(0))).transpose()?;
    let discard = |table: &Table| fragment.iter().for_each(|fragment| table.discard(fragment));
    match table.commit(table.overwrite_operation(fragment.clone().into_iter().collect())) {
        Ok(true) => {
            table.remove_replaced(old);
            (table.replaces, *replaced) = (false, None);
            Ok(())
        }
        Ok(false) => {
            discard(table);
            Err(other_writer(table))
        }
        Err(error) => {
            if is_full(&error) {
                discard(table);
            }
            Err(error)
        }
    }
}

fn other_writer(table: &Table) -> Error {
    let problem = "another process writes to it, and added or replaced episodes";
    let fix = "wait until that process has ended, then continue (--resume)";
    Error::config(table.store.label.display().to_string(), problem, fix)
}

/// Commits episodes as one version, numbered after all existing episodes.
fn append(table: &mut Table, next: &mut i64, exclusive: bool, episodes: &[EncodedEpisode]) -> Result<()> {
    for _ in 0..MAX_ATTEMPTS {
        let fragment = table.write_episodes(episodes, Some(*next))?;
        match table.commit(Operation::Append { fragments: vec![fragment.clone()] }) {
            Ok(true) => {
                *next += episodes.len() as i64;
                return Ok(());
            }
            Ok(false) => {
                table.discard(&fragment);
                if exclusive {
                    return Err(other_writer(table));
                }
                *next = table.refresh()?;
            }
            Err(error) => {
                if is_full(&error) {
                    // The manifest was not written, so no version refers to the data file.
                    table.discard(&fragment);
                }
                return Err(error);
            }
        }
    }
    Err(too_many_conflicts(&table.store.label))
}
