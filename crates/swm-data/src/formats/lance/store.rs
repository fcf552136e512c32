//! A Lance table: where it is, its newest version, and how a new version is committed.

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

/// Runs asynchronous code to its end. A panic in Lance, which damaged files can provoke, becomes an error.
pub fn wait<T, F>(label: &Path, action: &str, future: F) -> Result<T>
where
    T: Send + 'static,
    F: Future<Output = lance_core::Result<T>> + Send + 'static,
{
    match objects::wait(future)? {
        Some(result) => result.map_err(|e| explain(label, action, &e)),
        None => Err(damaged(label, format!("{action}: its content makes no sense"))),
    }
}

/// The error of a dataset whose files are damaged.
pub fn damaged(path: &Path, problem: impl Into<String>) -> Error {
    Error::corrupt(
        path,
        problem,
        "a file of the dataset is damaged or missing: restore it from a copy, or delete the dataset and collect it again",
    )
}

/// Lance's error in our words: what the operating system refused is [`Error::Io`], what a store on the network refused
/// is its own message, all else means that the files are not what they should be.
fn explain(label: &Path, action: &str, error: &lance_core::Error) -> Error {
    let text = error.to_string();
    // Lance turns some system errors into text; their number survives.
    let code =
        text.split("(os error ").nth(1).and_then(|rest| rest.split(')').next()).and_then(|number| number.parse().ok());
    let remote = label.to_str().is_some_and(|label| label.contains("://"));
    match (code, error) {
        (Some(code), _) if !remote => Error::io(label, action, std::io::Error::from_raw_os_error(code)),
        (_, lance_core::Error::NotFound { uri, .. }) => damaged(label, format!("{action}: {uri} is missing")),
        (_, lance_core::Error::NotSupported { .. } | lance_core::Error::VersionConflict { .. }) => Error::corrupt(
            label,
            format!("{action}: {text}"),
            "this build cannot read that; rewrite it with a current Lance",
        ),
        (_, lance_core::Error::IO { .. }) if remote => Error::external(format!("{}: {action}", label.display()), text),
        _ => damaged(label, format!("{action}: {text}")),
    }
}

/// What a table leaves in its folder when it is killed before its first commit.
const FOLDERS: [&str; 4] = ["_versions", "_transactions", "_shards", "data"];

