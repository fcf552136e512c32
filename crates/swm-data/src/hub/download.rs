//! [`Hub::pull`]: downloads, which continue where they were interrupted.

use super::cache::Folder;
use super::client::{Body, Client, encoded_path, named, next_chunk, run};
use super::pace::Pace;
use super::verified::{self, OtherHash, Stamp, Verified};
use super::{Hub, HubFile, HubUri, Pulled};
use reqwest::header::{HeaderMap, HeaderValue, RANGE};
use reqwest::{Method, Response, StatusCode};
use sha2::{Digest as _, Sha256};
use std::fs::{File, OpenOptions};
use std::io::{Read as _, Write as _};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use swm_core::files::{self, Lock};
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Error, Result};

/// The name of the stage.
const STAGE: &str = "pull";
/// How often a download is tried, without those tries that bring [`PROGRESS`].
const ATTEMPTS: usize = 4;
/// The time between the first two tries; it grows with each further one.
const PAUSE: Duration = Duration::from_millis(500);
/// The bytes that a connection must bring before it breaks, to be no failed try.
const PROGRESS: u64 = 1 << 20;
/// The bytes that are read of a file at once.
const BLOCK: usize = 1 << 20;

impl Hub {
    /// The URI with the commit of its revision. Without a connection, the commit that the revision had when it was last asked
    /// for.
    ///
    /// # Errors
    /// When there is no such repository or revision, it may not be read, or the hub cannot be reached.
    pub fn pin(&self, uri: &HubUri, control: &mut Control<'_>) -> Result<HubUri> {
        if uri.is_pinned() {
            return Ok(uri.clone());
        }
        let folder = Folder::of(&self.cache, uri);
        match (self.client.commit(uri), folder.known_commit(&uri.revision)) {
            (Ok(commit), _) => {
                // A cache that cannot be written can be read.
                if folder.known_commit(&uri.revision).as_deref() != Some(&*commit) {
                    folder.remember_commit(&uri.revision, &commit)?;
                }
                Ok(uri.at(&commit))
            }
            (Err(error @ Error::External { .. }), Some(commit)) => {
                control.emit(Event::Log(&format!("{error}; using the files of {uri} that were downloaded before")));
                Ok(uri.at(&commit))
            }
            (Err(error), _) => Err(error),
        }
    }

    /// Downloads a file, a folder or a whole repository into the cache, without what is there already. Files of the
    /// cache that have changed since they were compared with their hashes are compared again.
    ///
    /// # Errors
    /// As [`Hub::pin`]; when there is no such file, a downloaded file has another hash or size than the hub says, or the user
    /// stops the program, which keeps what was downloaded.
    pub fn pull(&self, uri: &HubUri, control: &mut Control<'_>) -> Result<Pulled> {
        let pinned = self.pin(uri, control)?;
        let (commit, folder) = (&pinned.revision, Folder::of(&self.cache, uri));
        std::fs::create_dir_all(folder.path()).map_err(|error| Error::io(folder.path(), "creating a folder", error))?;
        let listed = match folder.known_files(commit) {
            Some(listed) => listed,
            None => {
                let listed = self.client.files(&pinned, commit, control)?;
                folder.remember_files(commit, &listed)?;
                listed
            }
        };
        if listed.is_empty() {
            return Err(Error::config(
                pinned.to_string(),
                "has no files",
                "name another repository, or another revision",
            ));
        }
        let chosen: Vec<&HubFile> = listed.iter().filter(|file| pinned.contains(&file.path)).collect();
        if chosen.is_empty() {
            let names = listed.iter().map(|file| file.path.as_str());
            let hint = format!("{} lists the files", self.client.page(uri));
            return Err(Error::unknown("file of the repository", &uri.path, names, hint));
        }
        let mut verified = Verified::read(folder.verified(commit));
        let completed = self.complete(&pinned, &chosen, &folder, &mut verified, control);
        verified.save();
        let (snapshot, downloaded) = completed?;
        let (files, bytes) = (chosen.len(), chosen.iter().map(|file| file.size).sum());
        Ok(Pulled { pinned: pinned.to_string(), path: snapshot.join(&pinned.path), files, bytes, downloaded })
    }

