//! [`Hub`]: downloads files of the Hugging Face hub and caches them.
//!
//! The cache has the layout of Python's `huggingface_hub` (`models--OWNER--NAME/snapshots/REVISION/FILE`). Files in the
//! cache of that package (`$HF_HOME`, by default `~/.cache/huggingface`) are used as well. Downloads use the
//! object-store client of `swm-data`, because the hub's Rust client would add a second HTTP stack.

use hf_hub::{Cache, Repo, RepoType};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};
use swm_data::Location;
use swm_data::objects::ObjectFile;

/// The size of a download request, in bytes.
const CHUNK: u64 = 32 << 20;

/// A client of the hub with file caches.
pub struct Hub {
    endpoint: String,
    cache: PathBuf,
    /// The cache of Python's `huggingface_hub`.
    library_cache: Option<PathBuf>,
}

impl Hub {
    /// Creates a client for the address in `HF_ENDPOINT` (by default `https://huggingface.co`) that caches files in the
    /// folder `cache`.
    pub fn new(cache: &Path) -> Self {
        let variable = |name| std::env::var(name).ok().filter(|value| !value.is_empty());
        let endpoint = variable("HF_ENDPOINT").unwrap_or_else(|| "https://huggingface.co".to_owned());
        let home = variable("HF_HOME")
            .map(PathBuf::from)
            .or_else(|| Some(PathBuf::from(variable("HOME")?).join(".cache").join("huggingface")));
        Self { endpoint, cache: cache.to_owned(), library_cache: home.map(|home| home.join("hub")) }
    }

    /// Creates a client for `endpoint` that uses the folder `cache` only.
    pub fn at(endpoint: &str, cache: &Path) -> Self {
        Self { endpoint: endpoint.to_owned(), cache: cache.to_owned(), library_cache: None }
    }

    /// Returns the path of a file of a repository (`OWNER/NAME` or `OWNER/NAME@REVISION`); downloads the file if it is
    /// not cached.
    ///
    /// # Errors
    /// When a name leads out of the cache; when the file is not cached, and the hub does not have it, answers with something
    /// else than weights, or cannot be reached.
    pub fn fetch(&self, repo: &str, file: &str) -> Result<PathBuf> {
        let (id, revision) = repo.split_once('@').unwrap_or((repo, "main"));
        check_inside("repository", id)?;
        check_inside("revision", revision)?;
        check_inside("file", file)?;
        let repository = Repo::with_revision(id.to_owned(), RepoType::Model, revision.to_owned());
        let cached = |folder: &PathBuf| Cache::new(folder.clone()).repo(repository.clone()).get(file);
        if let Some(found) = [Some(&self.cache), self.library_cache.as_ref()].into_iter().flatten().find_map(cached) {
            return Ok(found);
        }
        let url = format!("{}/{id}/resolve/{revision}/{file}", self.endpoint);
        let unreachable = |error: Error| match error {
            missing @ Error::Corrupt { .. } => missing,
            other => Error::external(
                format!("fetching {file} of {repo}"),
                format!(
                    "{other}; check the network connection, or download {url} on another machine and give the file's path \
                     (repositories that require a token are not supported)"
                ),
            ),
        };
        let remote = ObjectFile::open(&Location::parse(&url)?).map_err(unreachable)?;
        let cache = Cache::new(self.cache.clone()).repo(repository);
        let path = cache.pointer_path(revision).join(file);
        let io = |path: &Path, action: &str| {
            let (path, action) = (path.to_owned(), action.to_owned());
            move |source| Error::io(path, action, source)
        };
        let folder = path.parent().unwrap_or(&self.cache);
        std::fs::create_dir_all(folder).map_err(io(folder, "creating a folder"))?;
        // Renaming the complete file allows two processes to download the same file at the same time.
        let part = path.with_extension(format!("part-{}", std::process::id()));
        let download = || {
            let mut out = std::fs::File::create(&part).map_err(io(&part, "saving a download"))?;
            let mut done = 0;
            while done < remote.len() {
                let end = (done + CHUNK).min(remote.len());
                for bytes in remote.read(std::slice::from_ref(&(done..end))).map_err(unreachable)? {
                    if done == 0 {
                        check_weights(file, &url, remote.len(), &bytes)?;
                    }
                    out.write_all(&bytes).map_err(io(&part, "saving a download"))?;
                }
                done = end;
            }
            if done == 0 { check_weights(file, &url, 0, &[]) } else { Ok(()) }
        };
        if let Err(error) = download() {
            // The error of the download matters more than that of removing its rest.
            let _ = files::delete_file(&part);
            return Err(error);
        }
        std::fs::rename(&part, &path).map_err(io(&path, "saving a download"))?;
        cache.create_ref(revision).map_err(io(&self.cache, "saving a download"))?;
        Ok(path)
    }
}

