//! Storage of a Lance table: its location, its newest version, and commits of new versions.

use super::ENTRY;
use crate::dataset::{Location, objects};
use arrow_schema::Schema as ArrowSchema;
use bytes::Bytes;
use futures::TryStreamExt as _;
use futures::future::BoxFuture;
use lance_core::cache::LanceCache;
use lance_encoding::decoder::DecoderPlugins;
use lance_file::reader::{FileReader, FileReaderOptions};
use lance_io::object_store::ObjectStore;
use lance_io::scheduler::{ScanScheduler, SchedulerConfig};
use lance_table::feature_flags::{ensure_can_read_manifest, ensure_can_write_manifest};
use lance_table::format::{DataFile, Fragment, IndexMetadata, Manifest, ManifestBuildConfig};
use lance_table::io::commit::{
    CommitError, CommitHandler as _, ConditionalPutCommitHandler, ManifestLocation, ManifestNamingScheme,
    write_manifest_file_to_path,
};
use lance_table::io::manifest::{read_manifest, read_manifest_indexes};
use lance_table::transaction::{Operation, Transaction, validate_operation};
use object_store::path::Path as StorePath;
use object_store::{ObjectMeta, ObjectStoreExt as _};
use std::ffi::OsString;
use std::future::Future;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{Error, Result};
use url::Url;

/// Runs a future to completion. A panic in Lance, which damaged files can cause, becomes an error.
pub fn block_on<T, F>(label: &Path, action: &str, future: F) -> Result<T>
where
    T: Send + 'static,
    F: Future<Output = lance_core::Result<T>> + Send + 'static,
{
    match objects::block_on(future)? {
        Some(result) => result.map_err(|e| lance_error(label, action, &e)),
        None => Err(damaged(label, format!("{action}: the content is invalid"))),
    }
}

/// An error that reports a dataset with damaged files.
pub fn damaged(path: &Path, problem: impl Into<String>) -> Error {
    Error::corrupt(
        path,
        problem,
        "a file of the dataset is damaged or missing: restore it from a copy, or delete the dataset and collect it again",
    )
}

/// Converts Lance's errors: errors of the operating system become [`Error::Io`], errors of a remote store keep their
/// message, and all other errors mean that files are damaged.
fn lance_error(label: &Path, action: &str, error: &lance_core::Error) -> Error {
    let text = error.to_string();
    // Lance converts some system errors to text, which still contains their code.
    let code =
        text.split("(os error ").nth(1).and_then(|rest| rest.split(')').next()).and_then(|number| number.parse().ok());
    let remote = label.to_str().is_some_and(|label| label.contains("://"));
    match (code, error) {
        (Some(code), _) if !remote => Error::io(label, action, std::io::Error::from_raw_os_error(code)),
        (_, lance_core::Error::NotFound { uri, .. }) => damaged(label, format!("{action}: {uri} is missing")),
        (_, lance_core::Error::NotSupported { .. } | lance_core::Error::VersionConflict { .. }) => Error::corrupt(
            label,
            format!("{action}: {text}"),
            "this version cannot be read; rewrite the table with a current Lance",
        ),
        (_, lance_core::Error::IO { .. }) if remote => Error::external(format!("{}: {action}", label.display()), text),
        _ => damaged(label, format!("{action}: {text}")),
    }
}

/// Folders that may exist if a writer was killed before the first commit of a table.
const FOLDERS: [&str; 4] = ["_versions", "_transactions", "_shards", "data"];

