//! The Hugging Face hub: datasets and checkpoints by [`HubUri`], downloaded into a cache and uploaded as commits.
//!
//! [`Hub::pull`] pins a revision to its commit, downloads what the cache lacks, resumes interrupted downloads and verifies
//! hashes. [`Hub::push`] uploads files as one commit. The hub's own Rust client would add a second HTTP stack; this one uses the
//! client below object stores. Large files are transferred by the Git LFS protocol, which the hub also speaks for files in its
//! Xet storage.

mod cache;
mod client;
mod commit_line;
mod download;
mod pace;
mod pointer;
mod replaced;
mod upload;
mod uri;
mod verified;

pub use pointer::check_no_pointer;
pub use upload::{PushOptions, Pushed};
pub use uri::{HubUri, RepoKind};

use client::Client;
use std::path::{Path, PathBuf};
use swm_core::Result;

/// A file of a repository.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct HubFile {
    /// The path in the repository.
    pub path: String,
    /// The size, in bytes.
    pub size: u64,
    /// The SHA-256 hash of a large file; `None` for a file that is stored in Git.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// The id of a file that is stored in Git, which is a SHA-1 hash; `None` for a large file, and if the hub states none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub git_id: Option<String>,
}

impl HubFile {
    /// Whether the hub lists a hash of the file.
    fn is_hashed(&self) -> bool {
        self.sha256.is_some() || self.git_id.is_some()
    }
}

/// What [`Hub::pull`] found.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Pulled {
    /// The URI with its commit.
    pub pinned: String,
    /// The file or folder on this machine.
    #[serde(serialize_with = "swm_core::files::serialize_path")]
    pub path: PathBuf,
    /// The number of files.
    pub files: usize,
    /// Their size, in bytes.
    pub bytes: u64,
    /// The bytes that were downloaded; the others were cached.
    pub downloaded: u64,
}

/// A client of the hub with a cache of files.
pub struct Hub {
    client: Client,
    /// The cache of this hub.
    cache: PathBuf,
    /// The cache that earlier builds had for all hubs, if this hub has another one.
    shared: Option<PathBuf>,
}

impl Hub {
    /// A client with the settings of the hub's own tools: the address in `HF_ENDPOINT`, and the token in `HF_TOKEN` or in the file
    /// that their login writes. Files are cached in the folder `cache`.
    ///
    /// # Errors
    /// When the address is invalid, or the client cannot be made.
    pub fn new(cache: &Path) -> Result<Self> {
        Ok(Self::with(Client::from_env()?, cache))
    }

    /// A client for an address and a token.
    ///
    /// # Errors
    /// As [`Hub::new`].
    pub fn at(endpoint: &str, token: Option<&str>, cache: &Path) -> Result<Self> {
        Ok(Self::with(Client::new(endpoint, token.map(str::to_owned))?, cache))
    }

    fn with(client: Client, cache: &Path) -> Self {
        let own = cache::of_hub(cache, &client);
        Self { shared: (own != cache).then(|| cache.to_owned()), cache: own, client }
    }
}