/// Whether a location names a Lance table: it ends in `.lance`, or is a folder that holds one that does.
pub fn looks_like(location: &Location) -> bool {
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

/// The table that a location names.
fn table(location: &Location) -> Result<Location> {
    let Some(path) = location.path().filter(|_| !location.has_suffix("lance")) else { return Ok(location.clone()) };
    let tables = tables_in(path).map_err(|e| Error::io(path, "listing the folder", e))?;
    match &tables[..] {
        [table] => Ok(Location::from(table)),
        _ => {
            let names: Vec<String> = tables.iter().map(|t| t.display().to_string()).collect();
            Err(Error::config("dataset", format!("{} holds several: {}", path.display(), names.join(", ")), "name one"))
        }
    }
}

/// One version of a table.
#[derive(Clone)]
pub struct Version {
    /// Fragments, schema and metadata.
    pub manifest: Arc<Manifest>,
    /// Indices that others may have built; carried along.
    pub indices: Vec<IndexMetadata>,
}

/// A table's folder and the machinery to reach it.
#[derive(Clone)]
pub struct Store {
    /// What messages call it: its absolute path or its URI.
    pub label: PathBuf,
    /// Whether it is in an object store.
    pub remote: bool,
    /// Whether objects can be listed; a web server commonly cannot.
    pub lists: bool,
    base: StorePath,
    objects: Arc<ObjectStore>,
}

impl Store {
    /// The table of a location, which need not exist.
    ///
    /// # Errors
    /// When the location makes no sense, or this build does not reach it.
    pub fn new(location: &Location) -> Result<Self> {
        let location = table(location)?;
        let (store, base) = objects::store(&location)?;
        let Location::Uri(url) = &location else {
            let label =
                std::path::absolute(location.label()).map_err(|e| Error::io(location.label(), "finding it", e))?;
            let objects = Arc::new(ObjectStore::local());
            return Ok(Self { label, remote: false, lists: true, base, objects });
        };
        let lists = !url.scheme().starts_with("http");
        // The stores that Lance would make itself are left out of this build. What it wants to know of one it is told
        // here, so any scheme serves that it has heard of.
        let scheme = Url::parse("memory:///").map_err(|e| Error::external("opening an object store", e))?;
        let objects = ObjectStore::new(store, scheme, Some(BLOCK), None, false, lists, REQUESTS, RETRIES, None);
        Ok(Self { label: location.label(), remote: true, lists, base, objects: Arc::new(objects) })
    }

    /// Checks that it is a place to write to.
    ///
    /// # Errors
    /// When it is a web server's.
    pub fn check_writable(&self) -> Result<()> {
        if self.lists {
            return Ok(());
        }
        let problem = format!("{} cannot be written: it is read over HTTP", self.label.display());
        Err(Error::config("dataset", problem, "write to a path or to s3://, gs:// or az://"))
    }

    /// The newest version; `None` where there is no table yet.
    ///
    /// # Errors
    /// When the folder holds something else, or the newest version cannot be read.
    pub fn latest(&self) -> Result<Option<Version>> {
        if self.lists && !self.has_versions()? {
            return self.check_free().map(|()| None);
        }
        let store = self.clone();
        wait(&self.label, "reading the newest version", async move {
            let location = store.newest().await?;
            let bytes = store.objects.inner.get(&location.path).await?.bytes().await?;
            check_seal(&bytes)?;
            // Lance reads what was checked, not what may be there by now.
            let memory = ObjectStore::memory();
            memory.put(&location.path, &bytes).await?;
            let manifest = read_manifest(&memory, &location.path, Some(bytes.len() as u64)).await?;
            if manifest.version != location.version {
                return Err(corrupt(format!("version {} is named {}", manifest.version, location.version)));
            }
            ensure_can_read_manifest(&manifest)?;
            let indices = read_manifest_indexes(&memory, &location, &manifest).await?;
            // Lance panics on types it does not know, once it is too late to report them.
            let _ = ArrowSchema::from(&manifest.schema);
            Ok(Some(Version { manifest: Arc::new(manifest), indices }))
        })
    }

    fn has_versions(&self) -> Result<bool> {
        Ok(self.list("_versions")?.iter().any(|meta| meta.location.extension() == Some("manifest")))
    }

    /// Checks that the folder holds nothing but what a table that was never committed may have left. In an object
    /// store there are no folders, and nothing of others is in the way.
    fn check_free(&self) -> Result<()> {
        if self.remote {
            return Ok(());
        }
        for name in self.entries()? {
            let hidden = name.as_encoded_bytes().starts_with(b".");
            if !hidden && !FOLDERS.iter().any(|&known| name == known) {
                let problem = format!("the folder holds '{}' and is no Lance table", name.display());
                return Err(Error::corrupt(&self.label, problem, "choose another path"));
            }
        }
        Ok(())
    }

    /// The names in the folder; none where there is no such folder.
    fn entries(&self) -> Result<Vec<OsString>> {
        let io = |e| Error::io(&self.label, "listing the folder", e);
        match std::fs::read_dir(&self.label) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(vec![]),
            Err(e) => Err(io(e)),
            Ok(entries) => entries.map(|entry| entry.map(|entry| entry.file_name()).map_err(io)).collect(),
        }
    }

    /// Applies an operation to `current` (`None`: there is no table yet) and commits the result as the next version,
    /// atomically: `None` when somebody else committed it meanwhile. Gives the new version, and the path of its
    /// manifest.
    ///
    /// # Errors
    /// When the operation does not fit the table, or the system refuses.
    pub fn commit(
        &self,
        current: Option<&Version>,
        operation: Operation,
        config: ManifestBuildConfig,
    ) -> Result<Option<(Version, StorePath)>> {
        let store = self.clone();
        let current = current.cloned();
        wait(&self.label, "committing a version", async move {
            let manifest = current.as_ref().map(|version| &*version.manifest);
            if let Some(manifest) = manifest {
                ensure_can_write_manifest(manifest)?;
                if store.newest().await?.version != manifest.version {
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
            // The transaction is stored in the manifest itself, so it needs no file.
            let (mut next, indices) = transaction.build_manifest(manifest, indices, "", &config)?;
            let result = ConditionalPutCommitHandler
                .commit(
                    &mut next,
                    (!indices.is_empty()).then(|| indices.clone()),
                    &store.base,
                    &store.objects,
                    write_sealed,
                    ManifestNamingScheme::V2,
                    Some((&transaction).try_into()?),
                )
                .await;
            let location = match result {
                Ok(location) => location,
                Err(CommitError::CommitConflict) => return Ok(None),
                Err(CommitError::OtherError(error)) => return Err(error),
            };
            if !store.holds(next.version, &appended).await? {
                store.objects.delete(&location.path).await?;
                return Ok(None);
            }
            Ok(Some((Version { manifest: Arc::new(next), indices }, location.path)))
        })
    }

    /// Where the newest version is.
    async fn newest(&self) -> lance_core::Result<ManifestLocation> {
        ConditionalPutCommitHandler.resolve_latest_location(&self.base, &self.objects).await
    }

    /// Whether what was appended in a version is part of the newest one. Old versions are removed, so who commits late
    /// may find the name of one free that others long committed, and went on from.
    async fn holds(&self, version: u64, appended: &[Fragment]) -> lance_core::Result<bool> {
        let newest = self.newest().await?;
        if newest.version == version || appended.is_empty() {
            return Ok(true);
        }
        let manifest = read_manifest(&self.objects, &newest.path, newest.size).await?;
        let holds = |file: &DataFile| manifest.fragments.iter().flat_map(|f| &f.files).any(|f| f.path == file.path);
        Ok(appended.iter().flat_map(|fragment| &fragment.files).all(holds))
    }

    /// The path of a file below the table's folder, its parts separated by `/`.
    pub fn path(&self, inside: &str) -> StorePath {
        inside.split('/').filter(|part| !part.is_empty()).fold(self.base.clone(), StorePath::join)
    }

    /// The path of a data file.
    pub fn data_path(&self, name: &str) -> StorePath {
        self.base.clone().join("data").join(name)
    }

    /// Where a file of this machine is.
    pub fn local(&self, path: &StorePath) -> PathBuf {
        Path::new("/").join(path.as_ref())
    }

    /// All files below a part of the folder; none where there is no such part.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn list(&self, part: &str) -> Result<Vec<ObjectMeta>> {
        let (objects, prefix) = (Arc::clone(&self.objects), self.path(part));
        let mut files: Vec<ObjectMeta> = wait(&self.label, "listing the dataset", async move {
            match objects.inner.list(Some(&prefix)).try_collect().await {
                Err(object_store::Error::NotFound { .. }) => Ok(vec![]),
                listed => Ok(listed?),
            }
        })?;
        files.sort_by(|a, b| a.location.cmp(&b.location));
        Ok(files)
    }

    /// A whole file.
    ///
    /// # Errors
    /// When there is none, or the system refuses.
    pub fn read(&self, path: &StorePath) -> Result<Bytes> {
        let (objects, path) = (Arc::clone(&self.objects), path.clone());
        wait(&self.label, "reading a file", async move { Ok(objects.inner.get(&path).await?.bytes().await?) })
    }

    /// Writes a whole file, which appears when it is complete.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn write(&self, path: &StorePath, content: Bytes) -> Result<()> {
        let (objects, path, remote) = (Arc::clone(&self.objects), path.clone(), self.remote);
        wait(&self.label, "writing a file", async move {
            if remote {
                // In parts, which are tried again one by one.
                objects.put(&path, &content).await?;
            } else {
                // Not Lance's writer, which does not notice that a disk is full.
                objects.inner.put(&path, content.into()).await?;
            }
            Ok(())
        })
    }

    /// Removes a file that nothing needs any more; that it stays does no harm but for its size.
    pub fn remove(&self, path: &StorePath) {
        let (objects, gone) = (Arc::clone(&self.objects), path.clone());
        let removed = wait(&self.label, "removing a file", async move { objects.delete(&gone).await });
        if let Err(error) = removed {
            tracing::warn!(file = %path, "an old file of the dataset stays: {error}");
        }
    }

    /// Where objects are read by ranges.
    pub fn inner(&self) -> &dyn object_store::ObjectStore {
        &*self.objects.inner
    }

    /// Opens a data file for reading. Must run inside [`wait`].
    pub async fn open_file(&self, file: &DataFile) -> lance_core::Result<FileReader> {
        let scheduler = ScanScheduler::new(Arc::clone(&self.objects), SchedulerConfig::max_bandwidth(&self.objects));
        let scheduler = scheduler.open_file(&self.data_path(&file.path), &file.file_size_bytes).await?;
        let plugins = Arc::<DecoderPlugins>::default();
        FileReader::try_open(scheduler, None, plugins, &LanceCache::no_cache(), FileReaderOptions::default()).await
    }
}