    /// Downloads the files that the cache lacks; returns the folder of the commit, and the number of bytes that the
    /// network transferred.
    fn complete(
        &self,
        pinned: &HubUri,
        chosen: &[&HubFile],
        folder: &Folder,
        verified: &mut Verified,
        control: &mut Control<'_>,
    ) -> Result<(PathBuf, u64)> {
        let snapshot = folder.snapshot(&pinned.revision);
        if let Some(old) = self.old_snapshot(pinned, chosen, &snapshot, verified, control)? {
            return Ok((old, 0));
        }
        let mut missing = verified.missing(chosen, &snapshot, control)?;
        if missing.is_empty() {
            return Ok((snapshot, 0));
        }
        // Another process that downloads this repository is waited for by its error, unless it has brought all files.
        let lock = Lock::folder(folder.path());
        verified.reload();
        missing.retain(|file| !verified.has(file, &snapshot));
        if missing.is_empty() {
            return Ok((snapshot, 0));
        }
        let _lock = lock?;
        let downloaded = self.download(pinned, missing, folder, verified, control);
        // Before the lock is released: the next process reads the record when it has the lock.
        verified.save();
        Ok((snapshot, downloaded?))
    }

    /// The folder of the commit in the cache that earlier builds had for all hubs, if this hub's own cache has none,
    /// and all files there have the hashes that this hub lists.
    fn old_snapshot(
        &self,
        pinned: &HubUri,
        chosen: &[&HubFile],
        own: &Path,
        verified: &mut Verified,
        control: &mut Control<'_>,
    ) -> Result<Option<PathBuf>> {
        let Some(shared) = self.shared.as_ref().filter(|_| !own.exists()) else { return Ok(None) };
        let old = Folder::of(shared, pinned).snapshot(&pinned.revision);
        if !chosen.iter().all(|file| file.is_hashed() && verified::find(file, &old).is_some()) {
            return Ok(None);
        }
        let is_compared = |verified: &Verified| chosen.iter().all(|file| verified.has(file, &old));
        if !is_compared(verified) {
            verified.missing(chosen, &old, control)?;
            if !is_compared(verified) {
                return Ok(None);
            }
            let message = format!("{} has the files that {} lists; using them", old.display(), self.client.endpoint());
            control.emit(Event::Log(&message));
        }
        Ok(Some(old))
    }

