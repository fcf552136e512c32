//! Storage of a Lance table: its location, its newest version, and commits of new versions.

mod latest;

use super::errors::{damaged, lance_error};
use super::{ENTRY, manifest_file};
use crate::dataset::{Location, objects};
use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use lance_core::cache::LanceCache;
use lance_encoding::decoder::DecoderPlugins;
use lance_file::reader::{FileReader, FileReaderOptions};
use lance_io::object_store::ObjectStore;
use lance_io::scheduler::{ScanScheduler, SchedulerConfig};
use lance_table::feature_flags::ensure_can_write_manifest;
use lance_table::format::{DataFile, Fragment, IndexMetadata, Manifest, ManifestBuildConfig};
use lance_table::io::commit::{
    CommitHandler as _, ConditionalPutCommitHandler, ManifestLocation, ManifestNamingScheme, write_version_hint,
};
use lance_table::io::manifest::read_manifest;
use lance_table::transaction::{Operation, Transaction, validate_operation};
use object_store::path::Path as StorePath;
use object_store::{ObjectMeta, ObjectStoreExt as _, PutMode, PutOptions};
use std::ffi::OsString;
use std::future::Future;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};
use url::Url;

/// Runs a future to completion. A panic in Lance, which damaged files can cause, becomes an error.
///
/// # Errors
/// The errors of the future, or threads that cannot be started.
pub fn block_on<T, F>(label: &Path, action: &str, future: F) -> Result<T>
where
    T: Send + 'static,
    F: Future<Output = lance_core::Result<T>> + Send + 'static,
{
    objects::start_lance()?;
    match objects::block_on(future)? {
        Some(result) => result.map_err(|e| lance_error(label, action, &e)),
        None => Err(damaged(label, format!("{action}: the content is invalid"))),
    }
}

/// Folders that may exist if a writer was killed before the first commit of a table.
pub const FOLDERS: [&str; 4] = ["_versions", "_transactions", "_shards", "data"];

/// Whether a location is a Lance table: its name ends in `.lance`, or it is a folder with versions of a table, or one that
/// contains such a table.
pub fn detect(location: &Location) -> bool {
    ENTRY.has_suffix(location)
        || location.path().is_some_and(is_table)
        || location.path().is_some_and(|path| tables_in(path).is_ok_and(|tables| !tables.is_empty()))
}

/// Whether a folder is a table, whatever its name.
fn is_table(folder: &Path) -> bool {
    folder.join("_versions").is_dir()
}

fn tables_in(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut tables = vec![];
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if ENTRY.has_suffix(&Location::from(&path)) {
            tables.push(path);
        }
    }
    tables.sort();
    Ok(tables)
}

/// The location of the table: `location` itself, or the only table in that folder.
fn table(location: &Location) -> Result<Location> {
    let is_folder = |path: &&Path| !location.has_suffix("lance") && path.is_dir() && !is_table(path);
    let Some(path) = location.path().filter(is_folder) else { return Ok(location.clone()) };
    let tables = tables_in(path).map_err(|e| Error::io(path, "listing the folder", e))?;
    match &tables[..] {
        [table] => Ok(Location::from(table)),
        _ => {
            let names: Vec<String> = tables.iter().map(|t| t.display().to_string()).collect();
            Err(Error::config(
                "dataset",
                format!("{} holds several tables: {}", path.display(), names.join(", ")),
                "name one of them",
            ))
        }
    }
}

/// One version of a table.
#[derive(Clone)]
pub struct Version {
    /// Fragments, schema and metadata.
    pub manifest: Arc<Manifest>,
    /// Indices that other tools may have built; copied to new versions.
    pub indices: Vec<IndexMetadata>,
}

/// Location of a table and access to its objects.
#[derive(Clone)]
pub struct Store {
    /// The location in error messages: the absolute path or the URI.
    pub label: PathBuf,
    /// Whether the table is in an object store.
    pub remote: bool,
    /// Whether objects can be listed. Web servers usually have no listing.
    pub lists: bool,
    base: StorePath,
    objects: Arc<ObjectStore>,
}

impl Store {
    /// Opens the storage at a location. The table need not exist yet.
    ///
    /// # Errors
    /// If the location is invalid, or this build does not support its scheme.
    pub fn new(location: &Location) -> Result<Self> {
        let location = table(location)?;
        let (store, base) = objects::store(&location)?;
        let Location::Uri(url) = &location else {
            let label = std::path::absolute(location.label())
                .map_err(|e| Error::io(location.label(), "resolving the path", e))?;
            let objects = Arc::new(ObjectStore::local());
            return Ok(Self { label, remote: false, lists: true, base, objects });
        };
        let lists = !url.scheme().starts_with("http");
        // This build does not include Lance's own object stores, so `store` is passed to Lance, with any scheme that
        // Lance supports.
        let scheme = Url::parse("memory:///").map_err(|e| Error::external("opening an object store", e))?;
        let ordered = lists && objects::lists_in_order(url);
        let store = Arc::new(objects::Unchanged::new(store, base.clone().join("data"), hash_in_name));
        let objects = ObjectStore::new(store, scheme, Some(BLOCK), None, false, ordered, REQUESTS, RETRIES, None);
        Ok(Self { label: location.label(), remote: true, lists, base, objects: Arc::new(objects) })
    }

