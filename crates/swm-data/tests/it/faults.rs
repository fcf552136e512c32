//! Writing and reading through an object store that fails: no episode is lost or stored twice.
//!
//! A schedule is a seed, from which every request draws its fault. Nine requests in ten succeed. The suite runs a few
//! schedules; `cargo test --release -p swm-data --test it faults -- --ignored` runs 1,000.

use crate::sample::{check, episode, options, schema};
use async_trait::async_trait;
use futures::stream::{BoxStream, StreamExt as _};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};
use rand::Rng as _;
use std::collections::VecDeque;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::Key;
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::objects::provide;
use swm_data::{
    ClipSpec, CommitPolicy, Loader, LoaderConfig, Location, StepRange, WriteMode, WriteOptions, create, open,
};

/// The number of newest objects that a stale list may hide.
const STALE: usize = 3;

/// What happens to a request.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    None,
    /// The server is throttled, or fails, before it does anything.
    Refused,
    /// The server does what it is asked; the answer is lost, and the client gives up.
    AnswerLost,
    /// The server does what it is asked; the answer is lost, and the client repeats the request.
    Repeated,
    /// A list does not contain the newest objects.
    StaleList,
}

/// A store in memory whose requests fail.
#[derive(Debug)]
struct Faults {
    inner: InMemory,
    key: Key,
    requests: AtomicU64,
    /// The newest objects.
    newest: Mutex<VecDeque<Path>>,
}

impl Faults {
    fn new(seed: u64) -> Self {
        let key = Key::new(seed).with("faults");
        Self { inner: InMemory::new(), key, requests: AtomicU64::new(0), newest: Mutex::default() }
    }

    fn fault(&self) -> Fault {
        match self.key.at(self.requests.fetch_add(1, Ordering::Relaxed)).rng().random_range(0..100) {
            0..3 => Fault::Refused,
            3..6 => Fault::AnswerLost,
            6..8 => Fault::Repeated,
            8..12 => Fault::StaleList,
            _ => Fault::None,
        }
    }

    fn stored(&self, path: &Path) {
        let mut newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        newest.push_back(path.clone());
        if newest.len() > STALE {
            newest.pop_front();
        }
    }

    /// The objects that a list hides.
    fn hidden(&self, fault: Fault) -> Vec<Path> {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        if fault == Fault::StaleList { newest.iter().cloned().collect() } else { vec![] }
    }
}

fn unavailable() -> Error {
    Error::Generic { store: "faults", source: "503 Slow Down".into() }
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("faults")
    }
}

#[async_trait]
impl ObjectStore for Faults {
    async fn put_opts(&self, location: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        let fault = self.fault();
        if fault == Fault::Refused {
            return Err(unavailable());
        }
        let mut stored = self.inner.put_opts(location, payload.clone(), options.clone()).await;
        if stored.is_ok() {
            self.stored(location);
        }
        if fault == Fault::Repeated {
            stored = self.inner.put_opts(location, payload, options).await;
        }
        if fault == Fault::AnswerLost { Err(unavailable()) } else { stored }
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        match self.fault() {
            Fault::Refused | Fault::AnswerLost => Err(unavailable()),
            _ => self.inner.put_multipart_opts(location, options).await,
        }
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        match self.fault() {
            Fault::Refused | Fault::AnswerLost => Err(unavailable()),
            _ => self.inner.get_opts(location, options).await,
        }
    }