/// What Lance reads at once of an object, how many requests it has in flight, and how often it tries again.
const BLOCK: usize = 64 << 10;
/// See [`BLOCK`].
const REQUESTS: usize = 64;
/// See [`BLOCK`].
const RETRIES: usize = 3;

/// A mark, and after it a BLAKE3 hash of all other bytes of a manifest's file. It stands before Lance's message, whose
/// place is in the file's last bytes, so that others pass over it.
const SEAL: &[u8; 8] = b"swmSEAL1";
/// See [`SEAL`].
const SEAL_LEN: usize = SEAL.len() + 32;
/// Where the message begins, format versions, and a magic number.
const FOOTER: usize = 16;

/// Writes a manifest as Lance does, with a seal.
fn write_sealed<'a>(
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
        objects.put(path, &sealed(&plain)?).await
    })
}

/// Where the message of a manifest's file begins.
fn message_start(file: &[u8]) -> lance_core::Result<usize> {
    let start = file.len().checked_sub(FOOTER).and_then(|at| file[at..].first_chunk());
    let start = start.and_then(|&bytes| usize::try_from(u64::from_le_bytes(bytes)).ok());
    start.filter(|&start| start <= file.len() - FOOTER).ok_or_else(|| corrupt("a manifest has no end".to_owned()))
}

