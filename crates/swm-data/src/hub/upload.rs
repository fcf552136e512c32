//! [`Hub::push`]: uploads files as one commit.

use super::client::{Body, Client, Content, ERROR_CODE, header, json_body, named, parsed, whole};
use super::commit_line::Line;
use super::download::sha256;
use super::{Hub, HubUri, RepoKind};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use reqwest::Method;
use reqwest::header::HeaderMap;
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::SystemTime;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::text::one_line;
use swm_core::{Error, Result};

/// The name of the stage.
const STAGE: &str = "push";
/// The bytes of a file from which the hub decides how it is stored.
const SAMPLE: usize = 512;
/// The most files of one commit, and the most that one request names.
const MAX_FILES: usize = 25_000;
const MAX_NAMED: usize = 256;
/// The largest file that is part of the commit itself, in bytes.
const MAX_REGULAR: u64 = 10 << 20;
/// The largest file that is sent in one request, in bytes; the hub asks for parts of larger ones.
const MAX_WHOLE: u64 = 5 << 30;
/// The largest commit that is made before it is sent, in bytes.
const MAX_HELD: u64 = 32 << 20;
/// The bytes that are read of a file at once.
const BLOCK: u64 = 1 << 18;
/// The most headers that are sent with a file because the hub asks for them.
const MAX_HEADERS: usize = 64;
/// The media type of Git LFS.
const LFS_TYPE: &str = "application/vnd.git-lfs+json";

/// How files are uploaded.
#[derive(Clone, Debug, Default)]
pub struct PushOptions {
    /// Whether a repository that is made for them is private.
    pub private: bool,
    /// The title of the commit.
    pub message: String,
}

/// What [`Hub::push`] uploaded.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Pushed {
    /// The URI with its commit.
    pub pinned: String,
    /// The page of the commit.
    pub page: String,
    /// The number of files of the commit.
    pub files: usize,
    /// Their size, in bytes.
    pub bytes: u64,
    /// The bytes of large files that the hub did not have.
    pub uploaded: u64,
}

/// A file to upload.
struct Upload {
    local: PathBuf,
    path: String,
    size: u64,
    /// When it was last changed before it was hashed.
    modified: Option<SystemTime>,
    sha256: String,
    sample: String,
}

impl Upload {
    /// Checks that the file is the one that was hashed.
    fn check_unchanged(&self) -> Result<()> {
        let found = std::fs::metadata(&self.local).map_err(|error| reading(&self.local, error))?;
        if found.len() == self.size && found.modified().ok() == self.modified {
            return Ok(());
        }
        let fix = "wait until the program that writes it has ended, then run it again";
        Err(Error::config(self.local.display().to_string(), "changed while it was uploaded", fix))
    }
}

/// Where the parts of a large file are sent.
#[derive(Deserialize)]
struct Action {
    href: String,
    #[serde(default)]
    header: BTreeMap<String, Value>,
}

impl Action {
    /// The headers that the hub asks for.
    fn headers(&self) -> Result<HeaderMap> {
        if self.header.len() > MAX_HEADERS {
            let problem =
                format!("it asks for {} headers with a file; at most {MAX_HEADERS} are sent", self.header.len());
            return Err(Error::external("the hub", problem));
        }
        let known = self.header.iter().filter_map(|(name, value)| Some((name, value.as_str()?)));
        known.map(|(name, value)| header(name, value)).collect()
    }
}

