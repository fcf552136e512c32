//! Access to object stores (`s3://`, `gs://`, `az://`, `http(s)://`) and to local files through the same interface.
//!
//! Credentials and endpoints come from the environment variables of each provider's own tools: `AWS_ACCESS_KEY_ID`,
//! `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, `AWS_REGION`, `AWS_ENDPOINT_URL`, `AWS_SKIP_SIGNATURE=true` for public
//! buckets; `GOOGLE_APPLICATION_CREDENTIALS`; `AZURE_STORAGE_ACCOUNT_NAME`, `AZURE_STORAGE_ACCOUNT_KEY`. Each kind of
//! store has its own Cargo feature.

mod blocks;
#[cfg(any(feature = "s3", feature = "gs", feature = "az"))]
mod connector;
#[cfg(feature = "tls")]
mod patience;
mod threads;
mod unchanged;
mod whole;

pub(crate) use blocks::{BlockCache, ObjectRanges};
pub(crate) use patience::answer_or_report;
pub(crate) use threads::{block_on, start_lance};
pub(crate) use unchanged::{REPLACED, Unchanged, hash_object};
pub use whole::{list_files, list_names, list_versions, read_file, write_file, write_new_file};

use crate::dataset::location::Location;
use object_store::path::Path as StorePath;
use object_store::{GetOptions, ObjectMeta, ObjectStore, ObjectStoreExt as _};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;
use swm_core::{Error, Result};
use url::Url;

/// Bytes of an object.
pub use bytes::Bytes;

/// Ranges with a smaller gap than this, in bytes, are fetched in one request. At 100 MB/s, transferring such a gap
/// takes one millisecond, while another request takes several milliseconds.
const GAP: u64 = 128 << 10;

/// Maximum number of concurrent requests per read.
const REQUESTS: usize = 32;

/// The object store of a location, and the path within that store.
///
/// # Errors
/// If the location names no bucket, this build lacks the feature for the store, or the store's environment variables
/// are invalid.
pub fn store(location: &Location) -> Result<(Arc<dyn ObjectStore>, StorePath)> {
    match location {
        Location::Path(path) => {
            let path = std::path::absolute(path).map_err(|e| Error::io(path, "finding the file", e))?;
            let path = without_parent_components(&path);
            let object_path = StorePath::from_absolute_path(&path)
                .map_err(|e| Error::config("dataset path", e.to_string(), "use another path"))?;
            Ok((Arc::new(object_store::local::LocalFileSystem::new()), object_path))
        }
        Location::Uri(url) => {
            let object_path = StorePath::from_url_path(url.path())
                .map_err(|e| Error::config("dataset", format!("{url}: {e}"), "check its spelling"))?;
            Ok((remote(url)?, object_path))
        }
    }
}

/// Returns an absolute path without `..`, which object stores do not accept. Links are followed before each `..`.
fn without_parent_components(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for component in path.components() {
        if component == std::path::Component::ParentDir {
            plain = plain.canonicalize().unwrap_or(plain);
            plain.pop();
        } else {
            plain.push(component);
        }
    }
    plain
}

/// Stores that the program provides, by name.
static PROVIDED: Mutex<BTreeMap<String, Arc<dyn ObjectStore>>> = Mutex::new(BTreeMap::new());

/// Provides a store of the program's own: locations `store://NAME/path` are read from it and written to it. The scheme
/// is available to programs only, see [`Location::Uri`]; the command line does not know it.
pub fn provide(name: &str, store: Arc<dyn ObjectStore>) {
    PROVIDED.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_owned(), store);
}