/// Checks that a name of a repository, revision or file stays inside the folder of the cache.
fn check_inside(what: &str, name: &str) -> Result<()> {
    let inside = name.split('/').all(|part| !matches!(part, "" | "." | ".."));
    if inside && !name.contains(['\\', '\0', '@', '?', '#']) {
        return Ok(());
    }
    let fix = "name a repository as OWNER/NAME or OWNER/NAME@REVISION, and files as the hub lists them";
    Err(Error::config(what, format!("'{}' is no such name on the hub", name.escape_debug()), fix))
}

/// Checks that an answer can be a file of weights: the `length` of a `.safetensors` file holds its header, and a `.bin` or
/// `.pt` file is a zip archive or a pickle. A page that says something else has neither.
fn check_weights(file: &str, url: &str, length: u64, start: &[u8]) -> Result<()> {
    let plausible = match Path::new(file).extension().and_then(|extension| extension.to_str()) {
        Some("safetensors") => start.first_chunk().is_some_and(|header| {
            let header = u64::from_le_bytes(*header);
            header <= length.saturating_sub(8) && start.get(8) == Some(&b'{')
        }),
        Some("bin" | "pt" | "pth") => start.starts_with(b"PK") || start.starts_with(&[0x80]),
        _ => length > 0,
    };
    if plausible {
        return Ok(());
    }
    let problem = format!("the server's answer of {length} bytes is not the content of such a file");
    Err(Error::corrupt(url, problem, "check the server and the name of the file"))
}

/// Returns the path of a file of a Hugging Face repository, such as `model.safetensors` of `facebook/dinov2-small`;
/// downloads are cached in the folder `cache`.
///
/// # Errors
/// As [`Hub::fetch`].
pub fn fetch(repo: &str, file: &str, cache: &Path) -> Result<PathBuf> {
    Hub::new(cache).fetch(repo, file)
}

/// Returns the path of a file of weights; `from` is a local file or a Hugging Face repository (`OWNER/NAME`), whose
/// files are cached in the folder `cache`.
///
/// # Errors
/// When `from` is neither a file nor a repository, or the hub cannot be reached.
pub fn locate(from: &str, cache: &Path) -> Result<PathBuf> {
    let path = PathBuf::from(from);
    if path.is_file() {
        return Ok(path);
    }
    let mut parts = from.split('/');
    let is_repo = parts.by_ref().take(2).filter(|part| !part.is_empty() && !part.starts_with('.')).count() == 2;
    if !is_repo || parts.next().is_some() {
        let fix =
            "give the path of a weights file, or a repository of the Hugging Face hub such as facebook/dinov2-small";
        return Err(Error::config("weights", format!("there is no file '{from}'"), fix));
    }
    let hub = Hub::new(cache);
    match hub.fetch(from, "model.safetensors") {
        // Older repositories have no safetensors file.
        Err(Error::Corrupt { .. }) => hub.fetch(from, "pytorch_model.bin"),
        found => found,
    }
}
