//! Writing episodes: encode in the caller's thread (all pictures in parallel), commit in a thread of our own.
//!
//! Finished episodes gather until the [`CommitPolicy`] says that the group is due; the group becomes one
//! fragment (one data file) and one new version of the table, committed atomically. So a reader never sees a
//! part of an episode, and a killed process loses the current group at most.
//!
//! Several writers may append at once: who finds that another one committed first numbers its episodes anew, after
//! those of the other.

use super::encode::Encoded;
use super::reader::LanceReader;
use super::schema::{self, EPISODE, Kind, STEP, StoredColumn};
use super::shard::ShardLog;
use super::store::{Store, Version};
use super::table::{TRIES, Table};
use crate::dataset::{CommitPolicy, Constants, WriteMode, WriteOptions, Writer};
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
use swm_core::{Batch, ColumnSpec, Error, Result, Schema};
use swm_image::ImageCodec;

/// Episodes that may wait for the committing thread; bounds the memory together with the policy's bytes.
const WAITING: usize = 2;

/// Creates, continues or replaces a table.
pub fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    options.codec.check()?;
    let store = Store::new(location)?;
    store.check_writable()?;
    for _ in 0..TRIES {
        // Somebody else may make, continue or replace it at this moment: then there is another state to begin from.
        if let Some(begun) = begin(&store, schema, &options)? {
            return begun.start(schema, &options);
        }
    }
    Err(busy(&store.label))
}

pub fn busy(label: &Path) -> Error {
    let problem = format!("others write to {} without a pause", label.display());
    Error::config("dataset", problem, "try again, or write to a dataset of your own and merge")
}

/// A table that is ready for episodes.
pub struct Begun {
    pub sink: Sink,
    /// The columns in the order of the table.
    pub columns: Vec<StoredColumn>,
    /// Episodes that are there.
    pub episodes: usize,
}

/// Where groups of episodes go.
pub enum Sink {
    /// Into a version of the table each.
    Table {
        /// The table.
        table: Table,
        /// The number of the next episode.
        next: i64,
    },
    /// Into the log of one of several machines.
    Shard(ShardLog),
}

/// The fields of a new table.
pub fn fresh(columns: &[StoredColumn], schema: &Schema, options: &WriteOptions) -> Result<LanceSchema> {
    let mut fresh =
        LanceSchema::try_from(&schema::arrow_schema(columns)).map_err(|e| Error::external("making the table", e))?;
    fresh.metadata = schema::metadata(schema, options.codec, options.manifest.as_ref())?;
    Ok(fresh)
}

/// Makes, continues or replaces the table; `None` when somebody else did so meanwhile.
fn begin(store: &Store, schema: &Schema, options: &WriteOptions) -> Result<Option<Begun>> {
    let mut columns = schema::columns_to_write(schema)?;
    let fresh = fresh(&columns, schema, options)?;
    let found = store.latest()?;
    let mut table = Table::new(store.clone(), found.clone(), fresh);
    let (mut episodes, mut next) = (0, 0);
    let committed = match (options.mode, found) {
        (_, None) => table.commit(table.made_anew(vec![]))?,
        (WriteMode::Create, Some(_)) => {
            return Err(Error::config(
                "dataset",
                format!("{} exists already", store.label.display()),
                "choose another path, or say whether to append to it or to overwrite it",
            ));
        }
        (WriteMode::Overwrite, Some(old)) => {
            let committed = table.commit(table.made_anew(vec![]))?;
            if committed {
                table.remove_replaced(&old);
            }
            committed
        }
        (WriteMode::Append, Some(old)) => {
            let known = LanceReader::of(store.clone(), Arc::clone(&old.manifest))?;
            columns = continued(&store.label, columns, &old, crate::Reader::schema(&known))?;
            episodes = crate::Reader::episodes(&known).len();
            next = known.next_episode();
            let manifest = options.manifest.as_ref().map(schema::json).transpose()?;
            match manifest.and_then(|manifest| table.described(manifest)) {
                Some(operation) => table.commit(operation)?,
                None => true,
            }
        }
    };
    Ok(committed.then_some(Begun { sink: Sink::Table { table, next }, columns, episodes }))
}

impl Begun {
    /// Starts the thread that commits.
    pub fn start(self, schema: &Schema, options: &WriteOptions) -> Result<Box<dyn Writer>> {
        let folder = match &self.sink {
            Sink::Table { table, .. } => table.store.label.clone(),
            Sink::Shard(log) => log.table.store.label.clone(),
        };
        let shared = Arc::<Shared>::default();
        let (sender, receiver) = sync_channel(WAITING);
        let committer =
            Committer { sink: self.sink, policy: options.commit, group: vec![], bytes: 0, shared: Arc::clone(&shared) };
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
        }))
    }
}