/// Whether a location is a Lance table: its name ends in `.lance`, or it is a folder that contains such a table.
pub fn detect(location: &Location) -> bool {
    ENTRY.has_suffix(location)
        || location.path().is_some_and(|path| tables_in(path).is_ok_and(|tables| !tables.is_empty()))
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
    let Some(path) = location.path().filter(|_| !location.has_suffix("lance")) else { return Ok(location.clone()) };
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
        let objects = ObjectStore::new(store, scheme, Some(BLOCK), None, false, lists, REQUESTS, RETRIES, None);
        Ok(Self { label: location.label(), remote: true, lists, base, objects: Arc::new(objects) })
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
            let location = store.latest_location().await?;
            let bytes = store.objects.inner.get(&location.path).await?.bytes().await?;
            verify_checksum(&bytes)?;
            // Lance parses the verified bytes, not the object, which may have changed.
            let memory = ObjectStore::memory();
            memory.put(&location.path, &bytes).await?;
            let manifest = read_manifest(&memory, &location.path, Some(bytes.len() as u64)).await?;
            if manifest.version != location.version {
                return Err(corrupt(format!("version {} is stored as version {}", manifest.version, location.version)));
            }
            ensure_can_read_manifest(&manifest)?;
            let indices = read_manifest_indexes(&memory, &location, &manifest).await?;
            // Converting the schema here turns Lance's panic on unknown types into an error.
            let _ = ArrowSchema::from(&manifest.schema);
            Ok(Some(Version { manifest: Arc::new(manifest), indices }))
        })
    }

    fn has_versions(&self) -> Result<bool> {
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
                if store.latest_location().await?.version != manifest.version {
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
            let result = ConditionalPutCommitHandler
                .commit(
                    &mut next,
                    (!indices.is_empty()).then(|| indices.clone()),
                    &store.base,
                    &store.objects,
                    write_with_checksum,
                    ManifestNamingScheme::V2,
                    Some((&transaction).try_into()?),
                )
                .await;
            let location = match result {
                Ok(location) => location,
                Err(CommitError::CommitConflict) => return Ok(None),
                Err(CommitError::OtherError(error)) => return Err(error),
            };
            if !store.contains(next.version, &appended).await? {
                store.objects.delete(&location.path).await?;
                return Ok(None);
            }
            Ok(Some((Version { manifest: Arc::new(next), indices }, location.path)))
        })
    }

    /// Location of the newest version.
    async fn latest_location(&self) -> lance_core::Result<ManifestLocation> {
        ConditionalPutCommitHandler.resolve_latest_location(&self.base, &self.objects).await
    }

    /// Whether the newest version contains the appended fragments. Because old versions are deleted, a late commit may
    /// reuse the number of a version that other writers already replaced.
    async fn contains(&self, version: u64, appended: &[Fragment]) -> lance_core::Result<bool> {
        let newest = self.latest_location().await?;
        if newest.version == version || appended.is_empty() {
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

    /// Reads a whole file.
    ///
    /// # Errors
    /// If the file does not exist or reading fails.
    pub fn read(&self, path: &StorePath) -> Result<Bytes> {
        let (objects, path) = (Arc::clone(&self.objects), path.clone());
        block_on(&self.label, "reading a file", async move { Ok(objects.inner.get(&path).await?.bytes().await?) })
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

    /// Removes a file that is no longer used. A failure only wastes space, so it is logged and ignored.
    pub fn remove(&self, path: &StorePath) {
        let (objects, removed_path) = (Arc::clone(&self.objects), path.clone());
        let removed = block_on(&self.label, "removing a file", async move { objects.delete(&removed_path).await });
        if let Err(error) = removed {
            tracing::warn!(file = %path, "an unused file of the dataset could not be removed: {error}");
        }
    }

    /// The object store, for reading byte ranges.
    pub fn inner(&self) -> &dyn object_store::ObjectStore {
        &*self.objects.inner
    }

    /// Opens a data file for reading. Must run inside [`block_on`].
    pub async fn open_file(&self, file: &DataFile) -> lance_core::Result<FileReader> {
        let scheduler = ScanScheduler::new(Arc::clone(&self.objects), SchedulerConfig::max_bandwidth(&self.objects));
        let scheduler = scheduler.open_file(&self.data_path(&file.path), &file.file_size_bytes).await?;
        let plugins = Arc::<DecoderPlugins>::default();
        FileReader::try_open(scheduler, None, plugins, &LanceCache::no_cache(), FileReaderOptions::default()).await
    }
}

/// Number of bytes that Lance reads with one request.
const BLOCK: usize = 64 << 10;
/// Maximum number of concurrent requests of Lance.
const REQUESTS: usize = 64;
/// Number of retries of a failed download.
const RETRIES: usize = 3;

/// Start of the checksum in a manifest's file; a BLAKE3 hash of all other bytes of the file follows. The checksum is
/// stored before Lance's protobuf message, whose offset is in the file's footer, so other readers skip the checksum.
const CHECKSUM_TAG: &[u8; 8] = b"swmSEAL1";
/// Size of the checksum in bytes: the tag and the hash.
const CHECKSUM_LEN: usize = CHECKSUM_TAG.len() + 32;
/// Size of the footer in bytes: offset of the message, format versions, and magic number.
const FOOTER: usize = 16;

/// Writes a manifest as Lance does, with a checksum.
fn write_with_checksum<'a>(
    objects: &'a ObjectStore,
    manifest: &'a mut Manifest,
    indices: Option<Vec<IndexMetadata>>,
    path: &'a StorePath,
    transaction: Option<lance_table::format::Transaction>,
) -> BoxFuture<'a, lance_core::Result<lance_io::object_writer::WriteResult>> {
    Box::pin(async move {
        let memory = ObjectStore::memory();
        write_manifest_file_to_path(&memory, manifest, indices, path, transaction).await?;
        let plain = memory.read_one_all(path).await?;
        objects.put(path, &with_checksum(&plain)?).await
    })
}