    fn delete_stream(&self, locations: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        match self.fault() {
            Fault::Refused => futures::stream::once(async { Err(unavailable()) }).boxed(),
            Fault::AnswerLost => self.inner.delete_stream(locations).map(|_| Err(unavailable())).boxed(),
            _ => self.inner.delete_stream(locations),
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let fault = self.fault();
        if matches!(fault, Fault::Refused | Fault::AnswerLost) {
            return futures::stream::once(async { Err(unavailable()) }).boxed();
        }
        let hidden = self.hidden(fault);
        let shown = move |meta: &Result<ObjectMeta>| !meta.as_ref().is_ok_and(|meta| hidden.contains(&meta.location));
        self.inner.list(prefix).filter(move |meta| futures::future::ready(shown(meta))).boxed()
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        let fault = self.fault();
        if matches!(fault, Fault::Refused | Fault::AnswerLost) {
            return Err(unavailable());
        }
        let (hidden, mut found) = (self.hidden(fault), self.inner.list_with_delimiter(prefix).await?);
        found.objects.retain(|meta| !hidden.contains(&meta.location));
        Ok(found)
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await
    }
}

/// The maximum number of times that a process starts again.
const STARTS: usize = 500;

/// Repeats a process until it succeeds.
fn until_success<T>(what: &str, mut process: impl FnMut() -> swm_core::Result<T>) -> T {
    let mut error = None;
    for _ in 0..STARTS {
        match process() {
            Ok(result) => return result,
            Err(failed) => error = Some(failed),
        }
    }
    panic!("{what} fails again and again: {}", error.expect("an error"))
}

fn exclusive() -> WriteOptions {
    let commit = CommitPolicy { episodes: 2, ..CommitPolicy::default() };
    WriteOptions { exclusive: true, commit, ..options(WriteMode::Append) }
}

/// Writes the episodes that are missing, as a continued collection does.
fn collect(location: &Location, episodes: usize) -> swm_core::Result<()> {
    let mut writer = create(location, &schema(), exclusive())?;
    for e in writer.episodes()..episodes {
        writer.write_episode(&episode(e))?;
    }
    writer.finish()
}

fn location(name: &str) -> Location {
    Location::Uri(url::Url::parse(&format!("store://{name}/data.lance")).expect("a URI"))
}

/// Checks that a dataset holds every episode once, without faults.
fn check_all(name: &str, store: &Faults, episodes: usize) {
    provide(name, Arc::new(store.inner.fork()));
    let reader = open(location(name)).expect("opening");
    assert_eq!(reader.episodes().len(), episodes, "{name}");
    check(&*reader, 0);
    let indices: Vec<i64> = reader.episodes().iter().map(|episode| episode.index).collect();
    assert_eq!(indices, (0..episodes as i64).collect::<Vec<_>>(), "{name}");
}

/// One or two collections at once continue a dataset until it is complete; then a loader reads it.
fn collections(seed: u64) {
    const EPISODES: usize = 7;
    let (name, store) = (format!("faults-{seed}"), Arc::new(Faults::new(seed)));
    provide(&name, Arc::clone(&store) as Arc<dyn ObjectStore>);
    let at = location(&name);
    std::thread::scope(|scope| {
        for _ in 0..1 + seed % 2 {
            scope.spawn(|| until_success("collecting", || collect(&at, EPISODES)));
        }
    });
    let reader = until_success("opening", || open(at.clone()));
    let read = until_success("reading", || reader.read(&["state"], &[StepRange::new(3, 0, 2)]));
    assert_eq!(read.row(1).get::<f64>("state").expect("values"), [3.0, 1.0, -0.5]);
    let batches = until_success("loading", || {
        let clip = ClipSpec { columns: vec!["state".to_owned()], num_steps: 2, frameskip: 1 };
        let config = LoaderConfig { clip, batch_size: 4, ..LoaderConfig::default() };
        let loader = Loader::new(Arc::clone(&reader), config)?;
        loader.epoch(0, 0).map(|batch| batch.map(|batch| batch.rows())).collect::<swm_core::Result<Vec<usize>>>()
    });
    assert!(batches.iter().sum::<usize>() > 0);
    check_all(&name, &store, EPISODES);
}

/// Two machines write a shard each; then one commit combines them, and is repeated.
fn shards(seed: u64) {
    let (name, store) = (format!("shards-{seed}"), Arc::new(Faults::new(seed)));
    provide(&name, Arc::clone(&store) as Arc<dyn ObjectStore>);
    let at = location(&name);
    for index in 0..2 {
        until_success("writing a shard", || {
            let mut writer = create_shard(&at, &schema(), exclusive(), Shard { index, count: 2 })?;
            for e in writer.episodes()..3 {
                writer.write_episode(&episode(3 * index + e))?;
            }
            writer.finish()
        });
    }
    until_success("committing shards", || commit_shards(&at));
    check_all(&name, &store, 6);
}

#[test]
fn failing_store_neither_loses_nor_doubles_episodes() {
    // In schedule 254, a commit was stored, and could not be read when its repetition conflicted with it.
    (0..6).chain([254]).for_each(collections);
    (0..3).for_each(shards);
}

#[test]
#[ignore = "takes minutes"]
fn a_thousand_schedules_of_faults_neither_lose_nor_double_episodes() {
    (0..700).for_each(collections);
    (0..300).for_each(shards);
}
