//! Files of the Hugging Face hub, kept once they were fetched.
//!
//! They lie where the hub's own libraries put them (`models--OWNER--NAME/snapshots/REVISION/FILE`), and what those have
//! fetched before (`$HF_HOME`, by default `~/.cache/huggingface`) is found, too. Transport is that of our object stores:
//! the hub's client would bring a second one.

use hf_hub::{Cache, Repo, RepoType};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result};
use swm_data::Location;
use swm_data::objects::ObjectFile;

/// Bytes asked for at once.
const PIECE: u64 = 32 << 20;

/// The hub, and where its files are kept.
pub struct Hub {
    endpoint: String,
    kept: PathBuf,
    /// Where the hub's own libraries keep theirs.
    theirs: Option<PathBuf>,
}

impl Hub {
    /// The hub that the environment names (`HF_ENDPOINT`, by default `https://huggingface.co`); its files are kept in the
    /// folder `kept`.
    pub fn new(kept: &Path) -> Self {
        let set = |name| std::env::var(name).ok().filter(|value| !value.is_empty());
        let endpoint = set("HF_ENDPOINT").unwrap_or_else(|| "https://huggingface.co".to_owned());
        let theirs = set("HF_HOME")
            .map(PathBuf::from)
            .or_else(|| Some(PathBuf::from(set("HOME")?).join(".cache").join("huggingface")));
        Self { endpoint, kept: kept.to_owned(), theirs: theirs.map(|home| home.join("hub")) }
    }

    /// The hub at `endpoint`.
    pub fn at(endpoint: &str, kept: &Path) -> Self {
        Self { endpoint: endpoint.to_owned(), kept: kept.to_owned(), theirs: None }
    }

    /// A file of a repository (`OWNER/NAME`, or `OWNER/NAME@REVISION`), fetched unless it is here.
    ///
    /// # Errors
    /// When it is not here and the hub has no such file, or cannot be reached.
    pub fn fetch(&self, repo: &str, file: &str) -> Result<PathBuf> {
        let (id, revision) = repo.split_once('@').unwrap_or((repo, "main"));
        let asked = Repo::with_revision(id.to_owned(), RepoType::Model, revision.to_owned());
        let known = |folder: &PathBuf| Cache::new(folder.clone()).repo(asked.clone()).get(file);
        if let Some(found) = [Some(&self.kept), self.theirs.as_ref()].into_iter().flatten().find_map(known) {
            return Ok(found);
        }
        let url = format!("{}/{id}/resolve/{revision}/{file}", self.endpoint);
        let unreachable = |error: Error| match error {
            missing @ Error::Corrupt { .. } => missing,
            other => Error::external(
                format!("fetching {file} of {repo}"),
                format!(
                    "{other}; is there a network? (without one, fetch {url} elsewhere and give the file's path instead; \
                     repositories that ask for a token cannot be fetched here)"
                ),
            ),
        };
        let remote = ObjectFile::open(&Location::parse(&url)?).map_err(unreachable)?;
        let cache = Cache::new(self.kept.clone()).repo(asked);
        let place = cache.pointer_path(revision).join(file);
        let io = |path: &Path, action: &str| {
            let (path, action) = (path.to_owned(), action.to_owned());
            move |source| Error::io(path, action, source)
        };
        let folder = place.parent().unwrap_or(&self.kept);
        std::fs::create_dir_all(folder).map_err(io(folder, "making a folder"))?;
        // Complete under its name or not there: two processes that fetch at once write the same.
        let part = place.with_extension(format!("part-{}", std::process::id()));
        let mut out = std::fs::File::create(&part).map_err(io(&part, "keeping a download"))?;
        let mut done = 0;
        while done < remote.len() {
            let end = (done + PIECE).min(remote.len());
            for bytes in remote.read(std::slice::from_ref(&(done..end))).map_err(unreachable)? {
                out.write_all(&bytes).map_err(io(&part, "keeping a download"))?;
            }
            done = end;
        }
        std::fs::rename(&part, &place).map_err(io(&place, "keeping a download"))?;
        cache.create_ref(revision).map_err(io(&self.kept, "keeping a download"))?;
        Ok(place)
    }
}

/// A file of a repository of the Hugging Face hub, such as `model.safetensors` of `facebook/dinov2-small`; kept below the
/// folder `home`.
///
/// # Errors
/// As [`Hub::fetch`].
pub fn fetch(repo: &str, file: &str, home: &Path) -> Result<PathBuf> {
    Hub::new(home).fetch(repo, file)
}

/// The file that `from` names: a file here, or the weights of a repository (`OWNER/NAME`), kept below the folder `home`.
///
/// # Errors
/// When there is neither, or the hub cannot be reached.
pub fn locate(from: &str, home: &Path) -> Result<PathBuf> {
    let path = PathBuf::from(from);
    if path.is_file() {
        return Ok(path);
    }
    let mut parts = from.split('/');
    let is_repo = parts.by_ref().take(2).filter(|part| !part.is_empty() && !part.starts_with('.')).count() == 2;
    if !is_repo || parts.next().is_some() {
        let fix = "give a file of weights, or a repository of the Hugging Face hub such as facebook/dinov2-small";
        return Err(Error::config("weights", format!("there is no file '{from}'"), fix));
    }
    let hub = Hub::new(home);
    match hub.fetch(from, "model.safetensors") {
        // Early repositories have nothing else.
        Err(Error::Corrupt { .. }) => hub.fetch(from, "pytorch_model.bin"),
        found => found,
    }
}
