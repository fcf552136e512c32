//! [`Unchanged`]: a store that refuses to read an object which was replaced by another one since it was first read.

use super::Version;
use async_trait::async_trait;
use futures::stream::BoxStream;
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    ObjectStoreExt as _, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};
use std::collections::HashMap;
use std::fmt;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The message of the error.
pub(crate) const REPLACED: &str = "the object was replaced while it was read";

/// Number of bytes of an object that are hashed at once, and of such parts that are requested together.
const PART: usize = 8 << 20;
const PARTS: usize = 4;
/// The number of requests until an answer has a known version: several servers may each have a tag of their own.
const TRIES: usize = 8;

/// A store whose objects in one folder keep their bytes while they are read. Parts of two objects of one name would be
/// mixed. A new version of an object whose name is its hash is hashed once: a copy of the same bytes has another tag.
#[derive(Debug)]
pub(crate) struct Unchanged {
    inner: Arc<dyn ObjectStore>,
    folder: Path,
    /// Returns the hash in the name of an object, if it has one.
    hash_in_name: fn(&str) -> Option<&str>,
    seen: Mutex<HashMap<Path, Versions>>,
    /// Held while an object is hashed, so that concurrent reads hash it once.
    hashing: futures::lock::Mutex<()>,
}

/// The versions of an object.
#[derive(Debug, Default)]
struct Versions {
    /// The version of the first answer, and others whose bytes have the hash in the name.
    same: Vec<Version>,
    /// Versions with other bytes.
    other: Vec<Version>,
}

impl Unchanged {
    /// Compares the objects below `folder` of a store.
    pub(crate) fn new(inner: Arc<dyn ObjectStore>, folder: Path, hash_in_name: fn(&str) -> Option<&str>) -> Self {
        Self { inner, folder, hash_in_name, seen: Mutex::default(), hashing: futures::lock::Mutex::default() }
    }

    fn seen(&self) -> MutexGuard<'_, HashMap<Path, Versions>> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a version has the bytes of the first one, which this stores; `None` if that is not known.
    fn is_same(&self, location: &Path, version: &Version) -> Option<bool> {
        let mut seen = self.seen();
        let Versions { same, other } = seen.entry(location.clone()).or_default();
        if same.is_empty() {
            same.push(version.clone());
        }
        let is_in = |versions: &[Version]| versions.iter().any(|known| known.is(version));
        if is_in(same) {
            return Some(true);
        }
        (is_in(other) || same[0].size != version.size).then_some(false)
    }

    /// Hashes an object of which an answer has an unknown version; returns whether it has the hash in its name.
    async fn has_named_hash(&self, location: &Path, version: &Version) -> Result<bool> {
        let Some(expected) = location.filename().and_then(self.hash_in_name) else { return Ok(false) };
        let _one = self.hashing.lock().await;
        if let Some(known) = self.is_same(location, version) {
            return Ok(known);
        }
        let (hash, versions) = hash_object(&*self.inner, location).await?;
        let is_named = hash == expected;
        let mut seen = self.seen();
        let Versions { same, other } = seen.entry(location.clone()).or_default();
        let known = if is_named { same } else { other };
        for version in versions {
            if !known.iter().any(|known| known.is(&version)) {
                known.push(version);
            }
        }
        Ok(is_named)
    }
}

/// Returns the BLAKE3 hash of an object in hexadecimal, and the versions that the store read it from.
pub(crate) async fn hash_object(store: &dyn ObjectStore, path: &Path) -> Result<(String, Vec<Version>)> {
    let size = store.head(path).await?.size;
    let parts = (0..size).step_by(PART).map(|start| start..size.min(start + PART as u64));
    let read = |part: Range<u64>| async move {
        let options = GetOptions { range: Some(part.into()), ..GetOptions::default() };
        let result = store.get_opts(path, options).await?;
        let version = Version::of(&result.meta);
        Ok::<_, Error>((result.bytes().await?, version))
    };
    let mut read = futures::stream::iter(parts).map(read).buffered(PARTS);
    let (mut hasher, mut versions) = (blake3::Hasher::new(), vec![]);
    while let Some((bytes, version)) = read.try_next().await? {
        hasher.update(&bytes);
        versions.push(version);
    }
    Ok((hasher.finalize().to_hex().to_string(), versions))
}