/// A manifest's file with a seal before its message.
fn sealed(plain: &[u8]) -> lance_core::Result<Vec<u8>> {
    let start = message_start(plain)?;
    let (before, message) = plain.split_at(start);
    let mut after = message.to_vec();
    let footer = after.len() - FOOTER;
    after[footer..footer + 8].copy_from_slice(&((start + SEAL_LEN) as u64).to_le_bytes());
    let hash = blake3::Hasher::new().update(before).update(&after).finalize();
    Ok([before, SEAL, hash.as_bytes(), &after].concat())
}

/// Checks the seal of a manifest's file, if it has one: those that others wrote do not.
fn check_seal(file: &[u8]) -> lance_core::Result<()> {
    let start = message_start(file)?;
    let Some(seal) = start.checked_sub(SEAL_LEN).filter(|&seal| file[seal..].starts_with(SEAL)) else { return Ok(()) };
    let hash = blake3::Hasher::new().update(&file[..seal]).update(&file[start..]).finalize();
    if file[seal + SEAL.len()..start] == *hash.as_bytes() {
        return Ok(());
    }
    Err(corrupt("the newest manifest does not match its hash".to_owned()))
}

fn corrupt(problem: String) -> lance_core::Error {
    lance_core::Error::internal(problem)
}

/// The name of a data file with that hash: its content is in its name, so damage is found before it does harm.
pub fn name_of_hash(hash: blake3::Hash) -> String {
    format!("{}.lance", hash.to_hex())
}

/// The BLAKE3 hash of a file, in hexadecimal.
pub fn hash_file(path: &Path) -> std::io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(std::fs::File::open(path)?)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// The hash in the name of a data file, where it was written here. Other tools name theirs otherwise.
pub fn hash_in_name(name: &str) -> Option<&str> {
    let stem = name.strip_suffix(".lance")?;
    (stem.len() == 64 && stem.bytes().all(|b| b.is_ascii_hexdigit())).then_some(stem)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn system_errors_keep_their_reason() {
        let full = lance_core::Error::io("failed to persist: No space left on device (os error 28)".to_owned());
        let error = explain(Path::new("x.lance"), "writing", &full);
        assert!(matches!(&error, Error::Io { source, .. } if source.kind() == ErrorKind::StorageFull));
        assert!(error.to_string().contains("committed episodes are kept"));
    }

    #[test]
    fn a_seal_finds_every_flipped_bit_but_its_own() {
        let plain = [&b"transaction"[..], &7_u32.to_le_bytes(), b"message", &11_u64.to_le_bytes(), b"\0\0\x02\0LANC"];
        let plain = plain.concat();
        assert!(check_seal(&plain).is_ok(), "those of others have none");
        let sound = sealed(&plain).expect("seals");
        assert_eq!(&sound[message_start(&sound).expect("a message")..][4..11], b"message");
        assert!(check_seal(&sound).is_ok());
        for at in (0..sound.len()).filter(|at| !(11..19).contains(at)) {
            let mut damaged = sound.clone();
            damaged[at] ^= 4;
            let in_place = at >= sound.len() - FOOTER && at < sound.len() - 8;
            assert!(check_seal(&damaged).is_err() || in_place, "byte {at}");
        }
    }
}
