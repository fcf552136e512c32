//! The cache: `KINDs--OWNER--NAME/` with `refs/REVISION` (its commit), `lists/COMMIT.json` (its files), `snapshots/COMMIT/`,
//! `verified/COMMIT.json` (the files that were compared with their hashes) and `partial/` (interrupted downloads). Each hub has
//! a cache of its own, because another hub may have other files under the same names.

use super::client::Client;
use super::{HubFile, HubUri, RepoKind};
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// The address of the hub, unless another one is given.
pub(super) const ENDPOINT: &str = "https://huggingface.co";

/// The largest list of files, in bytes.
pub(super) const MAX_LIST: u64 = 256 << 20;

/// The cache of a hub: the folder itself, or for another address than the default one a folder in it.
pub(super) fn of_hub(cache: &Path, client: &Client) -> PathBuf {
    if client.endpoint() == ENDPOINT {
        return cache.to_owned();
    }
    let host = url::Url::parse(client.endpoint()).ok().and_then(|url| url.host_str().map(str::to_owned));
    let host = host.unwrap_or_default().replace(|c: char| !c.is_ascii_alphanumeric() && !".-".contains(c), "-");
    cache.join(format!("{host}-{}", &blake3::hash(client.endpoint().as_bytes()).to_hex()[..16]))
}

/// The folder of a repository in the cache.
pub(super) struct Folder(PathBuf);

impl Folder {
    pub fn of(cache: &Path, uri: &HubUri) -> Self {
        let kind = if uri.kind == RepoKind::Dataset { "datasets" } else { "models" };
        Self(cache.join(format!("{kind}--{}", uri.repo.replace('/', "--"))))
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The folder of the files of a commit.
    pub fn snapshot(&self, commit: &str) -> PathBuf {
        self.0.join("snapshots").join(commit)
    }

    /// The record of the files of a commit that were compared with their hashes.
    pub fn verified(&self, commit: &str) -> PathBuf {
        self.0.join("verified").join(format!("{commit}.json"))
    }

    /// The file of an interrupted download. `part` names its content, so that an equal file of another commit continues it.
    pub fn partial(&self, commit: &str, file: &HubFile) -> PathBuf {
        let content = file.sha256.clone().filter(|hash| super::uri::is_sha256(hash));
        let name = content.unwrap_or_else(|| format!("{commit}-{}", blake3::hash(file.path.as_bytes()).to_hex()));
        self.0.join("partial").join(name)
    }

    /// The commit that a revision had when it was last asked for.
    pub fn known_commit(&self, revision: &str) -> Option<String> {
        let text = std::fs::read_to_string(self.reference(revision)).ok()?;
        Some(text.trim().to_owned()).filter(|commit| super::uri::is_commit(commit))
    }

    pub fn remember_commit(&self, revision: &str, commit: &str) -> Result<()> {
        write(&self.reference(revision), commit.as_bytes())
    }

    fn reference(&self, revision: &str) -> PathBuf {
        // A branch can have the name of another one and a slash.
        self.0.join("refs").join(super::client::encoded(revision))
    }

    /// The files of a commit, if they were listed before. A list without files is asked for again.
    pub fn known_files(&self, commit: &str) -> Option<Vec<HubFile>> {
        let bytes = files::read(&self.list(commit), MAX_LIST).ok()?;
        let listed: Vec<HubFile> = serde_json::from_slice(&bytes).ok()?;
        let no_git = super::uri::git_folder(listed.iter().map(|file| file.path.as_str())).is_none();
        let all_inside = listed.iter().all(|file| super::uri::is_inside(&file.path));
        (no_git && all_inside && !listed.is_empty()).then_some(listed)
    }

    pub fn remember_files(&self, commit: &str, listed: &[HubFile]) -> Result<()> {
        let bytes = serde_json::to_vec(listed).map_err(|error| Error::external("writing a list of files", error))?;
        write(&self.list(commit), &bytes)
    }

    fn list(&self, commit: &str) -> PathBuf {
        self.0.join("lists").join(format!("{commit}.json"))
    }
}

/// Writes a file of the cache, and makes its folder.
pub(super) fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, "creating a folder", error))?;
    files::write(path, bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_branch_can_have_the_name_of_another_one_and_a_slash() -> Result<()> {
        let cache = tempfile::tempdir().expect("a folder");
        let folder = Folder::of(cache.path(), &HubUri::parse("hf://a/b", RepoKind::Model)?);
        let commit = "0123456789abcdef0123456789abcdef01234567";
        for revision in ["main", "main/x", "refs/pr/1"] {
            folder.remember_commit(revision, commit)?;
            assert_eq!(folder.known_commit(revision).as_deref(), Some(commit));
        }
        Ok(())
    }

    #[test]
    fn each_hub_has_a_cache_of_its_own() {
        let of = |endpoint: &str| of_hub(Path::new("hub"), &Client::new(endpoint, None).expect("a client"));
        assert_eq!(of(ENDPOINT), Path::new("hub"));
        assert_eq!(of("https://huggingface.co/"), Path::new("hub"));
        let others =
            ["http://127.0.0.1:1", "http://127.0.0.1:2", "https://127.0.0.1:1", "http://[::1]:1", "https://a/b"];
        let folders: std::collections::BTreeSet<PathBuf> = others.iter().map(|endpoint| of(endpoint)).collect();
        assert_eq!(folders.len(), others.len(), "{folders:?}");
        assert!(folders.iter().all(|folder| folder.parent() == Some(Path::new("hub"))), "{folders:?}");
    }

    #[test]
    fn an_empty_list_of_files_is_asked_for_again() -> Result<()> {
        let cache = tempfile::tempdir().expect("a folder");
        let folder = Folder::of(cache.path(), &HubUri::parse("hf://a/b", RepoKind::Model)?);
        let file = HubFile { path: "a".to_owned(), size: 1, sha256: None, git_id: None };
        folder.remember_files("c", std::slice::from_ref(&file))?;
        assert_eq!(folder.known_files("c"), Some(vec![file]));
        folder.remember_files("c", &[])?;
        assert_eq!(folder.known_files("c"), None);
        Ok(())
    }
}