impl Hub {
    /// Uploads a file or a folder to a path of a repository, which is made if it does not exist. All files make one commit; large
    /// ones that the hub has already are not sent again, so an interrupted upload continues.
    ///
    /// # Errors
    /// When there is nothing to upload, the token may not write, a file is too large, the repository has another dataset at this path, or
    /// the hub cannot be reached.
    pub fn push(&self, from: &Path, to: &HubUri, options: &PushOptions, control: &mut Control<'_>) -> Result<Pushed> {
        if to.is_pinned() {
            let fix = "name a branch, or none for main";
            return Err(Error::config(to.to_string(), "is a commit, which cannot be changed", fix));
        }
        let uploads = uploads(from, &to.path, control)?;
        let (total, bytes) = (uploads.len(), uploads.iter().map(|upload| upload.size).sum());
        let exists = !self.client.create(to, options.private)?;
        let paths = uploads.iter().map(|upload| upload.path.as_str()).collect();
        if exists
            && super::replaced::may_mix(&paths)
            && let Some(commit) = self.client.newest(to)?
        {
            super::replaced::check(to, &self.client.files(to, &commit, control)?, &paths)?;
        }
        let large = self.client.large(to, &uploads)?;
        let name = to.to_string();
        control.emit(Event::Started(Stage { name: STAGE, subject: &[&name], total, unit: "files" }));
        let (mut lines, mut uploaded) = (vec![], 0);
        let summary = if options.message.is_empty() { "Upload with stable-worldmodel" } else { &options.message };
        lines.push(Line::new(&json!({"key": "header", "value": {"summary": summary, "description": ""}}), None));
        for (done, upload) in uploads.iter().enumerate() {
            control.check()?;
            if large.contains(&upload.path) {
                uploaded += self.client.send_large(to, upload, control)?;
                let value = json!({"path": upload.path, "algo": "sha256", "oid": upload.sha256, "size": upload.size});
                lines.push(Line::new(&json!({"key": "lfsFile", "value": value}), None));
            } else {
                let value = json!({"path": upload.path, "encoding": "base64", "content": ""});
                let file = Some((upload.local.clone(), upload.size));
                lines.push(Line::new(&json!({"key": "file", "value": value}), file));
            }
            control.progress(Progress { stage: STAGE, done: done + 1, total, unit: "files", metrics: &[] });
        }
        let (commit, page) = self.client.commit_files(to, lines)?;
        control.emit(Event::Finished { stage: STAGE, metrics: &[("files", total as f64)] });
        Ok(Pushed { pinned: to.at(&commit).to_string(), page, files: total, bytes, uploaded })
    }
}

impl Client {
    /// The commit of a branch; `None` if there is no such branch, as in a repository without a commit.
    fn newest(&self, uri: &HubUri) -> Result<Option<String>> {
        let url = self.revision(uri);
        let answer = self.send(Method::GET, &url, Body::default(), HeaderMap::new(), true)?;
        if answer.headers().get(ERROR_CODE).is_some_and(|code| code == "RevisionNotFound") {
            return Ok(None);
        }
        self.commit_of(&url, answer, uri).map(Some)
    }

    /// Makes a repository; returns false if it exists already.
    fn create(&self, to: &HubUri, private: bool) -> Result<bool> {
        let (owner, name) = to.repo.split_once('/').unwrap_or_default();
        let kind = if to.kind == RepoKind::Dataset { "dataset" } else { "model" };
        let url = format!("{}/api/repos/create", self.endpoint());
        let body = json!({"name": name, "organization": owner, "type": kind, "private": private});
        let answer = self.send(Method::POST, &url, json_body(&body), HeaderMap::new(), true)?;
        if answer.status() == reqwest::StatusCode::CONFLICT {
            return Ok(false);
        }
        self.check_write(&answer, to).map(|()| true)
    }

    /// Checks the status of an answer to a request that writes.
    fn check_write(&self, answer: &reqwest::Response, to: &HubUri) -> Result<()> {
        use reqwest::StatusCode;
        if [StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN].contains(&answer.status()) {
            let fix = "set HF_TOKEN to a token of your account with permission to write";
            return Err(Error::config(to.to_string(), "the hub does not let you write to it", fix));
        }
        self.check(answer, to)
    }

    /// The paths of files that the hub stores outside of Git.
    fn large(&self, to: &HubUri, uploads: &[Upload]) -> Result<Vec<String>> {
        #[derive(Deserialize)]
        struct Answer {
            files: Vec<Decided>,
        }
        #[derive(Deserialize)]
        #[serde(rename_all = "camelCase")]
        struct Decided {
            path: String,
            upload_mode: String,
        }
        let url = format!("{}/preupload/{}", self.api(to), super::client::encoded(&to.revision));
        let mut large = vec![];
        for uploads in uploads.chunks(MAX_NAMED) {
            let file = |upload: &Upload| json!({"path": upload.path, "size": upload.size, "sample": upload.sample});
            let body = json!({"files": uploads.iter().map(file).collect::<Vec<_>>()});
            let answer = self.send(Method::POST, &url, json_body(&body), HeaderMap::new(), true)?;
            self.check_write(&answer, to)?;
            let answer: Answer = parsed(&url, &whole(&url, answer)?)?;
            large.extend(answer.files.into_iter().filter(|file| file.upload_mode == "lfs").map(|file| file.path));
        }
        // A commit with a very large file inside would be refused.
        large.extend(uploads.iter().filter(|upload| upload.size > MAX_REGULAR).map(|upload| upload.path.clone()));
        Ok(large)
    }