impl fmt::Display for Unchanged {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

#[async_trait]
impl ObjectStore for Unchanged {
    async fn put_opts(&self, location: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        self.seen().remove(location);
        self.inner.put_opts(location, payload, options).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.seen().remove(location);
        self.inner.put_multipart_opts(location, options).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        if !location.prefix_matches(&self.folder) {
            return self.inner.get_opts(location, options).await;
        }
        for _ in 0..TRIES {
            let result = self.inner.get_opts(location, options.clone()).await?;
            let version = Version::of(&result.meta);
            match self.is_same(location, &version) {
                Some(true) => return Ok(result),
                Some(false) => break,
                // The answer would wait too long for the hash.
                None => drop(result),
            }
            if !self.has_named_hash(location, &version).await? {
                break;
            }
        }
        Err(Error::Generic { store: "object", source: REPLACED.into() })
    }

    fn delete_stream(&self, locations: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    fn list_with_offset(&self, prefix: Option<&Path>, offset: &Path) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list_with_offset(prefix, offset)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.seen().remove(to);
        self.inner.copy_opts(from, to, options).await
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use object_store::memory::InMemory;

    #[test]
    fn objects_that_are_replaced_while_they_are_read_are_refused() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("creating the runtime");
        runtime.block_on(async {
            let (inner, data, other) = (Arc::new(InMemory::new()), Path::from("t/data/a"), Path::from("t/version"));
            for path in [&data, &other] {
                inner.put(path, vec![1; 9].into()).await.expect("an object");
            }
            let store = Unchanged::new(Arc::clone(&inner) as Arc<dyn ObjectStore>, Path::from("t/data"), |_| None);
            for path in [&data, &other] {
                store.get_range(path, 0..2).await.expect("a part");
                store.get_ranges(path, &[3..4, 7..9]).await.expect("parts");
                inner.put(path, vec![2; 9].into()).await.expect("another object of the size");
            }
            store.get_range(&other, 0..2).await.expect("a part of a file that changes");
            for _ in 0..2 {
                let error = store.get_range(&data, 5..6).await.expect_err("another object").to_string();
                assert!(error.contains(REPLACED), "{error}");
            }
            assert!(
                store.head(&data).await.is_err()
                    && store.get_ranges(&data, std::slice::from_ref(&(3..4))).await.is_err()
            );
            store.put(&data, vec![3; 9].into()).await.expect("an object");
            store.get_range(&data, 0..2).await.expect("what this process wrote");
        });
    }

    #[test]
    fn copies_of_objects_that_are_named_by_their_hash_are_read() {
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("creating the runtime");
        runtime.block_on(async {
            let inner = Arc::new(InMemory::new());
            let content = vec![1; 2 * PART + 9];
            let path = Path::from("t/data").join(blake3::hash(&content).to_hex().as_str());
            let store = Unchanged::new(Arc::clone(&inner) as Arc<dyn ObjectStore>, Path::from("t/data"), |name| {
                (!name.is_empty()).then_some(name)
            });
            let versions = || store.seen().get(&path).map(|seen| (seen.same.len(), seen.other.len()));
            for count in 1..3 {
                inner.put(&path, content.clone().into()).await.expect("an object with another tag");
                for _ in 0..2 {
                    store.get_range(&path, 3..5).await.expect("a part of the same bytes");
                    assert_eq!(versions(), Some((count, 0)));
                }
            }
            let mut changed = content.clone();
            changed[PART] = 2;
            inner.put(&path, changed.into()).await.expect("another object");
            for _ in 0..2 {
                let error = store.get_range(&path, 3..5).await.expect_err("another object").to_string();
                assert!(error.contains(REPLACED), "{error}");
                assert_eq!(versions(), Some((2, 1)));
            }
            inner.put(&path, vec![1; 9].into()).await.expect("a shorter object");
            assert!(store.get_range(&path, 3..5).await.is_err());
            assert_eq!(versions(), Some((2, 1)), "an object of another size is not hashed");
            inner.put(&path, content.into()).await.expect("the first object");
            store.get_range(&path, 3..5).await.expect("a part of the same bytes");
        });
    }
}
