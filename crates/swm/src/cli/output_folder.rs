//! The output folder of a command.

use super::eval::TRACES;
use super::run_record;
use serde::Deserialize;
use serde::de::IgnoredAny;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};
use swm_eval::STAGED;

/// The file of an evaluation's results, in its folder.
pub const RESULTS: &str = "results.json";

/// Creates the folder that a command writes these files to, and keeps other writers away until the lock is dropped. A
/// command calls this before its work, so that hours of it are not lost because its results cannot be written. Deletes what a
/// killed command left of writing these files.
///
/// # Errors
/// When the folder cannot be created or written to, another process writes to it, or one of the files exists and was not
/// written by this program.
pub fn claim(folder: &Path, names: &[&str]) -> Result<Lock> {
    check_local(folder)?;
    if folder.exists() && !folder.is_dir() {
        return Err(Error::config(folder.display().to_string(), "is not a folder", "give a folder with --output"));
    }
    let lock = Lock::folder(folder)?;
    check_writable(folder)?;
    check(folder, names)?;
    files::delete_temporary(folder, |name| names.contains(&name))?;
    if names.contains(&RESULTS) {
        delete_temporary_of_evaluation(folder)?;
    }
    Ok(lock)
}

/// Deletes what a killed command left of writing a file, unless another one writes in its folder now. Returns the lock of the folder,
/// which the writer of the file holds.
///
/// # Errors
/// When a file cannot be deleted.
pub fn claim_file(file: &Path) -> Result<Option<Lock>> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let lock = Lock::folder(folder).ok();
    if lock.is_some() {
        files::delete_temporary(folder, |name| file.file_name().is_some_and(|own| own == name))?;
    }
    Ok(lock)
}

/// Deletes what a killed evaluation left of writing its record, its videos and their posters.
fn delete_temporary_of_evaluation(folder: &Path) -> Result<()> {
    files::delete_temporary(folder, |name| name == run_record::FILE)?;
    let is_folder = |path: &Path| !path.is_symlink() && path.is_dir();
    let (videos, staged) = (folder.join("videos"), folder.join(STAGED));
    if is_folder(&videos) {
        files::delete_temporary(&videos, is_video)?;
    }
    let staged_videos = staged.join("videos");
    if is_folder(&staged) && is_folder(&staged_videos) {
        files::delete_temporary(&staged_videos, is_video)?;
        let is_own = |name: &PathBuf| {
            let path = staged_videos.join(name);
            let is_marked = swm_data::check_mp4(&path).is_ok() || swm_data::check_png(&path).is_ok();
            is_marked && name.to_str().is_some_and(|name| !name.contains('/') && is_video(name))
        };
        let names = files::list(&staged_videos)?.into_iter().filter(is_own);
        files::delete_named(&staged_videos, &names.collect::<Vec<_>>())?;
        files::remove_empty_folder(&staged_videos)?;
        files::remove_empty_folder(&staged)?;
    }
    Ok(())
}

/// Deletes the traces of an earlier evaluation, before the results of another one are written beside them.
///
/// # Errors
/// When they cannot be deleted.
pub fn delete_traces(folder: &Path) -> Result<()> {
    let path = folder.join(TRACES);
    if files::exists(&path)? && is_own(&path) {
        files::delete(folder, &[TRACES])?;
    }
    Ok(())
}

/// Returns a file in the folder of an evaluation that no evaluation writes, if there is one.
///
/// # Errors
/// When the folder cannot be read.
pub fn foreign_file(folder: &Path) -> Result<Option<PathBuf>> {
    let is_of_evaluation = |name: &PathBuf| {
        let path = folder.join(name);
        match name.to_str() {
            Some(RESULTS | TRACES) => is_own(&path),
            Some(run_record::FILE) => run_record::check(folder).is_ok(),
            Some(text) => {
                let video = text.strip_prefix(STAGED).map_or(text, |text| text.trim_start_matches('/'));
                let is_marked = || swm_data::check_mp4(&path).is_ok() || swm_data::check_png(&path).is_ok();
                video.strip_prefix("videos/").is_some_and(|name| !name.contains('/') && is_video(name)) && is_marked()
            }
            None => false,
        }
    };
    Ok(files::list(folder)?.into_iter().find(|name| !is_of_evaluation(name)))
}

/// Returns whether a name is that of a video of an evaluation or of its poster, such as `random-in-distribution-0.mp4`.
fn is_video(name: &str) -> bool {
    let stem = name.strip_suffix(".mp4").or_else(|| name.strip_suffix(".png")).unwrap_or_default();
    let number = stem.rsplit_once('-').map_or("", |(_, number)| number);
    !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit())
}