    /// Sends a large file, unless the hub has it; returns the bytes that were sent.
    fn send_large(&self, to: &HubUri, upload: &Upload, control: &mut Control<'_>) -> Result<u64> {
        #[derive(Deserialize)]
        struct Answer {
            objects: Vec<Object>,
        }
        #[derive(Deserialize)]
        struct Object {
            #[serde(default)]
            actions: BTreeMap<String, Action>,
            error: Option<Value>,
        }
        let url = format!("{}.git/info/lfs/objects/batch", self.page(to));
        let object = json!({"oid": upload.sha256, "size": upload.size});
        let body = json!({
            "operation": "upload",
            "transfers": ["basic", "multipart"],
            "objects": [object],
            "hash_algo": "sha256",
            "ref": {"name": format!("refs/heads/{}", to.revision)},
        });
        let body = Body { content_type: LFS_TYPE, ..json_body(&body) };
        let accept = HeaderMap::from_iter([header("accept", LFS_TYPE)?]);
        let answer = self.send(Method::POST, &url, body, accept, true)?;
        self.check_write(&answer, to)?;
        let answer: Answer = parsed(&url, &whole(&url, answer)?)?;
        let Some(found) = answer.objects.into_iter().next() else {
            return Err(Error::corrupt(url, "its answer names no file", "check the address of the hub"));
        };
        if let Some(error) = found.error {
            let message = one_line(error["message"].as_str().unwrap_or("no reason given"));
            return Err(Error::external(format!("uploading {}", upload.path), message));
        }
        // Without an action, the hub has the file already.
        let Some(action) = found.actions.get("upload") else { return Ok(0) };
        let part_size = action.header.get("chunk_size").and_then(number);
        match part_size.filter(|size| *size > 0) {
            Some(part_size) => self.send_parts(upload, action, part_size, control)?,
            None if upload.size > MAX_WHOLE => {
                let problem = format!("has {} bytes, more than one request can send", upload.size);
                return Err(Error::config(upload.local.display().to_string(), problem, "split the dataset"));
            }
            None => {
                self.put(&action.href, upload, 0, upload.size, action.headers()?)?;
            }
        }
        if let Some(verify) = found.actions.get("verify") {
            let body = Body { content_type: LFS_TYPE, ..json_body(&object) };
            let answer = self.send(Method::POST, &verify.href, body, HeaderMap::new(), true)?;
            self.check_write(&answer, to)?;
        }
        Ok(upload.size)
    }

    /// Sends a file in parts of a size, whose addresses are the headers with numbers as names.
    fn send_parts(&self, upload: &Upload, action: &Action, size: u64, control: &mut Control<'_>) -> Result<()> {
        let numbered = |(name, value): (&String, &Value)| Some((name.parse::<u64>().ok()?, value.as_str()?.to_owned()));
        let addresses: BTreeMap<u64, String> = action.header.iter().filter_map(numbered).collect();
        if addresses.len() as u64 != upload.size.div_ceil(size) {
            let problem = format!("it asks for {} parts of {size} bytes of {}", addresses.len(), upload.size);
            return Err(Error::corrupt(named(&action.href), problem, "check the address of the hub"));
        }
        let mut parts = vec![];
        for (index, address) in addresses.values().enumerate() {
            control.check()?;
            let first = index as u64 * size;
            let last = first.saturating_add(size).min(upload.size);
            let etag = self.put(address, upload, first, last, HeaderMap::new())?;
            parts.push(json!({"partNumber": index + 1, "etag": etag}));
        }
        let body = Body { content_type: LFS_TYPE, ..json_body(&json!({"oid": upload.sha256, "parts": parts})) };
        let answer = self.send(Method::POST, &action.href, body, HeaderMap::new(), true)?;
        accepted(&answer, upload)
    }

