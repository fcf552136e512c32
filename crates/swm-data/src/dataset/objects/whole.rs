//! Small whole files in object stores and on this machine: the records of runs that several machines share.

use super::{block_on, store, store_error};
use crate::dataset::location::Location;
use bytes::Bytes;
use futures::TryStreamExt as _;
use object_store::{ObjectMeta, ObjectStoreExt as _, PutMode, PutOptions, PutPayload};
use std::time::Duration;
use swm_core::{Error, Result};

/// The time for the list of a folder, which a store could continue for ever.
const LISTING: Duration = Duration::from_secs(60);

/// Reads a file; `None` if it does not exist.
///
/// # Errors
/// If a request to the store fails.
pub fn read_file(location: &Location) -> Result<Option<Bytes>> {
    let (store, path) = store(location)?;
    let read = async move { store.get(&path).await?.bytes().await };
    match run(location, "reading it", read)? {
        Err(object_store::Error::NotFound { .. }) => Ok(None),
        read => finish(location, "reading it", read).map(Some),
    }
}

/// Writes a file, which becomes visible when it is complete.
///
/// # Errors
/// If a request to the store fails.
pub fn write_file(location: &Location, content: Vec<u8>) -> Result<()> {
    let (store, path) = store(location)?;
    let written = run(location, "writing it", async move { store.put(&path, PutPayload::from(content)).await })?;
    finish(location, "writing it", written).map(drop)
}

/// Writes a file unless it exists, and returns whether this process wrote it.
///
/// # Errors
/// If a request to the store fails.
pub fn write_new_file(location: &Location, content: Vec<u8>) -> Result<bool> {
    let (store, path) = store(location)?;
    let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
    let put = async move { store.put_opts(&path, PutPayload::from(content), options).await };
    match run(location, "writing it", put)? {
        Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
        written => finish(location, "writing it", written).map(|_| true),
    }
}

/// Returns the paths of all files below a folder, relative to it and sorted; none if the folder does not exist.
///
/// # Errors
/// If a request to the store fails.
pub fn list_files(folder: &Location) -> Result<Vec<String>> {
    Ok(listed(folder)?.into_iter().map(|(name, _)| name).collect())
}

/// Returns the names of the files and folders in a folder, sorted; none if it does not exist.
///
/// # Errors
/// If a request to the store fails, or the list does not end within a minute.
pub fn list_names(folder: &Location) -> Result<Vec<String>> {
    let (store, prefix) = store(folder)?;
    let list = async move {
        let endless = |_| object_store::Error::Generic { store: "object", source: "its list does not end".into() };
        tokio::time::timeout(LISTING, store.list_with_delimiter(Some(&prefix))).await.map_err(endless)?
    };
    let found = match run(folder, "listing it", list)? {
        Err(object_store::Error::NotFound { .. }) => return Ok(vec![]),
        listed => finish(folder, "listing it", listed)?,
    };
    let all = found.objects.iter().map(|file| &file.location).chain(&found.common_prefixes);
    let mut names: Vec<String> = all.filter_map(|path| path.filename().map(str::to_owned)).collect();
    names.sort();
    names.dedup();
    Ok(names)
}

/// Returns the files below a folder, or the file at this location under the empty name, each with what changes when it does.
///
/// # Errors
/// If a request to the store fails.
pub fn list_versions(location: &Location) -> Result<Vec<(String, String)>> {
    let found = listed(location)?;
    if !found.is_empty() {
        return Ok(found);
    }
    let (store, path) = store(location)?;
    match run(location, "opening it", async move { store.head(&path).await })? {
        Err(object_store::Error::NotFound { .. }) => Ok(vec![]),
        opened => Ok(vec![(String::new(), version(&finish(location, "opening it", opened)?))]),
    }
}

/// What changes when a file does.
fn version(file: &ObjectMeta) -> String {
    file.e_tag.clone().unwrap_or_else(|| format!("{} {}", file.last_modified, file.size))
}

/// The files below a folder, sorted, with their versions.
fn listed(folder: &Location) -> Result<Vec<(String, String)>> {
    let (store, prefix) = store(folder)?;
    let root = prefix.clone();
    let list = async move { store.list(Some(&prefix)).try_collect::<Vec<_>>().await };
    let found = match run(folder, "listing it", list)? {
        Err(object_store::Error::NotFound { .. }) => vec![],
        listed => finish(folder, "listing it", listed)?,
    };
    let relative = |path: &object_store::path::Path| {
        let parts: Vec<_> = path.prefix_match(&root)?.map(|part| part.as_ref().to_owned()).collect();
        Some(parts.join("/")).filter(|path| !path.is_empty())
    };
    let mut files: Vec<_> = found.iter().filter_map(|file| Some((relative(&file.location)?, version(file)))).collect();
    files.sort();
    Ok(files)
}

/// Runs a request to completion.
fn run<T: Send + 'static>(
    location: &Location,
    action: &str,
    request: impl Future<Output = object_store::Result<T>> + Send + 'static,
) -> Result<object_store::Result<T>> {
    let panicked =
        || Error::external(format!("{}: {action}", location.label().display()), "the store's client panicked");
    block_on(request)?.ok_or_else(panicked)
}

fn finish<T>(location: &Location, action: &str, result: object_store::Result<T>) -> Result<T> {
    result.map_err(|error| store_error(&location.label(), action, &error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_written_once_read_and_listed() -> Result<()> {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let at = |name: &str| Location::from(&folder.path().join("run").join(name));
        assert_eq!(read_file(&at("a/b.json"))?, None);
        assert_eq!(list_files(&at(""))?, Vec::<String>::new());
        assert!(write_new_file(&at("a/b.json"), b"first".to_vec())?);
        assert!(!write_new_file(&at("a/b.json"), b"second".to_vec())?);
        write_file(&at("c.json"), b"third".to_vec())?;
        assert_eq!(read_file(&at("a/b.json"))?.as_deref(), Some(&b"first"[..]));
        assert_eq!(list_files(&at(""))?, ["a/b.json", "c.json"]);
        assert_eq!((list_names(&at(""))?, list_names(&at("none"))?), (vec!["a".into(), "c.json".into()], vec![]));
        Ok(())
    }
}