/// Offset of the message in a manifest's file.
fn message_start(file: &[u8]) -> lance_core::Result<usize> {
    let start = file.len().checked_sub(FOOTER).and_then(|at| file[at..].first_chunk());
    let start = start.and_then(|&bytes| usize::try_from(u64::from_le_bytes(bytes)).ok());
    start.filter(|&start| start <= file.len() - FOOTER).ok_or_else(|| corrupt("a manifest is truncated".to_owned()))
}

/// Adds a checksum before the message of a manifest's file.
fn with_checksum(plain: &[u8]) -> lance_core::Result<Vec<u8>> {
    let start = message_start(plain)?;
    let (before, message) = plain.split_at(start);
    let mut after = message.to_vec();
    let footer = after.len() - FOOTER;
    after[footer..footer + 8].copy_from_slice(&((start + CHECKSUM_LEN) as u64).to_le_bytes());
    let hash = blake3::Hasher::new().update(before).update(&after).finalize();
    Ok([before, CHECKSUM_TAG, hash.as_bytes(), &after].concat())
}

/// Verifies the checksum of a manifest's file, if there is one. Manifests of other writers have no checksum.
fn verify_checksum(file: &[u8]) -> lance_core::Result<()> {
    let start = message_start(file)?;
    let Some(checksum) = start.checked_sub(CHECKSUM_LEN).filter(|&checksum| file[checksum..].starts_with(CHECKSUM_TAG))
    else {
        return Ok(());
    };
    let hash = blake3::Hasher::new().update(&file[..checksum]).update(&file[start..]).finalize();
    if file[checksum + CHECKSUM_TAG.len()..start] == *hash.as_bytes() {
        return Ok(());
    }
    Err(corrupt("the newest manifest does not match its hash".to_owned()))
}

fn corrupt(problem: String) -> lance_core::Error {
    lance_core::Error::internal(problem)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lance_errors_keep_the_system_error_code() {
        let full = lance_core::Error::io("failed to persist: No space left on device (os error 28)".to_owned());
        let error = lance_error(Path::new("x.lance"), "writing", &full);
        assert!(matches!(&error, Error::Io { source, .. } if source.kind() == ErrorKind::StorageFull));
        assert!(error.to_string().contains("committed episodes are kept"));
    }

    #[test]
    fn manifest_checksum_detects_flipped_bits() {
        let plain = [&b"transaction"[..], &7_u32.to_le_bytes(), b"message", &11_u64.to_le_bytes(), b"\0\0\x02\0LANC"];
        let plain = plain.concat();
        assert!(verify_checksum(&plain).is_ok(), "a manifest of another writer has no checksum");
        let intact = with_checksum(&plain).expect("adding a checksum");
        assert_eq!(&intact[message_start(&intact).expect("finding the message")..][4..11], b"message");
        assert!(verify_checksum(&intact).is_ok());
        for at in (0..intact.len()).filter(|at| !(11..19).contains(at)) {
            let mut damaged = intact.clone();
            damaged[at] ^= 4;
            let in_message_offset = at >= intact.len() - FOOTER && at < intact.len() - 8;
            assert!(verify_checksum(&damaged).is_err() || in_message_offset, "byte {at}");
        }
    }
}
