//! The cache: `KINDs--OWNER--NAME/` with `refs/REVISION` (its commit), `lists/COMMIT.json` (its files), `snapshots/COMMIT/` and
//! `partial/` (interrupted downloads).

use super::{HubFile, HubUri, RepoKind};
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// The largest list of files, in bytes.
const MAX_LIST: u64 = 256 << 20;

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

    /// The files of a commit, if they were listed before.
    pub fn known_files(&self, commit: &str) -> Option<Vec<HubFile>> {
        let bytes = files::read(&self.list(commit), MAX_LIST).ok()?;
        let listed: Vec<HubFile> = serde_json::from_slice(&bytes).ok()?;
        let no_git = super::uri::git_folder(listed.iter().map(|file| file.path.as_str())).is_none();
        (no_git && listed.iter().all(|file| super::uri::is_inside(&file.path))).then_some(listed)
    }

    pub fn remember_files(&self, commit: &str, listed: &[HubFile]) -> Result<()> {
        let bytes = serde_json::to_vec(listed).map_err(|error| Error::external("writing a list of files", error))?;
        write(&self.list(commit), &bytes)
    }

    fn list(&self, commit: &str) -> PathBuf {
        self.0.join("lists").join(format!("{commit}.json"))
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
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
}
