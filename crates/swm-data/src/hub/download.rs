//! [`Hub::pull`]: downloads, which continue where they were interrupted.

use super::cache::Folder;
use super::client::{Body, Client, encoded_path, named, next_chunk, run};
use super::pace::Pace;
use super::{Hub, HubFile, HubUri, Pulled};
use reqwest::header::{HeaderMap, HeaderValue, RANGE};
use reqwest::{Method, Response, StatusCode};
use sha2::{Digest as _, Sha256};
use std::fs::{File, OpenOptions};
use std::io::{Read as _, Write as _};
use std::ops::Range;
use std::path::Path;
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
                folder.remember_commit(&uri.revision, &commit)?;
                Ok(uri.at(&commit))
            }
            (Err(error @ Error::External { .. }), Some(commit)) => {
                control.emit(Event::Log(&format!("{error}; using the files of {uri} that were downloaded before")));
                Ok(uri.at(&commit))
            }
            (Err(error), _) => Err(error),
        }
    }

    /// Downloads a file, a folder or a whole repository into the cache, without what is there already.
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
        let chosen: Vec<&HubFile> = listed.iter().filter(|file| pinned.contains(&file.path)).collect();
        if chosen.is_empty() {
            let names = listed.iter().map(|file| file.path.as_str());
            let hint = format!("{} lists the files", self.client.page(uri));
            return Err(Error::unknown("file of the repository", &uri.path, names, hint));
        }
        let snapshot = folder.snapshot(commit);
        let is_missing = |file: &&HubFile| {
            std::fs::metadata(snapshot.join(&file.path)).map_or(true, |found| found.len() != file.size)
        };
        let missing: Vec<&HubFile> = chosen.iter().copied().filter(is_missing).collect();
        let mut downloaded = 0;
        if !missing.is_empty() {
            // Another process that downloads this repository is waited for by its error.
            let _lock = Lock::folder(folder.path())?;
            let name = uri.to_string();
            let total = missing.len();
            control.emit(Event::Started(Stage { name: STAGE, subject: &[&name], total, unit: "files" }));
            for (done, file) in missing.into_iter().enumerate() {
                downloaded += self.fetch(&pinned, file, &folder, control)?;
                control.progress(Progress { stage: STAGE, done: done + 1, total, unit: "files", metrics: &[] });
            }
            control.emit(Event::Finished { stage: STAGE, metrics: &[("files", total as f64)] });
        }
        let (files, bytes) = (chosen.len(), chosen.iter().map(|file| file.size).sum());
        Ok(Pulled { pinned: pinned.to_string(), path: snapshot.join(&pinned.path), files, bytes, downloaded })
    }

    /// Downloads a file; returns the number of bytes that the network transferred.
    fn fetch(&self, pinned: &HubUri, file: &HubFile, folder: &Folder, control: &mut Control<'_>) -> Result<u64> {
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
        check_hash(&part, &url, file, control)?;
        std::fs::rename(&part, &path).map_err(|error| Error::io(&path, "saving a download", error))?;
        Ok(transferred)
    }
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
    let Some(expected) = &file.sha256 else { return Ok(()) };
    let (found, _) = sha256(part, control)?;
    if found == *expected {
        return Ok(());
    }
    files::delete_file(part)?;
    let problem = format!("the downloaded file has the SHA-256 hash {found}, and the hub says {expected}");
    Err(Error::corrupt(url, problem, "run it again; if it happens again, tell the owner of the repository"))
}

/// The SHA-256 hash of a file in hexadecimal digits, and its size. Large files take minutes, so that the caller can stop it.
pub(super) fn sha256(path: &Path, control: &mut Control<'_>) -> Result<(String, u64)> {
    let io = |error| Error::io(path, "reading the file", error);
    let (mut file, mut hash, mut block, mut size) = (File::open(path).map_err(io)?, Sha256::new(), vec![0; BLOCK], 0);
    loop {
        control.check()?;
        match file.read(&mut block).map_err(io)? {
            0 => break,
            count => {
                hash.update(&block[..count]);
                size += count as u64;
            }
        }
    }
    Ok((hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect(), size))
}