    /// Sends a part of a file to a storage, without the token; returns its tag.
    fn put(&self, address: &str, upload: &Upload, first: u64, last: u64, headers: HeaderMap) -> Result<String> {
        let io = |error| reading(&upload.local, error);
        let mut file = File::open(&upload.local).map_err(io)?;
        file.seek(SeekFrom::Start(first)).map_err(io)?;
        let length = last.saturating_sub(first);
        let content = Content::Blocks(length, Box::new(blocks(file.take(length))));
        let body = Body { content, content_type: "application/octet-stream" };
        let answer = self.send(Method::PUT, address, body, headers, false);
        // A file that has become shorter ends the request early, which looks like a broken connection.
        upload.check_unchanged()?;
        let answer = answer?;
        accepted(&answer, upload)?;
        let tag = answer.headers().get("etag").and_then(|tag| tag.to_str().ok()).unwrap_or_default();
        Ok(tag.to_owned())
    }

    /// Makes the commit; returns its hash and its page.
    fn commit_files(&self, to: &HubUri, lines: Vec<Line>) -> Result<(String, String)> {
        #[derive(Deserialize)]
        #[serde(rename_all = "camelCase")]
        struct Answer {
            commit_oid: String,
            #[serde(default)]
            commit_url: String,
        }
        let url = format!("{}/commit/{}", self.api(to), super::client::encoded(&to.revision));
        let length = lines.iter().map(Line::length).sum();
        let content = if length <= MAX_HELD {
            let made = lines.iter().map(Line::bytes).collect::<std::io::Result<Vec<_>>>();
            Content::Bytes(made.map_err(|error| Error::external("reading the files of the commit", error))?.concat())
        } else {
            Content::Blocks(length, Box::new(lines.into_iter().map(|line| line.bytes().map(Bytes::from))))
        };
        let body = Body { content, content_type: "application/x-ndjson" };
        let answer = self.send(Method::POST, &url, body, HeaderMap::new(), true)?;
        self.check_write(&answer, to)?;
        let answer: Answer = parsed(&url, &whole(&url, answer)?)?;
        if !super::uri::is_commit(&answer.commit_oid) {
            return Err(Error::corrupt(
                url,
                "its answer has no commit",
                "check on the hub whether the files are there",
            ));
        }
        Ok((answer.commit_oid, one_line(&answer.commit_url)))
    }
}

/// The content of a file in blocks.
fn blocks(mut file: std::io::Take<File>) -> impl Iterator<Item = std::io::Result<Bytes>> {
    std::iter::from_fn(move || {
        let mut block = vec![];
        match file.by_ref().take(BLOCK).read_to_end(&mut block) {
            Ok(0) => None,
            read => Some(read.map(|_| block.into())),
        }
    })
}

/// The files to upload, with their paths in the repository.
fn uploads(from: &Path, to: &str, control: &mut Control<'_>) -> Result<Vec<Upload>> {
    let (mut found, mut left_out) = (vec![], 0);
    collect(from, to, &mut found, &mut left_out)?;
    if left_out > 0 {
        control.emit(Event::Log(&format!("{left_out} links, pipes and other special files are left out")));
    }
    if found.is_empty() {
        return Err(Error::config(from.display().to_string(), "has no files", "give a file, or a folder with files"));
    }
    if found.len() > MAX_FILES {
        let problem = format!("has more than {MAX_FILES} files");
        let fix = "convert the dataset to Lance or HDF5, which have few";
        return Err(Error::config(from.display().to_string(), problem, fix));
    }
    if let Some(folder) = super::uri::git_folder(found.iter().map(|(path, _)| path.as_str())) {
        let problem = format!("is or has a repository of Git ('{folder}/HEAD'), which readers refuse");
        return Err(Error::config(from.display().to_string(), problem, "give the folder without it"));
    }
    found.sort();
    let upload = |(path, local): (String, PathBuf)| {
        control.check()?;
        super::check_no_pointer(&local)?;
        let modified = std::fs::metadata(&local).and_then(|found| found.modified()).ok();
        let (sha256, size) = sha256(&local, control)?;
        let mut sample = vec![];
        let file = File::open(&local).map_err(|error| reading(&local, error))?;
        file.take(SAMPLE as u64).read_to_end(&mut sample).map_err(|error| reading(&local, error))?;
        Ok(Upload { local, path, size, modified, sha256, sample: STANDARD.encode(sample) })
    };
    found.into_iter().map(upload).collect()
}

