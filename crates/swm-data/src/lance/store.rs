//! A Lance table on disk: where it is, its newest version, and how a new version is committed.

use crate::Location;
use arrow_schema::Schema as ArrowSchema;
use lance_core::cache::LanceCache;
use lance_encoding::decoder::DecoderPlugins;
use lance_file::reader::{FileReader, FileReaderOptions};
use lance_io::object_store::ObjectStore;
use lance_io::scheduler::{ScanScheduler, SchedulerConfig};
use lance_table::feature_flags::{ensure_can_read_manifest, ensure_can_write_manifest};
use lance_table::format::{DataFile, IndexMetadata, Manifest, ManifestBuildConfig};
use lance_table::io::commit::{
    CommitError, CommitHandler, ManifestNamingScheme, commit_handler_from_url, write_manifest_file_to_path,
};
use lance_table::io::manifest::{read_manifest, read_manifest_indexes};
use lance_table::transaction::{Operation, Transaction, validate_operation};
use object_store::path::Path as StorePath;
use std::ffi::{OsStr, OsString};
use std::future::Future;
use std::io::ErrorKind;
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock, mpsc};
use swm_core::{Error, Result};
use tokio::runtime::Runtime;

/// Lance's asynchronous code runs on two threads of its own, made at first use.
fn runtime() -> Result<&'static Runtime> {
    static RUNTIME: OnceLock<std::io::Result<Runtime>> = OnceLock::new();
    let made = RUNTIME.get_or_init(|| {
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).thread_name("swm-lance").enable_time().build()
    });
    made.as_ref().map_err(|e| Error::external("starting the threads that read datasets", e))
}