    /// Locks a subfolder of a local table against other exclusive writers; `None` for an object store.
    ///
    /// # Errors
    /// If another process holds the lock.
    pub fn lock(&self, subfolder: &str) -> Result<Option<Lock>> {
        if self.remote {
            return Ok(None);
        }
        Lock::folder(&self.label.join(subfolder)).map(Some)
    }

    /// Checks that no folder of a local table is a symbolic link, because files elsewhere would be written, or deleted.
    ///
    /// # Errors
    /// If a folder is a link.
    pub fn check_no_links(&self) -> Result<()> {
        if self.remote {
            return Ok(());
        }
        FOLDERS.iter().try_for_each(|name| files::check_no_link(&self.label.join(name)))
    }

    /// Checks that the location can be written.
    ///
    /// # Errors
    /// If the location is on a web server.
    pub fn check_writable(&self) -> Result<()> {
        if self.lists {
            return Ok(());
        }
        let problem = format!("{} cannot be written: it is read over HTTP", self.label.display());
        Err(Error::config("dataset", problem, "write to a path or to s3://, gs:// or az://"))
    }

    fn has_versions(&self) -> Result<bool> {
        if !self.remote {
            // A list of the store has no pipes, but Lance lists local versions itself.
            files::entries(&self.label.join("_versions"))?.iter().try_for_each(|path| check_regular(path))?;
        }
        Ok(self.list("_versions")?.iter().any(|meta| meta.location.extension() == Some("manifest")))
    }

    /// Checks that a local folder holds nothing but leftovers of a table that was never committed. Object stores have
    /// no folders, so other objects do not conflict.
    fn check_free(&self) -> Result<()> {
        if self.remote {
            return Ok(());
        }
        for name in self.entries()? {
            let hidden = name.as_encoded_bytes().starts_with(b".");
            if !hidden && !FOLDERS.iter().any(|&known| name == known) {
                let problem = format!("the folder holds '{}' and is not a Lance table", name.display());
                return Err(Error::corrupt(&self.label, problem, "choose another path"));
            }
        }
        Ok(())
    }