    /// Downloads files; returns the number of bytes that the network transferred.
    fn download(
        &self,
        pinned: &HubUri,
        missing: Vec<&HubFile>,
        folder: &Folder,
        verified: &mut Verified,
        control: &mut Control<'_>,
    ) -> Result<u64> {
        let (name, total, mut downloaded) = (pinned.at("main").to_string(), missing.len(), 0);
        control.emit(Event::Started(Stage { name: STAGE, subject: &[&name], total, unit: "files" }));
        for (done, file) in missing.into_iter().enumerate() {
            let fetched = self.fetch(pinned, file, folder, control);
            let (transferred, stamp) = fetched.map_err(|error| with_old_file(error, file, folder, &pinned.revision))?;
            verified.add(file, stamp);
            downloaded += transferred;
            control.progress(Progress { stage: STAGE, done: done + 1, total, unit: "files", metrics: &[] });
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[("files", total as f64)] });
        Ok(downloaded)
    }

    /// Downloads a file; returns the number of bytes that the network transferred, and the stamp of the file if it has
    /// a listed hash.
    fn fetch(
        &self,
        pinned: &HubUri,
        file: &HubFile,
        folder: &Folder,
        control: &mut Control<'_>,
    ) -> Result<(u64, Option<Stamp>)> {
        let (part, path) = (folder.partial(&pinned.revision, file), folder.snapshot(&pinned.revision).join(&file.path));
        for path in [&part, &path] {
            let folder = path.parent().unwrap_or(path);
            std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, "creating a folder", error))?;
        }
        let url = format!("{}/resolve/{}/{}", self.client.page(pinned), pinned.revision, encoded_path(&file.path));
        let size_of_part = || std::fs::metadata(&part).map_or(0, |found| found.len());
        if size_of_part() > file.size {
            files::delete_file(&part)?;
        }
        // A server that sends the same bytes again makes no progress.
        let (mut transferred, mut attempts, mut most) = (0, 0, size_of_part());
        loop {
            let before = size_of_part();
            let outcome = if before == file.size && before > 0 {
                Ok(())
            } else {
                transfer(&self.client, pinned, &url, before..file.size, &part, control)
            };
            let now = size_of_part();
            transferred += now.saturating_sub(before);
            match outcome {
                Ok(()) if now == file.size => break,
                Err(error) if !matches!(error, Error::External { .. }) => return Err(error),
                outcome => {
                    attempts = if now >= most + PROGRESS { 0 } else { attempts + 1 };
                    most = most.max(now);
                    if attempts >= ATTEMPTS {
                        let short = || {
                            let problem = format!("the server sent {most} of {} bytes in several tries", file.size);
                            Error::external(url.clone(), format!("{problem}; run it again to continue"))
                        };
                        return Err(outcome.err().unwrap_or_else(short));
                    }
                    if let Err(error) = outcome {
                        control.emit(Event::Log(&format!("{error}; trying again")));
                    }
                    pause(PAUSE * attempts as u32, control)?;
                }
            }
        }
        let stamp = Stamp::at(&part).filter(|_| file.is_hashed());
        check_hash(&part, &url, file, control)?;
        set_aside(&path, || changed_name(file, folder, &pinned.revision), control)?;
        std::fs::rename(&part, &path).map_err(|error| Error::io(&path, "saving a download", error))?;
        Ok((transferred, stamp))
    }
}

/// The path that a file gets which is replaced by a download: one that nothing has, and that no file of the commit will have.
fn changed_name(file: &HubFile, folder: &Folder, commit: &str) -> PathBuf {
    let (snapshot, listed) = (folder.snapshot(commit), folder.known_files(commit).unwrap_or_default());
    let mut name = format!("{}.changed", file.path);
    for number in 2.. {
        let is_listed = listed.iter().any(|file| file.path == name || file.path.starts_with(&format!("{name}/")));
        if !is_listed && std::fs::symlink_metadata(snapshot.join(&name)).is_err() {
            break;
        }
        name = format!("{}.changed-{number}", file.path);
    }
    snapshot.join(name)
}

/// Keeps a file that a download replaces, because the user may have edited it. `name` gives its new path.
fn set_aside(path: &Path, name: impl FnOnce() -> PathBuf, control: &mut Control<'_>) -> Result<()> {
    if !std::fs::symlink_metadata(path).is_ok_and(|found| !found.is_dir()) {
        return Ok(());
    }
    let kept = name();
    std::fs::rename(path, &kept).map_err(|error| Error::io(&kept, "keeping the old file", error))?;
    control.emit(Event::Log(&format!("{} is the file that the download replaces", kept.display())));
    Ok(())
}

/// The error of a download, which names the file that it would replace.
fn with_old_file(error: Error, file: &HubFile, folder: &Folder, commit: &str) -> Error {
    let path = folder.snapshot(commit).join(&file.path);
    if !matches!(error, Error::External { .. }) || !path.exists() {
        return error;
    }
    let kept = changed_name(file, folder, commit);
    let fix = format!("run it again with a connection, which keeps this file as {}", kept.display());
    let problem = "it differs from the hub's file, which could not be downloaded";
    Error::external(path.display().to_string(), format!("{problem}; {fix}: {error}"))
}