/// Lists a file, or the files of a folder without hidden ones and links, and counts the latter.
fn collect(from: &Path, to: &str, found: &mut Vec<(String, PathBuf)>, left_out: &mut usize) -> Result<()> {
    let kind = std::fs::symlink_metadata(from).map_err(|error| reading(from, error))?;
    if kind.is_file() {
        let name = from.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let path = if to.is_empty() { name } else { to };
        if !super::uri::is_inside(path) {
            return Err(Error::config(from.display().to_string(), "has a name that the hub cannot store", "rename it"));
        }
        found.push((path.to_owned(), from.to_owned()));
    } else if !kind.is_dir() {
        *left_out += 1;
    }
    if !kind.is_dir() || found.len() > MAX_FILES {
        return Ok(());
    }
    for entry in std::fs::read_dir(from).map_err(|error| reading(from, error))? {
        let path = entry.map_err(|error| reading(from, error))?.path();
        let Some(name) = path.file_name().and_then(|name| name.to_str()).map(str::to_owned) else {
            return Err(Error::config(path.display().to_string(), "has a name that is not Unicode", "rename it"));
        };
        if !name.starts_with('.') {
            let inside = if to.is_empty() { name } else { format!("{to}/{name}") };
            collect(&path, &inside, found, left_out)?;
        }
    }
    Ok(())
}

fn reading(path: &Path, error: std::io::Error) -> Error {
    Error::io(path, "reading the file", error)
}

fn accepted(answer: &reqwest::Response, upload: &Upload) -> Result<()> {
    if answer.status().is_success() {
        return Ok(());
    }
    let problem = format!("the storage of the hub answered {}; run it again to continue", answer.status());
    Err(Error::external(format!("uploading {}", upload.path), problem))
}

fn number(value: &Value) -> Option<u64> {
    value.as_u64().or_else(|| value.as_str()?.parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_change_after_they_were_hashed_are_noticed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        std::fs::write(&path, [7; 9]).expect("a file");
        let uploads = uploads(&path, "", &mut Control::new()).expect("a file to upload");
        uploads[0].check_unchanged().expect("the same file");
        let later = SystemTime::now() + std::time::Duration::from_secs(2);
        std::fs::write(&path, [8; 9]).expect("other content");
        File::options().append(true).open(&path).and_then(|file| file.set_modified(later)).expect("a later time");
        let error = uploads[0].check_unchanged().expect_err("another file").to_string();
        assert!(error.contains("changed while it was uploaded"), "{error}");
    }

    #[test]
    fn hashing_a_file_can_be_stopped() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        std::fs::write(&path, vec![7; 3 << 20]).expect("a file");
        let mut checks = 0;
        let mut control = Control::new().with_poll(|| {
            checks += 1;
            if checks > 2 { Err(Error::Interrupted) } else { Ok(()) }
        });
        assert!(matches!(sha256(&path, &mut control), Err(Error::Interrupted)));
    }

    #[test]
    fn files_are_read_in_blocks() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a");
        let content: Vec<u8> = (0..BLOCK * 2 + 5).map(|i| (i % 251) as u8).collect();
        std::fs::write(&path, &content).expect("a file");
        let length = content.len() as u64 - 3;
        let read: Vec<Bytes> =
            blocks(File::open(&path).expect("a file").take(length)).collect::<std::io::Result<_>>().expect("blocks");
        assert_eq!(read.iter().map(|block| block.len() as u64).collect::<Vec<_>>(), [BLOCK, BLOCK, 2]);
        assert_eq!(read.concat(), content[..content.len() - 3]);
    }
}