/// Runs asynchronous code to its end, from any thread, be it one of another runtime. A panic in Lance, which
/// damaged files can provoke, becomes an error.
pub fn wait<T, F>(path: &Path, action: &str, future: F) -> Result<T>
where
    T: Send + 'static,
    F: Future<Output = lance_core::Result<T>> + Send + 'static,
{
    use futures::FutureExt as _;
    let (sender, receiver) = mpsc::sync_channel(1);
    runtime()?.spawn(async move {
        // The receiver waits below, so sending cannot fail.
        let _ = sender.send(AssertUnwindSafe(future).catch_unwind().await);
    });
    match receiver.recv() {
        Ok(Ok(result)) => result.map_err(|e| explain(path, action, &e)),
        _ => Err(damaged(path, format!("{action}: its content makes no sense"))),
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

/// Lance's error in our words: what the operating system refused is [`Error::Io`], all else means that the
/// files are not what they should be.
fn explain(path: &Path, action: &str, error: &lance_core::Error) -> Error {
    let text = error.to_string();
    // Lance turns some system errors into text; their number survives.
    let code =
        text.split("(os error ").nth(1).and_then(|rest| rest.split(')').next()).and_then(|number| number.parse().ok());
    if let Some(code) = code {
        let source = std::io::Error::from_raw_os_error(code);
        return Error::io(path, action, source);
    }
    match error {
        lance_core::Error::NotFound { uri, .. } => damaged(path, format!("{action}: {uri} is missing")),
        lance_core::Error::NotSupported { .. } | lance_core::Error::VersionConflict { .. } => Error::corrupt(
            path,
            format!("{action}: {text}"),
            "this build cannot read that; rewrite it with a current Lance",
        ),
        _ => damaged(path, format!("{action}: {text}")),
    }
}

/// What a table leaves in its folder when it is killed before its first commit.
const FOLDERS: [&str; 3] = ["_versions", "_transactions", "data"];

/// Whether a path names a Lance table: it ends in `.lance`, or is a folder that holds one that does.
pub fn looks_like(location: &Location) -> bool {
    location.path().is_some_and(|path| has_suffix(path) || tables_in(path).is_ok_and(|tables| !tables.is_empty()))
}

fn has_suffix(path: &Path) -> bool {
    path.extension().is_some_and(|suffix| suffix.eq_ignore_ascii_case("lance"))
}

fn tables_in(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut tables = vec![];
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if has_suffix(&path) {
            tables.push(path);
        }
    }
    tables.sort();
    Ok(tables)
}

/// The folder of the table that a path names.
pub fn table_folder(path: &Path) -> Result<PathBuf> {
    if has_suffix(path) {
        return Ok(path.to_owned());
    }
    let tables = tables_in(path).map_err(|e| Error::io(path, "listing the folder", e))?;
    match &tables[..] {
        [table] => Ok(table.clone()),
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
    /// The folder, absolute.
    pub folder: PathBuf,
    base: StorePath,
    objects: Arc<ObjectStore>,
    handler: Arc<dyn CommitHandler>,
}

impl Store {
    /// The table of a folder, which need not exist.
    pub fn new(folder: &Path) -> Result<Self> {
        let folder = std::path::absolute(folder).map_err(|e| Error::io(folder, "finding the folder", e))?;
        let base = StorePath::from_absolute_path(&folder)
            .map_err(|e| Error::config("dataset path", e.to_string(), "use another path"))?;
        let handler = wait(&folder, "opening the dataset", async { commit_handler_from_url("file:///", &None).await })?;
        Ok(Self { folder, base, objects: Arc::new(ObjectStore::local()), handler })
    }

    /// The newest version; `None` where there is no table yet.
    ///
    /// # Errors
    /// When the folder holds something else, or the newest version cannot be read.
    pub fn latest(&self) -> Result<Option<Version>> {
        if !self.has_versions()? {
            return self.check_free().map(|()| None);
        }
        let store = self.clone();
        wait(&self.folder, "reading the newest version", async move {
            let location = store.handler.resolve_latest_location(&store.base, &store.objects).await?;
            let manifest = read_manifest(&store.objects, &location.path, location.size).await?;
            ensure_can_read_manifest(&manifest)?;
            let indices = read_manifest_indexes(&store.objects, &location, &manifest).await?;
            // Lance panics on types it does not know, once it is too late to report them.
            let _ = ArrowSchema::from(&manifest.schema);
            Ok(Some(Version { manifest: Arc::new(manifest), indices }))
        })
    }

    fn has_versions(&self) -> Result<bool> {
        let is_manifest = |name: &OsStr| Path::new(name).extension().is_some_and(|suffix| suffix == "manifest");
        Ok(self.entries("_versions")?.iter().any(|name| is_manifest(name)))
    }

    /// Checks that the folder holds nothing but what a table that was never committed may have left.
    fn check_free(&self) -> Result<()> {
        for name in self.entries("")? {
            let hidden = name.as_encoded_bytes().starts_with(b".");
            if !hidden && !FOLDERS.iter().any(|&known| name == known) {
                let problem = format!("the folder holds '{}' and is no Lance table", name.display());
                return Err(Error::corrupt(&self.folder, problem, "choose another path"));
            }
        }
        Ok(())
    }

    /// The names in a part of the folder; none where there is no such part.
    fn entries(&self, part: &str) -> Result<Vec<OsString>> {
        let folder = self.folder.join(part);
        let io = |e| Error::io(&folder, "listing the folder", e);
        match std::fs::read_dir(&folder) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(vec![]),
            Err(e) => Err(io(e)),
            Ok(entries) => entries.map(|entry| entry.map(|entry| entry.file_name()).map_err(io)).collect(),
        }
    }

    /// Applies an operation to `current` (`None`: there is no table yet) and commits the result as the next
    /// version, atomically. Gives the new version, and the path of its manifest.
    ///
    /// # Errors
    /// When somebody else committed meanwhile, or the system refuses.
    pub fn commit(
        &self,
        current: Option<&Version>,
        operation: Operation,
        config: ManifestBuildConfig,
    ) -> Result<(Version, PathBuf)> {
        let store = self.clone();
        let current = current.cloned();
        let committed = wait(&self.folder, "committing a version", async move {
            let manifest = current.as_ref().map(|version| &*version.manifest);
            if let Some(manifest) = manifest {
                ensure_can_write_manifest(manifest)?;
            }
            validate_operation(manifest, &operation)?;
            let transaction = Transaction::new(manifest.map_or(0, |m| m.version), operation, None);
            let indices = current.as_ref().map(|version| version.indices.clone()).unwrap_or_default();
            // The transaction is stored in the manifest itself, so it needs no file.
            let (mut next, indices) = transaction.build_manifest(manifest, indices, "", &config)?;
            let result = store
                .handler
                .commit(
                    &mut next,
                    (!indices.is_empty()).then(|| indices.clone()),
                    &store.base,
                    &store.objects,
                    write_manifest_file_to_path,
                    ManifestNamingScheme::V2,
                    Some((&transaction).try_into()?),
                )
                .await;
            match result {
                Ok(location) => Ok(Some((Version { manifest: Arc::new(next), indices }, location.path))),
                Err(CommitError::CommitConflict) => Ok(None),
                Err(CommitError::OtherError(error)) => Err(error),
            }
        })?;
        let Some((version, path)) = committed else {
            return Err(Error::config(
                "dataset",
                format!("another process wrote to {} meanwhile", self.folder.display()),
                "let one process write to a dataset at a time",
            ));
        };
        Ok((version, self.local(&path)))
    }

    /// Where the object store keeps an object.
    fn local(&self, path: &StorePath) -> PathBuf {
        Path::new("/").join(path.as_ref())
    }

    /// The path of a data file.
    pub fn data_path(&self, name: &str) -> StorePath {
        self.base.clone().join("data").join(name)
    }

    /// Where files are created.
    pub fn objects(&self) -> &Arc<ObjectStore> {
        &self.objects
    }

    /// Opens a data file for reading. Must run inside [`wait`].
    pub async fn open_file(&self, file: &DataFile) -> lance_core::Result<FileReader> {
        let scheduler = ScanScheduler::new(Arc::clone(&self.objects), SchedulerConfig::max_bandwidth(&self.objects));
        let scheduler = scheduler.open_file(&self.data_path(&file.path), &file.file_size_bytes).await?;
        let plugins = Arc::<DecoderPlugins>::default();
        FileReader::try_open(scheduler, None, plugins, &LanceCache::no_cache(), FileReaderOptions::default()).await
    }
}

/// The BLAKE3 hash of a file, in hexadecimal.
pub fn hash_file(path: &Path) -> std::io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(std::fs::File::open(path)?)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// The name of a data file with that hash: its content is in its name, so damage is found before it does harm.
pub fn name_of_hash(hash: &str) -> String {
    format!("{hash}.lance")
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
    fn a_panic_is_an_error_and_waiting_works_inside_another_runtime() {
        let other = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        other.block_on(async {
            assert_eq!(wait(Path::new("x"), "counting", async { Ok(7) }).expect("runs"), 7);
        });
        let error = wait::<(), _>(Path::new("x"), "reading", async {
            let length = std::hint::black_box(0_usize);
            let _ = [1_u8][length..][length];
            std::panic::resume_unwind(Box::new("damaged"))
        });
        assert!(error.expect_err("panics").to_string().contains("makes no sense"));
    }

    #[test]
    fn system_errors_keep_their_reason() {
        let full = lance_core::Error::io("failed to persist: No space left on device (os error 28)".to_owned());
        let error = explain(Path::new("x.lance"), "writing", &full);
        assert!(matches!(&error, Error::Io { source, .. } if source.kind() == ErrorKind::StorageFull));
        assert!(error.to_string().contains("committed episodes are kept"));
    }
}