#[cfg_attr(
    not(any(feature = "s3", feature = "gs", feature = "az", feature = "http")),
    allow(unused, reason = "without these features every URI is an error")
)]
fn remote(url: &Url) -> Result<Arc<dyn ObjectStore>> {
    let invalid = |e: object_store::Error| {
        let fix = "check the store's environment variables, such as AWS_ENDPOINT_URL, AWS_REGION and AWS_ACCESS_KEY_ID";
        Error::config("dataset", format!("{url}: {}", without_passwords(&e.to_string())), fix)
    };
    #[cfg(feature = "tls")]
    provide_tls();
    match url.scheme() {
        "store" => {
            let provided = PROVIDED.lock().unwrap_or_else(PoisonError::into_inner);
            let found = provided.get(url.host_str().unwrap_or_default()).cloned();
            found.ok_or_else(|| Error::config("dataset", format!("{url}: no such store is provided"), "provide it"))
        }
        #[cfg(feature = "s3")]
        "s3" => {
            use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
            let mut builder =
                AmazonS3Builder::from_env().with_url(url.as_str()).with_http_connector(connector::Connector);
            for (key, value) in patience::client_settings() {
                builder = builder.with_config(AmazonS3ConfigKey::Client(key), value);
            }
            Ok(patient(url, builder.with_retry(patience::retry_config()).build().map_err(invalid)?))
        }
        #[cfg(feature = "gs")]
        "gs" => {
            use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey};
            let mut builder =
                GoogleCloudStorageBuilder::from_env().with_url(url.as_str()).with_http_connector(connector::Connector);
            for (key, value) in patience::client_settings() {
                builder = builder.with_config(GoogleConfigKey::Client(key), value);
            }
            Ok(patient(url, builder.with_retry(patience::retry_config()).build().map_err(invalid)?))
        }
        #[cfg(feature = "az")]
        "az" => {
            use object_store::azure::{AzureConfigKey, MicrosoftAzureBuilder};
            let mut builder =
                MicrosoftAzureBuilder::from_env().with_url(url.as_str()).with_http_connector(connector::Connector);
            for (key, value) in patience::client_settings() {
                builder = builder.with_config(AzureConfigKey::Client(key), value);
            }
            Ok(patient(url, builder.with_retry(patience::retry_config()).build().map_err(invalid)?))
        }
        #[cfg(feature = "http")]
        "http" | "https" => {
            let options = patience::client_settings()
                .into_iter()
                .fold(object_store::ClientOptions::new(), |options, (key, value)| options.with_config(key, value));
            let server = &url[..url::Position::BeforePath];
            let builder = object_store::http::HttpBuilder::new().with_url(server).with_client_options(options);
            Ok(patient(url, builder.with_retry(patience::retry_config()).build().map_err(invalid)?))
        }
        scheme => {
            let feature = if scheme == "https" { "http" } else { scheme };
            let problem = format!("this build does not support {scheme}:// (it lacks the feature `{feature}`)");
            let fix = format!("build it with --features {feature}, or copy the dataset to this machine");
            Err(Error::config("dataset", problem, fix))
        }
    }
}

/// A remote store that reports when its server does not answer.
#[cfg(feature = "tls")]
fn patient<T: ObjectStore>(url: &Url, inner: T) -> Arc<dyn ObjectStore> {
    Arc::new(patience::Patience { inner: Arc::new(inner), name: url[..url::Position::BeforePath].to_owned() })
}

/// Installs ring as the cryptography provider of the process, unless a provider is installed already.
#[cfg(feature = "tls")]
pub(crate) fn provide_tls() {
    // An error means that another provider is installed already.
    let _ = rustls::crypto::ring::default_provider().install_default();
}

/// Converts an error of an object store to an [`Error`].
pub(crate) fn store_error(label: &Path, action: &str, error: &object_store::Error) -> Error {
    match error {
        object_store::Error::NotFound { .. } => Error::corrupt(
            label,
            format!("{action}: there is no such object"),
            "check the name; names in object stores are case-sensitive",
        ),
        other => {
            let redirects = other.to_string().contains("non-2xx status code: 3");
            let hint = if redirects {
                " (it redirects to another host, which is not followed; set the store's address and region, such as AWS_ENDPOINT_URL and AWS_REGION)"
            } else {
                ""
            };
            Error::external(format!("{}: {action}{hint}", label.display()), without_passwords(&other.to_string()))
        }
    }
}

/// Leaves the user and the password out of the URLs in a text, such as those of `AWS_ENDPOINT_URL` in an error.
pub(crate) fn without_passwords(text: &str) -> String {
    let (mut clean, mut rest) = (String::with_capacity(text.len()), text);
    while let Some(at) = rest.find("://") {
        let (before, server) = rest.split_at(at + "://".len());
        clean.push_str(before);
        let end = server.find(|c: char| c.is_whitespace() || "/?#\"'<>)".contains(c)).unwrap_or(server.len());
        rest = server[..end].rfind('@').map_or(server, |at| &server[at + 1..]);
    }
    clean + rest
}

/// A local or remote file, read by byte ranges. Several threads may read at the same time.
pub struct ObjectFile {
    store: Arc<dyn ObjectStore>,
    path: StorePath,
    label: PathBuf,
    len: u64,
    /// What changes when the object is replaced.
    version: Version,
}

/// What changes when an object is replaced.
#[derive(Clone, Debug)]
pub(crate) struct Version {
    size: u64,
    tag: Option<String>,
    /// The time of the last change; `None` if the server does not say it.
    modified: Option<SystemTime>,
}

impl Version {
    /// The version that an answer states.
    pub(crate) fn of(meta: &ObjectMeta) -> Self {
        let modified = Some(SystemTime::from(meta.last_modified)).filter(|time| *time != SystemTime::UNIX_EPOCH);
        Self { size: meta.size, tag: meta.e_tag.clone(), modified }
    }