/// The incoming columns in the order of the table to continue, and with the precision it has.
pub fn continued(
    folder: &Path,
    mut incoming: Vec<StoredColumn>,
    old: &Version,
    known: &Schema,
) -> Result<Vec<StoredColumn>> {
    let stored = ArrowSchema::from(&old.manifest.schema);
    for column in &mut incoming {
        // Tables of older versions, and of the reference, hold all numbers in single precision.
        let precision = stored.field_with_name(&column.name).ok().and_then(|f| schema::stored_precision(f.data_type()));
        if let (Kind::Numbers(own), Some(precision)) = (&mut column.kind, precision) {
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

/// Shared between the writer and its committing thread.
#[derive(Default)]
struct Shared {
    /// The error that stopped the thread.
    failure: Mutex<Option<Error>>,
    /// Whether no episode is missing, as opposed to a writer that was dropped.
    complete: AtomicBool,
}

impl Shared {
    fn failure(&self) -> MutexGuard<'_, Option<Error>> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct LanceWriter {
    folder: PathBuf,
    incoming: Schema,
    columns: Vec<StoredColumn>,
    codec: ImageCodec,
    episodes: usize,
    queue: Option<SyncSender<Encoded>>,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
    /// Whether the caller knows of the failure.
    reported: bool,
}

impl Writer for LanceWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check(episode, &self.incoming)?;
        let encoded = Encoded::new(&self.columns, episode, self.codec, constants)?;
        let queue = self.queue.as_ref();
        if queue.is_none_or(|queue| queue.send(encoded).is_err()) {
            return Err(self.failed());
        }
        self.episodes += 1;
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.episodes
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.shared.complete.store(true, Ordering::Release);
        self.close()
    }
}

impl LanceWriter {
    /// Why the committing thread stopped.
    fn failed(&mut self) -> Error {
        self.reported = true;
        let known = self.shared.failure().take();
        known.unwrap_or_else(|| Error::external("writing an episode", "an earlier commit failed; nothing more is kept"))
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
            tracing::error!(dataset = %self.folder.display(), "the last episodes are lost: {error}");
        }
    }
}

/// The thread that turns groups of episodes into fragments.
struct Committer {
    sink: Sink,
    policy: CommitPolicy,
    group: Vec<Encoded>,
    bytes: usize,
    shared: Arc<Shared>,
}

impl Committer {
    fn run(mut self, episodes: &Receiver<Encoded>) {
        if let Err(error) = self.receive(episodes) {
            *self.shared.failure() = Some(error);
        }
    }

    fn receive(&mut self, episodes: &Receiver<Encoded>) -> Result<()> {
        let mut due = None;
        loop {
            let received = match due {
                None => episodes.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(due) => episodes.recv_timeout(Instant::saturating_duration_since(&due, Instant::now())),
            };
            match received {
                Ok(episode) => {
                    self.bytes += episode.bytes();
                    self.group.push(episode);
                    due.get_or_insert_with(|| Instant::now() + self.policy.interval);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    self.commit()?;
                    return match &mut self.sink {
                        Sink::Shard(log) if self.shared.complete.load(Ordering::Acquire) => log.finish(),
                        _ => Ok(()),
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

    /// Commits some episodes. Those for which there is no room together are tried in halves, so that a disk that
    /// fills up keeps as many finished episodes as it has room for.
    fn commit_episodes(&mut self, episodes: &[Encoded]) -> Result<()> {
        if episodes.is_empty() {
            return Ok(());
        }
        let committed = match &mut self.sink {
            Sink::Table { table, next } => append(table, next, episodes),
            Sink::Shard(log) => log.append(episodes),
        };
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

/// Commits some episodes as one version, after those of others.
fn append(table: &mut Table, next: &mut i64, episodes: &[Encoded]) -> Result<()> {
    for _ in 0..TRIES {
        let fragment = table.write_episodes(episodes, Some(*next))?;
        match table.commit(Operation::Append { fragments: vec![fragment.clone()] }) {
            Ok(true) => {
                *next += episodes.len() as i64;
                return Ok(());
            }
            Ok(false) => {
                table.discard(&fragment);
                *next = table.refresh()?;
            }
            Err(error) => {
                if is_full(&error) {
                    // The manifest had no room: what it would have named is of no use.
                    table.discard(&fragment);
                }
                return Err(error);
            }
        }
    }
    Err(busy(&table.store.label))
}

/// Whether an error says that the disk is full.
fn is_full(error: &Error) -> bool {
    use std::io::ErrorKind::{QuotaExceeded, StorageFull};
    matches!(error, Error::Io { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded))
}