    /// Names in the folder; empty if the folder does not exist.
    fn entries(&self) -> Result<Vec<OsString>> {
        let io = |e| Error::io(&self.label, "listing the folder", e);
        match std::fs::read_dir(&self.label) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(vec![]),
            Err(e) => Err(io(e)),
            Ok(entries) => entries.map(|entry| entry.map(|entry| entry.file_name()).map_err(io)).collect(),
        }
    }

    /// Applies an operation to version `current` (`None` if there is no table yet) and commits the result atomically as
    /// the next version. Returns the new version and the path of its manifest, or `None` if another process committed
    /// that version first.
    ///
    /// # Errors
    /// If the operation does not fit the table, or writing fails.
    pub fn commit(
        &self,
        current: Option<&Version>,
        operation: Operation,
        config: ManifestBuildConfig,
    ) -> Result<Option<(Version, StorePath)>> {
        let store = self.clone();
        let current = current.cloned();
        block_on(&self.label, "committing a version", async move {
            let manifest = current.as_ref().map(|version| &*version.manifest);
            if let Some(manifest) = manifest {
                ensure_can_write_manifest(manifest)?;
                if !store.is_latest(manifest.version).await? {
                    return Ok(None);
                }
            }
            validate_operation(manifest, &operation)?;
            let appended = match &operation {
                Operation::Append { fragments } => fragments.clone(),
                _ => vec![],
            };
            let transaction = Transaction::new(manifest.map_or(0, |m| m.version), operation, None);
            let indices = current.as_ref().map(|version| version.indices.clone()).unwrap_or_default();
            // The manifest contains the transaction, so no separate transaction file is needed.
            let (mut next, indices) = transaction.build_manifest(manifest, indices, "", &config)?;
            let path = ManifestNamingScheme::V2.manifest_path(&store.base, next.version);
            let stored_indices = (!indices.is_empty()).then(|| indices.clone());
            let bytes = manifest_file::encode(&mut next, stored_indices, &path, (&transaction).try_into()?).await?;
            if !store.put_new(&path, bytes.into()).await? {
                return Ok(None);
            }
            write_version_hint(&store.objects, &store.base, next.version).await;
            if !store.contains(next.version, &appended).await? {
                store.objects.delete(&path).await?;
                return Ok(None);
            }
            Ok(Some((Version { manifest: Arc::new(next), indices }, path)))
        })
    }

    /// Location of the newest version.
    async fn latest_location(&self) -> lance_core::Result<ManifestLocation> {
        ConditionalPutCommitHandler.resolve_latest_location(&self.base, &self.objects).await
    }

    /// Whether a version of this process is the newest one. A list of an object store may be older than the version.
    async fn is_latest(&self, version: u64) -> lance_core::Result<bool> {
        let newest = self.latest_location().await?.version;
        if newest >= version || !self.remote {
            return Ok(newest == version);
        }
        self.objects.exists(&ManifestNamingScheme::V2.manifest_path(&self.base, version)).await
    }

    /// Writes an object unless one of that name exists, and returns whether the object has this content. If the answer
    /// to a request is lost, its repetition finds the object that the request wrote.
    async fn put_new(&self, path: &StorePath, content: Bytes) -> lance_core::Result<bool> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        let Err(error) = self.objects.inner.put_opts(path, content.clone().into(), options).await else {
            return Ok(true);
        };
        // If the object cannot be read, it may be this one: the caller must not delete what it refers to.
        let stored = match self.objects.inner.get(path).await {
            // A file of another size, which may be any, is not read.
            Ok(stored) if stored.meta.size != content.len() as u64 => Some(Bytes::new()),
            Ok(stored) => Some(stored.bytes().await?),
            Err(object_store::Error::NotFound { .. }) => None,
            Err(unreadable) => return Err(unreadable.into()),
        };
        match (stored, error) {
            (Some(stored), _) if stored == content => Ok(true),
            (_, object_store::Error::AlreadyExists { .. } | object_store::Error::Precondition { .. }) => Ok(false),
            (_, error) => Err(error.into()),
        }
    }

    /// Whether the newest version contains the appended fragments. Because old versions are deleted, a late commit may
    /// reuse the number of a version that other writers already replaced.
    async fn contains(&self, version: u64, appended: &[Fragment]) -> lance_core::Result<bool> {
        let newest = self.latest_location().await?;
        // A list that is older than this commit shows an older version.
        if newest.version <= version || appended.is_empty() {
            return Ok(true);
        }
        let manifest = read_manifest(&self.objects, &newest.path, newest.size).await?;
        let holds = |file: &DataFile| manifest.fragments.iter().flat_map(|f| &f.files).any(|f| f.path == file.path);
        Ok(appended.iter().flat_map(|fragment| &fragment.files).all(holds))
    }

    /// The path of a file below the table's folder; `inside` uses `/` as separator.
    pub fn path(&self, inside: &str) -> StorePath {
        inside.split('/').filter(|part| !part.is_empty()).fold(self.base.clone(), StorePath::join)
    }

    /// The path of a data file.
    pub fn data_path(&self, name: &str) -> StorePath {
        self.base.clone().join("data").join(name)
    }

    /// The local path of a file.
    pub fn local(&self, path: &StorePath) -> PathBuf {
        Path::new("/").join(path.as_ref())
    }

    /// All files below a subfolder; empty if the subfolder does not exist.
    ///
    /// # Errors
    /// If listing fails.
    pub fn list(&self, subfolder: &str) -> Result<Vec<ObjectMeta>> {
        let (objects, prefix) = (Arc::clone(&self.objects), self.path(subfolder));
        let mut files: Vec<ObjectMeta> = block_on(&self.label, "listing the dataset", async move {
            match objects.inner.list(Some(&prefix)).try_collect().await {
                Err(object_store::Error::NotFound { .. }) => Ok(vec![]),
                listed => Ok(listed?),
            }
        })?;
        files.sort_by(|a, b| a.location.cmp(&b.location));
        Ok(files)
    }

    /// Reads whole files, several at the same time, in the given order.
    ///
    /// # Errors
    /// If the file does not exist or reading fails.
    pub fn read_all(&self, paths: Vec<StorePath>) -> Result<Vec<Bytes>> {
        if !self.remote {
            paths.iter().try_for_each(|path| check_regular(&self.local(path)))?;
        }
        let objects = Arc::clone(&self.objects);
        let read = move |path: StorePath| {
            let objects = Arc::clone(&objects);
            async move { manifest_file::read_whole(&objects, &path).await }
        };
        block_on(&self.label, "reading files", futures::stream::iter(paths).map(read).buffered(REQUESTS).try_collect())
    }

    /// Writes a whole file, which becomes visible when it is complete.
    ///
    /// # Errors
    /// If writing fails.
    pub fn write(&self, path: &StorePath, content: Bytes) -> Result<()> {
        let (objects, path, remote) = (Arc::clone(&self.objects), path.clone(), self.remote);
        block_on(&self.label, "writing a file", async move {
            if remote {
                // Makes a multipart upload, which retries each part separately.
                objects.put(&path, &content).await?;
            } else {
                // Lance's own writer does not report a full disk.
                objects.inner.put(&path, content.into()).await?;
            }
            Ok(())
        })
    }

    /// Writes a whole file that must not exist yet, and returns whether this process wrote it.
    ///
    /// # Errors
    /// If writing fails.
    pub fn write_new(&self, path: &StorePath, content: Bytes) -> Result<bool> {
        let (store, path) = (self.clone(), path.clone());
        block_on(&self.label, "writing a file", async move { store.put_new(&path, content).await })
    }

    /// Removes a file that is no longer used. A failure only wastes space, so it is logged and ignored.
    pub fn remove(&self, path: &StorePath) {
        let (objects, removed_path) = (Arc::clone(&self.objects), path.clone());
        let removed = block_on(&self.label, "removing a file", async move { objects.delete(&removed_path).await });
        if let Err(error) = removed {
            tracing::warn!(file = %path, "an unused file of the dataset could not be removed: {error}");
        }
    }

    /// Removes files that are no longer used, several at the same time. As [`Store::remove`], it ignores failures.
    pub fn remove_all(&self, paths: Vec<StorePath>) {
        let objects = Arc::clone(&self.objects);
        let remove = move |path: StorePath| {
            let objects = Arc::clone(&objects);
            async move {
                if let Err(error) = objects.delete(&path).await {
                    tracing::warn!(file = %path, "an unused file of the dataset could not be removed: {error}");
                }
            }
        };
        let all = async move {
            futures::stream::iter(paths).for_each_concurrent(REQUESTS, remove).await;
            Ok(())
        };
        if let Err(error) = block_on(&self.label, "removing files", all) {
            tracing::warn!("unused files of the dataset could not be removed: {error}");
        }
    }

    /// The object store, for reading byte ranges.
    pub fn inner(&self) -> &dyn object_store::ObjectStore {
        &*self.objects.inner
    }

    /// The BLAKE3 hash of an object, in hexadecimal.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn hash_object(&self, path: &StorePath) -> Result<String> {
        let (store, path) = (Arc::clone(&self.objects), path.clone());
        block_on(
            &self.label,
            "hashing a data file",
            async move { Ok(objects::hash_object(&*store.inner, &path).await?.0) },
        )
    }

    /// Opens a data file for reading. Must run inside [`block_on`].
    pub async fn open_file(&self, file: &DataFile) -> lance_core::Result<FileReader> {
        let scheduler = ScanScheduler::new(Arc::clone(&self.objects), SchedulerConfig::max_bandwidth(&self.objects));
        let scheduler = scheduler.open_file(&self.data_path(&file.path), &file.file_size_bytes).await?;
        let plugins = Arc::<DecoderPlugins>::default();
        FileReader::try_open(scheduler, None, plugins, &LanceCache::no_cache(), FileReaderOptions::default()).await
    }
}