    /// Whether two answers of a server are of one object. Two strong tags decide; of a weak one the time is compared
    /// too, and several servers behind an address may leave headers out.
    pub(crate) fn is(&self, other: &Self) -> bool {
        let tags = self.tag.as_deref().zip(other.tag.as_deref());
        let same_tag = tags.map(|(a, b)| without_weak(a) == without_weak(b));
        let is_strong = tags.is_some_and(|(a, b)| !a.starts_with(WEAK) && !b.starts_with(WEAK));
        let same_time = self.modified.zip(other.modified).filter(|_| !is_strong).map(|(a, b)| a == b);
        let reported: Vec<bool> = same_tag.into_iter().chain(same_time).collect();
        self.size == other.size && (reported.is_empty() || reported.contains(&true))
    }

    /// What two answers have that are not of one object.
    fn difference(&self, other: &Self) -> String {
        let marks = |version: &Self| match (&version.tag, version.modified) {
            (Some(tag), _) => format!("the tag {tag}"),
            (None, Some(time)) => {
                let seconds = time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
                format!("no tag and the time {seconds} s since 1970")
            }
            (None, None) => "neither tag nor time".to_owned(),
        };
        let (size, now) = (self.size, other.size);
        format!("{size} bytes with {} before, {now} bytes with {} now", marks(self), marks(other))
    }
}

/// What marks a tag as weak: the object has the same meaning, and maybe other bytes.
const WEAK: &str = "W/";

/// A tag without the mark, which servers add when they encode an answer.
fn without_weak(tag: &str) -> &str {
    tag.strip_prefix(WEAK).unwrap_or(tag)
}

impl ObjectFile {
    /// Opens a file.
    ///
    /// # Errors
    /// If the file does not exist, or a request to the store fails.
    pub fn open(location: &Location) -> Result<Self> {
        let (store, path) = store(location)?;
        let label = location.label();
        let (request_store, request_path) = (Arc::clone(&store), path.clone());
        let meta = Self::finish(
            &label,
            "opening the file",
            block_on(async move { request_store.head(&request_path).await })?,
        )?;
        Ok(Self { store, path, label, len: meta.size, version: Version::of(&meta) })
    }

    /// Size in bytes.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Whether the file has no bytes.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Reads all ranges, returned in the given order. Ranges close to each other share a request, and all requests run
    /// concurrently.
    ///
    /// # Errors
    /// If a range exceeds the file, or a request to the store fails.
    pub fn read(&self, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        if let Some(range) = ranges.iter().find(|range| range.start > range.end || range.end > self.len) {
            let given = format!("bytes {}..{} of {}", range.start, range.end, self.label.display());
            return Err(Error::mismatch("reading a file", given, format!("bytes below {}", self.len)));
        }
        let (store, path) = (Arc::clone(&self.store), self.path.clone());
        let ranges = ranges.to_vec();
        let action = "reading it";
        let result = block_on(async move { fetch_with_versions(&*store, &path, &ranges).await })?;
        let (parts, versions) = Self::finish(&self.label, action, result)?;
        if let Some(other) = versions.iter().find(|version| !version.is(&self.version)) {
            let causes = "it was written over while it was read, or several servers answer with other tags";
            let fix = "open the dataset again; keep its files as they are while they are read, and read it from one \
                       server, or from servers with equal tags";
            return Err(Error::corrupt(&self.label, format!("{causes}: {}", self.version.difference(other)), fix));
        }
        Ok(parts)
    }

    fn finish<T>(label: &Path, action: &str, result: Option<object_store::Result<T>>) -> Result<T> {
        match result {
            Some(result) => result.map_err(|e| store_error(label, action, &e)),
            None => Err(Error::external(format!("{}: {action}", label.display()), "the store's client panicked")),
        }
    }
}

/// Reads ranges of an object.
pub(crate) async fn fetch(
    store: &dyn ObjectStore,
    path: &StorePath,
    ranges: &[Range<u64>],
) -> object_store::Result<Vec<Bytes>> {
    Ok(fetch_with_versions(store, path, ranges).await?.0)
}