/// Waits, and can be stopped.
fn pause(time: Duration, control: &mut Control<'_>) -> Result<()> {
    const STEP: Duration = Duration::from_millis(50);
    let until = Instant::now() + time;
    while Instant::now() < until {
        control.check()?;
        std::thread::sleep(STEP);
    }
    Ok(())
}

/// Appends what a file lacks, which are the bytes `missing`.
fn transfer(
    client: &Client,
    uri: &HubUri,
    url: &str,
    missing: Range<u64>,
    part: &Path,
    control: &mut Control<'_>,
) -> Result<()> {
    let mut headers = HeaderMap::new();
    if missing.start > 0 {
        let range = HeaderValue::try_from(format!("bytes={}-", missing.start));
        headers.extend(range.ok().map(|range| (RANGE, range)));
    }
    let mut answer = client.send(Method::GET, url, Body::default(), headers, true)?;
    let continues = answer.status() == StatusCode::PARTIAL_CONTENT;
    if answer.status() == StatusCode::RANGE_NOT_SATISFIABLE {
        files::delete_file(part)?;
        return Ok(());
    }
    client.check(&answer, uri)?;
    let io = |error| Error::io(part, "saving a download", error);
    let mut out =
        OpenOptions::new().create(true).write(true).append(continues).truncate(!continues).open(part).map_err(io)?;
    let mut left = if continues { missing.end - missing.start } else { missing.end };
    let (whole, name, mut pace) = (left, format!("{}: {}", named(url), uri.at("main")), Pace::new());
    loop {
        control.check()?;
        let (next, rest) = chunk(url, answer)?;
        let Some(bytes) = next else { return out.sync_all().map_err(io) };
        let Some(after) = left.checked_sub(bytes.len() as u64) else {
            drop(out);
            files::delete_file(part)?;
            let problem = format!("the server sends more than the {} bytes that the hub lists", missing.end);
            return Err(Error::corrupt(url, problem, "tell the owner of the repository; do not use this hub"));
        };
        out.write_all(&bytes).map_err(io)?;
        if let Some(message) = pace.add(bytes.len(), &name, Some(whole))? {
            control.emit(Event::Log(&message));
        }
        (left, answer) = (after, rest);
    }
}

/// Reads some bytes of an answer.
fn chunk(url: &str, mut answer: Response) -> Result<(Option<bytes::Bytes>, Response)> {
    let label = url.to_owned();
    run(url, async move {
        let bytes = next_chunk(&label, &mut answer).await?;
        Ok((bytes, answer))
    })
}

/// Checks the hash of a complete download, and deletes one that differs.
fn check_hash(part: &Path, url: &str, file: &HubFile, control: &mut Control<'_>) -> Result<()> {
    let Some(OtherHash { kind, listed, found }) = OtherHash::find(part, file, control)? else { return Ok(()) };
    files::delete_file(part)?;
    let problem = format!("the downloaded file has the {kind} {found}, and the hub says {listed}");
    Err(Error::corrupt(url, problem, "run it again; if it happens again, tell the owner of the repository"))
}

/// The SHA-256 hash of a file in hexadecimal digits, and its size.
pub(super) fn sha256(path: &Path, control: &mut Control<'_>) -> Result<(String, u64)> {
    let mut hash = Sha256::new();
    let size = read_blocks(path, control, |block| hash.update(block))?;
    Ok((hexadecimal(&hash.finalize()), size))
}

/// The digits of a hash.
pub(super) fn hexadecimal(hash: &[u8]) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Reads a file in blocks; returns its size. Large files take minutes, so that the caller can stop it.
pub(super) fn read_blocks(path: &Path, control: &mut Control<'_>, mut each: impl FnMut(&[u8])) -> Result<u64> {
    let io = |error| Error::io(path, "reading the file", error);
    let (mut file, mut block, mut size) = (File::open(path).map_err(io)?, vec![0; BLOCK], 0);
    loop {
        control.check()?;
        match file.read(&mut block).map_err(io)? {
            0 => return Ok(size),
            count => {
                each(&block[..count]);
                size += count as u64;
            }
        }
    }
}