/// Checks that a file is a regular file, if it exists: Lance would wait for ever for the content of a pipe. Other writers
/// may delete files of old versions at any time.
fn check_regular(path: &Path) -> Result<()> {
    match files::open(path) {
        Err(error @ Error::Corrupt { .. }) => Err(error),
        _ => Ok(()),
    }
}

/// Number of bytes that Lance reads with one request.
const BLOCK: usize = 64 << 10;
/// Maximum number of concurrent requests of Lance.
const REQUESTS: usize = 64;
/// Number of retries of a failed download.
const RETRIES: usize = 3;

/// Whether a file in `_versions` has a name that Lance gives to a version: digits.
pub fn is_version(name: &str) -> bool {
    name.strip_suffix(".manifest").is_some_and(|number| number.bytes().all(|b| b.is_ascii_digit()))
}

/// The name of a data file: the hash of its content, so that damage can be detected before decoding.
pub fn name_of_hash(hash: blake3::Hash) -> String {
    format!("{}.lance", hash.to_hex())
}

/// The BLAKE3 hash of a file, in hexadecimal.
pub fn hash_file(path: &Path) -> std::io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(std::fs::File::open(path)?)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// The hash in the name of a data file; `None` for files of other tools.
pub fn hash_in_name(name: &str) -> Option<&str> {
    let stem = name.strip_suffix(".lance")?;
    (stem.len() == 64 && stem.bytes().all(|b| b.is_ascii_hexdigit())).then_some(stem)
}