/// Checks that an output is a path of this machine, and no URI, which would become a folder such as `s3:`.
///
/// # Errors
/// When it is a URI.
pub fn check_local(output: &Path) -> Result<()> {
    let given = output.to_string_lossy();
    let is_scheme = |scheme: &str| !scheme.is_empty() && scheme.bytes().all(|byte| byte.is_ascii_alphanumeric());
    match given.split_once("://") {
        Some((scheme, _)) if is_scheme(scheme) => {
            Err(Error::config(given, "is a URI, and the output is a path of this machine", "give a path"))
        }
        _ => Ok(()),
    }
}

/// Checks that files that a command replaces were written by this program.
///
/// # Errors
/// When one of the files exists and was not.
pub fn check(folder: &Path, names: &[&str]) -> Result<()> {
    names.iter().try_for_each(|name| files::check_own(&folder.join(name), is_own))
}

/// Returns whether an existing output file was written by this program: a page names it, tables of a study lie beside its
/// page, results have the manifest of an evaluation, autopsies have the hash of their study, and traces are a list of plans.
fn is_own(path: &Path) -> bool {
    let read = |path: &Path| files::read(path, MAX_OUTPUT_BYTES).unwrap_or_default();
    let is_page = |path: &Path| read(path).windows(PAGE_MARK.len()).any(|part| part == PAGE_MARK.as_bytes());
    match path.file_name().and_then(|name| name.to_str()) {
        Some(name) if name.ends_with(".html") => is_page(path),
        Some("table.csv" | "table.tex" | "table.md") => is_page(&path.with_file_name("index.html")),
        Some("autopsy.json") => serde_json::from_slice::<StoredAutopsy>(&read(path)).is_ok(),
        Some(TRACES) => serde_json::from_slice::<Vec<StoredPlan>>(&read(path)).is_ok(),
        _ => serde_json::from_slice::<StoredResults>(&read(path)).is_ok_and(|found| found.manifest.kind == "evaluate"),
    }
}

/// The fields by which an `autopsy.json` is recognised.
#[derive(Deserialize)]
struct StoredAutopsy {
    #[serde(rename = "version")]
    _version: u64,
    #[serde(rename = "study")]
    _study: String,
    #[serde(rename = "autopsy")]
    _autopsy: IgnoredAny,
}

/// The fields by which a `results.json` of any version is recognised.
#[derive(Deserialize)]
struct StoredResults {
    manifest: StoredManifest,
    #[serde(rename = "env")]
    _env: String,
    #[serde(rename = "protocol")]
    _protocol: String,
    #[serde(rename = "runs")]
    _runs: Vec<IgnoredAny>,
}

/// The fields of the manifest by which results are recognised.
#[derive(Deserialize)]
struct StoredManifest {
    kind: String,
    #[serde(rename = "swm_version")]
    _swm_version: String,
}

/// The fields by which a plan in a `traces.json` is recognised.
#[derive(Deserialize)]
struct StoredPlan {
    #[serde(rename = "policy")]
    _policy: String,
    #[serde(rename = "episode")]
    _episode: u64,
    #[serde(rename = "slot")]
    _slot: u64,
    #[serde(rename = "replan")]
    _replan: u64,
    #[serde(rename = "together")]
    _together: u64,
}

/// The heading of every page of this program.
const PAGE_MARK: &str = "<p class=\"eyebrow\">stable-worldmodel</p>";
/// The largest existing output file that is recognised as the program's own.
pub const MAX_OUTPUT_BYTES: u64 = 1 << 30;

/// Checks, before the work, that a command can write its one output file.
///
/// # Errors
/// When the path is a URI or a folder, or its folder does not exist or cannot be written to.
pub fn check_file(path: &Path) -> Result<()> {
    check_local(path)?;
    let given = || path.display().to_string();
    if path.is_dir() {
        return Err(Error::config(given(), "is a folder, and the output is a file", "give the path of a file"));
    }
    let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or_else(|| Path::new("."));
    let shown = folder.display();
    if !folder.exists() {
        let fix = format!("create it (mkdir -p {shown}), or give a path in another folder");
        return Err(Error::config(given(), format!("the folder {shown} does not exist"), fix));
    }
    if !folder.is_dir() {
        let fix = "give a path in a folder";
        return Err(Error::config(given(), format!("{shown} is a file, and not a folder"), fix));
    }
    check_writable(folder)
}

fn check_writable(folder: &Path) -> Result<()> {
    tempfile::tempfile_in(folder).map(drop).map_err(|error| Error::io(folder, "writing to the folder", error))
}