/// Reads ranges of an object; also returns the versions that the store read them from.
async fn fetch_with_versions(
    store: &dyn ObjectStore,
    path: &StorePath,
    ranges: &[Range<u64>],
) -> object_store::Result<(Vec<Bytes>, Vec<Version>)> {
    use futures::{StreamExt as _, TryStreamExt as _};
    let joined = merge_ranges(ranges);
    let read = |range: Range<u64>| async move {
        let options = GetOptions { range: Some(range.into()), ..GetOptions::default() };
        let result = store.get_opts(path, options).await?;
        let version = Version::of(&result.meta);
        Ok::<_, object_store::Error>((result.bytes().await?, version))
    };
    let parts = futures::stream::iter(joined.clone()).map(read).buffered(REQUESTS).try_collect::<Vec<_>>().await?;
    let (parts, versions): (Vec<Bytes>, Vec<Version>) = parts.into_iter().unzip();
    let slices = ranges
        .iter()
        .map(|range| {
            if range.is_empty() {
                return Ok(Bytes::new());
            }
            let at = joined.partition_point(|part| part.start <= range.start) - 1;
            let start = (range.start - joined[at].start) as usize;
            let end = (range.end - joined[at].start) as usize;
            if end > parts[at].len() {
                // The object shrank after its size was read.
                return Err(object_store::Error::Generic {
                    store: "object",
                    source: "the object is shorter than expected".into(),
                });
            }
            Ok(parts[at].slice(start..end))
        })
        .collect::<object_store::Result<_>>()?;
    Ok((slices, versions))
}

/// Merges ranges with small gaps into sorted, disjoint requests.
fn merge_ranges(ranges: &[Range<u64>]) -> Vec<Range<u64>> {
    let mut sorted: Vec<Range<u64>> = ranges.iter().filter(|range| !range.is_empty()).cloned().collect();
    sorted.sort_unstable_by_key(|range| (range.start, range.end));
    let mut joined: Vec<Range<u64>> = vec![];
    for range in sorted {
        match joined.last_mut() {
            Some(last) if range.start <= last.end.saturating_add(GAP) => last.end = last.end.max(range.end),
            _ => joined.push(range),
        }
    }
    joined
}

/// Whether a store lists objects in the order of their names, as Lance expects of it: directory buckets of S3 do not.
pub(crate) fn lists_in_order(url: &Url) -> bool {
    !url.host_str().is_some_and(|bucket| bucket.ends_with("--x-s3"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_in_urls_are_left_out() {
        for (text, expected) in [
            ("GET http://me:se@cret@127.0.0.1:9/b?x=a@b failed", "GET http://127.0.0.1:9/b?x=a@b failed"),
            ("for url (https://me@host)", "for url (https://host)"),
            ("http://a/b and s3://u:p@c", "http://a/b and s3://c"),
            ("mail me@host, or ://", "mail me@host, or ://"),
        ] {
            assert_eq!(without_passwords(text), expected);
        }
    }

    #[test]
    fn reads_byte_ranges_in_the_requested_order() -> Result<()> {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let path = folder.path().join("file");
        let content: Vec<u8> = (0..3_000_000_u32).map(|i| ((i * i) >> 7) as u8).collect();
        std::fs::write(&path, &content).expect("writing the file");
        let file = ObjectFile::open(&Location::from(&path))?;
        assert_eq!(file.len(), 3_000_000);
        let ranges = [2_000_000..2_000_100, 5..10, 7..7, 8..300, 2_050_000..3_000_000, 0..0, 500_000..500_001];
        assert_eq!(merge_ranges(&ranges), [5..300, 500_000..500_001, 2_000_000..3_000_000]);
        for (range, bytes) in ranges.iter().zip(file.read(&ranges)?) {
            assert_eq!(bytes, content[range.start as usize..range.end as usize]);
        }
        assert!(file.read(std::slice::from_ref(&(0..3_000_001))).is_err());
        Ok(())
    }

    #[test]
    fn versions_are_compared_by_what_both_answers_tell() {
        let version = |size, tag: Option<&str>, modified: Option<u64>| Version {
            size,
            tag: tag.map(str::to_owned),
            modified: modified.map(|seconds| SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(seconds)),
        };
        let opened = version(9, Some("x"), Some(5));
        for same in [
            version(9, Some("x"), Some(5)),
            version(9, None, None),
            version(9, Some("x"), None),
            version(9, Some("W/x"), Some(5)),
            version(9, Some("W/other server"), Some(5)),
            version(9, Some("x"), Some(6)),
        ] {
            assert!(opened.is(&same), "{same:?}");
        }
        for other in [
            version(8, Some("x"), Some(5)),
            version(9, Some("replaced within a second"), Some(5)),
            version(9, Some("W/y"), Some(6)),
            version(9, Some("W/y"), None),
            version(9, Some("y"), Some(6)),
            version(9, Some("y"), None),
            version(9, None, Some(6)),
        ] {
            assert!(!opened.is(&other), "{other:?}");
        }
    }

    #[test]
    fn directory_buckets_are_not_listed_in_order() {
        let in_order = |text: &str| lists_in_order(&Url::parse(text).expect("a URL"));
        assert!(in_order("s3://lab/rooms.lance") && in_order("gs://lab--x-s3-data/rooms.lance"));
        assert!(!in_order("s3://lab--use1-az4--x-s3/rooms.lance"));
    }
}
