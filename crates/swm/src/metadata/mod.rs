//! Descriptions of datasets and of capsules for people and machines: Croissant metadata and datasheets.
//!
//! Both say what the files themselves say: their manifests, hashes, columns, licence and author. What only the author knows, such as
//! what a dataset was made for, is marked as not stated.

mod croissant;
mod datasheet;

pub use croissant::croissant;
pub use datasheet::datasheet;

use crate::home;
use sha2::{Digest as _, Sha256};
use std::fmt::Write as _;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use swm_core::{ColumnSpec, Error, Manifest, Result};
use swm_data::Reader;
use swm_models::capsule::Capsule;

/// The most files of a dataset.
const MAX_FILES: usize = 100_000;

/// What only the author of a dataset knows.
#[derive(Clone, Debug, Default)]
pub struct Stated {
    /// The licence, such as `CC-BY-4.0`.
    pub licence: Option<String>,
    /// Who made it.
    pub author: Option<String>,
    /// Where it is published.
    pub url: Option<String>,
}

/// A dataset, or a capsule.
#[derive(Clone, Debug)]
pub struct Described {
    /// The name: that of the file or folder, without its suffix.
    pub name: String,
    /// What it is, in one sentence.
    pub summary: String,
    /// What its author states.
    pub stated: Stated,
    /// Its files.
    pub files: Vec<DescribedFile>,
    /// The hash of its content (BLAKE3).
    pub content: String,
    /// Its columns; empty for a capsule.
    pub columns: Vec<ColumnSpec>,
    /// The number of episodes and of rows; `None` for a capsule.
    pub size: Option<[usize; 2]>,
    /// Its provenance, if it is known.
    pub manifest: Option<Manifest>,
    /// For a capsule, what was measured: names and values.
    pub measured: Vec<(String, String)>,
}

/// A file.
#[derive(Clone, Debug)]
pub struct DescribedFile {
    /// The path, relative to the folder that holds the dataset or the capsule, with `/` between folders.
    pub path: String,
    /// The size, in bytes.
    pub bytes: u64,
    /// The SHA-256 hash of its content, in hexadecimal.
    pub sha256: String,
}

impl Described {
    /// Describes a dataset on the local disk. Reads all its files.
    ///
    /// # Errors
    /// When the dataset is in an object store, does not exist or is damaged.
    pub fn dataset(given: &str, reader: &dyn Reader, stated: Stated) -> Result<Self> {
        let location = home::find_dataset(given)?;
        let Some(path) = location.path() else {
            let fix = "copy it to this machine, and describe the copy";
            return Err(Error::config(given, "is in an object store, whose files are not hashed", fix));
        };
        let [episodes, rows] = [reader.episodes().len(), reader.episodes().iter().map(|episode| episode.length).sum()];
        let manifest = reader.manifest();
        let text = |key: &str| {
            let config = manifest.as_ref().map(|manifest| &manifest.config);
            config.and_then(|config| config[key].as_str()).map(str::to_owned)
        };
        let of = text("env").map_or(String::new(), |env| format!(" in {env}"));
        Ok(Self {
            name: stem(path),
            summary: format!("{episodes} episodes with {rows} rows of trajectories{of}."),
            stated,
            files: files(path)?,
            content: reader.content_hash()?,
            columns: reader.schema().columns().to_vec(),
            size: Some([episodes, rows]),
            manifest,
            measured: vec![],
        })
    }

    /// Describes a capsule. Its licence and its author are those in the file.
    ///
    /// # Errors
    /// When it is damaged.
    pub fn capsule(
        path: &Path,
        capsule: &Capsule,
        measured: Vec<(String, String)>,
        url: Option<String>,
    ) -> Result<Self> {
        let of = capsule.env().map_or(String::new(), |env| format!(" for {env}"));
        let description = &capsule.description;
        Ok(Self {
            name: stem(path),
            summary: format!("A trained world model or policy{of}, in one file."),
            stated: Stated { licence: description.licence.clone(), author: description.author.clone(), url },
            files: files(path)?,
            content: capsule.hash()?,
            columns: vec![],
            size: None,
            manifest: Some(capsule.manifest.clone()),
            measured,
        })
    }
}

/// The name of a file or a folder, without its suffix.
fn stem(path: &Path) -> String {
    path.file_stem().map_or_else(|| "dataset".to_owned(), |stem| stem.to_string_lossy().into_owned())
}

/// The files of a path, in the order of their names. Links are not followed.
fn files(path: &Path) -> Result<Vec<DescribedFile>> {
    let root = path.parent().unwrap_or(Path::new(""));
    let mut paths = vec![];
    add(path, &mut paths)?;
    paths.sort();
    let describe = |path: PathBuf| {
        let (sha256, bytes) = sha256(&path)?;
        let relative = path.strip_prefix(root).unwrap_or(&path);
        let parts: Vec<_> = relative.iter().map(|part| part.to_string_lossy()).collect();
        Ok(DescribedFile { path: parts.join("/"), bytes, sha256 })
    };
    paths.into_iter().map(describe).collect()
}

fn add(path: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    let io = |error| Error::io(path, "listing the files", error);
    let kind = std::fs::symlink_metadata(path).map_err(io)?.file_type();
    if found.len() > MAX_FILES {
        let problem = format!("has more than {MAX_FILES} files");
        return Err(Error::config(
            path.display().to_string(),
            problem,
            "describe a copy in fewer files (`swm convert`)",
        ));
    }
    if kind.is_dir() {
        for item in std::fs::read_dir(path).map_err(io)? {
            add(&item.map_err(io)?.path(), found)?;
        }
    } else if kind.is_file() {
        found.push(path.to_owned());
    }
    Ok(())
}

/// The SHA-256 hash of a file, and its size.
fn sha256(path: &Path) -> Result<(String, u64)> {
    let io = |error| Error::io(path, "hashing the file", error);
    let (mut file, mut hasher) = (swm_core::files::open(path)?, Sha256::new());
    let (mut buffer, mut bytes) = (vec![0; 1 << 20], 0);
    loop {
        let n = file.read(&mut buffer).map_err(io)?;
        if n == 0 {
            break;
        }
        hasher.update(&buffer[..n]);
        bytes += n as u64;
    }
    let mut text = String::new();
    for byte in hasher.finalize() {
        let _ = write!(text, "{byte:02x}");
    }
    Ok((text, bytes))
}
