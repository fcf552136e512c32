//! A hub on this machine: repositories in memory, served by the protocol of the Hugging Face hub. Large files are redirected to a
//! second address, which stands for the storage of another host and must receive no token.

use base64::Engine as _;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::io::{BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard};

/// The token that may read everything and write.
pub(crate) const TOKEN: &str = "hf_of_the_test";
/// Files of at least this size are stored outside of Git.
const LARGE: usize = 1000;
/// The parts in which files of more than this size are sent.
const PART: usize = 40_000;

/// The state of the hub.
#[derive(Default)]
pub(crate) struct State {
    /// Repositories by `models/OWNER/NAME` or `datasets/OWNER/NAME`.
    pub repositories: BTreeMap<String, Repository>,
    /// Large files by hash, and the parts that were sent.
    objects: BTreeMap<String, Vec<u8>>,
    parts: BTreeMap<(String, usize), Vec<u8>>,
    /// The requests: method, path and range.
    pub requests: Vec<String>,
    /// The number of bytes after which the storage breaks the connection, once.
    pub break_after: Option<usize>,
    /// What the storage sends in place of a large file's content.
    pub wrong_content: bool,
    /// Sizes that the hub lists in place of those of files.
    pub listed: BTreeMap<String, u64>,
    /// What the hub lists in place of the hash of large files.
    pub wrong_oid: Option<String>,
    /// What the hub lists as the ids of small files in Git.
    pub git_ids: BTreeMap<String, String>,
    /// Whether the hub breaks every connection.
    pub down: bool,
    /// Whether the storage sends readers to another address of its own.
    pub moves: bool,
    /// The commit that the hub answers to an upload, in place of the one that it made.
    pub wrong_commit: Option<String>,
    /// Whether the hub sends bytes without an end for every file.
    pub endless: bool,
    /// The host to which the hub sends readers of its second page.
    pub next_host: Option<String>,
    /// The number of headers that the hub asks for with a file.
    pub upload_headers: usize,
    /// Whether files are sent as a whole, whatever their size.
    pub whole: bool,
    /// The process that uploads, and the most memory that it had at the end of an upload, in kB.
    pub uploader: Option<u32>,
    pub memory: u64,
}

/// A repository.
#[derive(Default)]
pub(crate) struct Repository {
    /// Commits, oldest first, each with all files.
    pub commits: Vec<BTreeMap<String, Vec<u8>>>,
    pub gated: bool,
    pub private: bool,
}

/// The hub and the addresses of its two servers.
pub(crate) struct HubServer {
    pub address: String,
    storage: String,
    state: Mutex<State>,
}

struct Request {
    method: String,
    path: String,
    headers: BTreeMap<String, String>,
    body: Vec<u8>,
}

struct Answer {
    status: &'static str,
    headers: Vec<(&'static str, String)>,
    body: Vec<u8>,
    /// Sends only so much of the body.
    breaks: Option<usize>,
    /// Repeats the body until the reader leaves.
    endless: bool,
}

impl HubServer {
    pub fn start() -> Arc<Self> {
        let listen = || TcpListener::bind("127.0.0.1:0").expect("an address");
        let (hub, storage) = (listen(), listen());
        let url = |listener: &TcpListener| format!("http://{}", listener.local_addr().expect("an address"));
        let server = Arc::new(Self { address: url(&hub), storage: url(&storage), state: Mutex::default() });
        for (listener, is_storage) in [(hub, false), (storage, true)] {
            let server = Arc::clone(&server);
            std::thread::spawn(move || {
                for stream in listener.incoming().flatten() {
                    let server = Arc::clone(&server);
                    std::thread::spawn(move || server.serve(stream, is_storage));
                }
            });
        }
        server
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("the state")
    }

    /// Adds a commit to a repository.
    pub fn commit(&self, repository: &str, files: &[(&str, &[u8])]) -> String {
        let mut state = self.state();
        let commits = &mut state.repositories.entry(repository.to_owned()).or_default().commits;
        commits.push(files.iter().map(|(name, bytes)| ((*name).to_owned(), bytes.to_vec())).collect());
        sha(repository, commits.len() - 1)
    }

    /// The files of the newest commit.
    pub fn newest(&self, repository: &str) -> BTreeMap<String, Vec<u8>> {
        let state = self.state();
        state.repositories.get(repository).and_then(|found| found.commits.last()).cloned().unwrap_or_default()
    }

    fn serve(&self, stream: TcpStream, is_storage: bool) {
        let mut reader = BufReader::new(stream.try_clone().expect("the connection"));
        let mut out = stream;
        while let Some(request) = read(&mut reader) {
            if self.state().down {
                return;
            }
            let answer = if is_storage { self.store(&request) } else { self.answer(&request) };
            let length = answer.body.len();
            if answer.endless {
                let _ = out.write_all(b"HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n");
                while out.write_all(&answer.body).is_ok() {}
                return;
            }
            let mut head = format!("HTTP/1.1 {}\r\ncontent-length: {length}\r\n", answer.status);
            for (name, value) in &answer.headers {
                head += &format!("{name}: {value}\r\n");
            }
            let sent = answer.breaks.unwrap_or(length).min(length);
            if out
                .write_all(format!("{head}\r\n").as_bytes())
                .and_then(|()| out.write_all(&answer.body[..sent]))
                .is_err()
            {
                return;
            }
            if sent < length {
                let _ = out.shutdown(std::net::Shutdown::Both);
                return;
            }
        }
    }

    /// The storage of large files, which is no part of the hub.
    fn store(&self, request: &Request) -> Answer {
        assert!(!request.headers.contains_key("authorization"), "the storage receives a token");
        let mut state = self.state();
        let range = request.headers.get("range").cloned().unwrap_or_default();
        state.requests.push(format!("storage {} {range}", request.method));
        let (path, part) = request.path.split_once('?').unwrap_or((&request.path, ""));
        let oid = path.trim_start_matches('/').to_owned();
        if request.method == "PUT" {
            if let Ok(part) = part.trim_start_matches("part=").parse() {
                state.parts.insert((oid, part), request.body.clone());
                return Answer { headers: vec![("etag", format!("\"{part}\""))], ..Answer::ok(vec![]) };
            }
            assert_eq!(hash(&request.body), oid);
            let process = state.uploader.map(|id| std::fs::read_to_string(format!("/proc/{id}/status")));
            if let Some(Ok(status)) = process {
                let most = status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.split_whitespace().next());
                state.memory = most.and_then(|most| most.parse().ok()).unwrap_or(0);
            }
            state.objects.insert(oid, request.body.clone());
            return Answer::ok(vec![]);
        }
        if let Some(name) = path.strip_prefix('/').filter(|_| state.moves && !part.starts_with("moved")) {
            let headers = vec![("location", format!("/{name}?moved"))];
            return Answer { status: "302 Found", headers, ..Answer::ok(vec![]) };
        }
        let Some(mut body) = state.objects.get(&oid).cloned() else { return Answer::error("404 Not Found", "") };
        if state.wrong_content {
            body.iter_mut().for_each(|byte| *byte ^= 1);
        }
        let from = range.strip_prefix("bytes=").and_then(|range| range.strip_suffix('-')?.parse::<usize>().ok());
        let status = if from.is_some() { "206 Partial Content" } else { "200 OK" };
        Answer { status, breaks: state.break_after.take(), ..Answer::ok(body.split_off(from.unwrap_or(0))) }
    }

    fn answer(&self, request: &Request) -> Answer {
        let mut state = self.state();
        state.requests.push(format!("{} {}", request.method, request.path));
        let token = request.headers.get("authorization").map(|value| value.trim_start_matches("Bearer ").to_owned());
        let may_write = token.as_deref() == Some(TOKEN);
        let (path, query) = request.path.split_once('?').unwrap_or((&request.path, ""));
        if path == "/api/repos/create" {
            return if may_write { state.create(&request.body) } else { Answer::error("401 Unauthorized", "") };
        }
        let Some((kind, repo, rest)) = route(path) else { return Answer::error("404 Not Found", "") };
        let name = format!("{kind}/{repo}");
        let Some(found) = state.repositories.get(&name) else { return Answer::error("404 Not Found", "RepoNotFound") };
        if found.private && !may_write {
            return Answer::error("401 Unauthorized", "RepoNotFound");
        }
        if found.gated && !may_write {
            return Answer::error("401 Unauthorized", "GatedRepo");
        }
        let commit_of = |revision: &str| match revision {
            "main" => found.commits.len().checked_sub(1),
            _ => {
                (0..found.commits.len()).find(|index| sha(&name, *index) == revision || revision == format!("v{index}"))
            }
        };
        let parts: Vec<&str> = rest.splitn(3, '/').collect();
        match (request.method.as_str(), &parts[..]) {
            ("GET", ["revision", revision]) => match commit_of(revision) {
                Some(index) => Answer::json(&json!({"id": repo, "sha": sha(&name, index)})),
                None => Answer::error("404 Not Found", "RevisionNotFound"),
            },
            ("GET", ["tree", revision]) => {
                let Some(index) = commit_of(revision) else {
                    return Answer::error("404 Not Found", "RevisionNotFound");
                };
                let host = state.next_host.clone().unwrap_or_default();
                page(&found.commits[index], &state, path, query, &format!("{}{host}", self.address))
            }
            ("GET", ["resolve", revision, file]) => {
                let Some(index) = commit_of(revision) else {
                    return Answer::error("404 Not Found", "RevisionNotFound");
                };
                let Some(bytes) = found.commits[index].get(&file.replace("%20", " ")).cloned() else {
                    return Answer::error("404 Not Found", "EntryNotFound");
                };
                state.send(bytes, &self.storage)
            }
            _ if !may_write => Answer::error("403 Forbidden", ""),
            ("POST", ["preupload", "main"]) => preupload(&request.body),
            ("POST", ["info", "lfs", "objects/batch"]) => {
                state.batch(&request.body, &self.storage, &self.address, &name)
            }
            ("POST", ["info", "lfs", rest]) => state.complete(rest, &request.body),
            ("POST", ["commit", "main"]) => state.commit(&request.body, &name, &self.address),
            _ => Answer::error("404 Not Found", ""),
        }
    }
}

/// Two files of a commit, and the address of the next ones.
fn page(files: &BTreeMap<String, Vec<u8>>, state: &State, path: &str, query: &str, address: &str) -> Answer {
    let page: usize = query.split('&').find_map(|pair| pair.strip_prefix("cursor=")?.parse().ok()).unwrap_or(0);
    let files: Vec<Value> = files.iter().map(|(path, bytes)| entry(path, bytes, state)).collect();
    let next = (2 * page + 2 < files.len())
        .then(|| format!("<{address}{path}?recursive=true&cursor={}>; rel=\"next\"", page + 1));
    let shown: Vec<&Value> = files.iter().skip(2 * page).take(2).collect();
    Answer { headers: next.map(|next| ("link", next)).into_iter().collect(), ..Answer::json(&json!(shown)) }
}

/// How each file is uploaded.
fn preupload(body: &[u8]) -> Answer {
    let body: Value = serde_json::from_slice(body).expect("JSON");
    let decided = body["files"].as_array().into_iter().flatten().map(|file| {
        let is_large = file["size"].as_u64().is_some_and(|size| size >= LARGE as u64);
        json!({"path": file["path"], "uploadMode": if is_large { "lfs" } else { "regular" }, "shouldIgnore": false})
    });
    Answer::json(&json!({"files": decided.collect::<Vec<_>>()}))
}

impl State {
    /// A file, or the address of the storage that has it.
    fn send(&mut self, bytes: Vec<u8>, storage: &str) -> Answer {
        if self.endless {
            return Answer { endless: true, ..Answer::ok(vec![0; 1 << 16]) };
        }
        if bytes.len() < LARGE {
            return Answer::ok(bytes);
        }
        let oid = hash(&bytes);
        self.objects.insert(oid.clone(), bytes);
        Answer { status: "302 Found", headers: vec![("location", format!("{storage}/{oid}"))], ..Answer::ok(vec![]) }
    }

    fn create(&mut self, body: &[u8]) -> Answer {
        let body: Value = serde_json::from_slice(body).expect("JSON");
        let text = |key: &str| body[key].as_str().unwrap_or_default().to_owned();
        let name = format!("{}s/{}/{}", text("type"), text("organization"), text("name"));
        if self.repositories.contains_key(&name) {
            return Answer::error("409 Conflict", "");
        }
        let private = body["private"].as_bool().unwrap_or_default();
        self.repositories.insert(name, Repository { private, ..Repository::default() });
        Answer::json(&json!({"url": "created"}))
    }

    /// Where a large file is sent; nothing if it is there.
    fn batch(&self, body: &[u8], storage: &str, address: &str, name: &str) -> Answer {
        let body: Value = serde_json::from_slice(body).expect("JSON");
        let objects = body["objects"].as_array().into_iter().flatten().map(|object| {
            let (oid, size) =
                (object["oid"].as_str().unwrap_or_default(), object["size"].as_u64().unwrap_or(0) as usize);
            if self.objects.contains_key(oid) {
                return json!({"oid": oid, "size": size});
            }
            let base = format!("{address}/{name}.git/info/lfs");
            let upload = if size > PART && !self.whole {
                let parts = (0..size.div_ceil(PART))
                    .map(|i| (format!("{:05}", i + 1), json!(format!("{storage}/{oid}?part={i}"))));
                let mut header: serde_json::Map<String, Value> = parts.collect();
                header.insert("chunk_size".to_owned(), json!(PART.to_string()));
                json!({"href": format!("{base}/complete"), "header": header})
            } else {
                let header: serde_json::Map<String, Value> =
                    (0..self.upload_headers).map(|index| (format!("x{index}"), json!("a"))).collect();
                json!({"href": format!("{storage}/{oid}"), "header": header})
            };
            let verify = json!({"href": format!("{base}/verify")});
            json!({"oid": oid, "size": size, "actions": {"upload": upload, "verify": verify}})
        });
        Answer::json(&json!({"transfer": "basic", "objects": objects.collect::<Vec<_>>()}))
    }

    fn complete(&mut self, what: &str, body: &[u8]) -> Answer {
        let body: Value = serde_json::from_slice(body).expect("JSON");
        let oid = body["oid"].as_str().unwrap_or_default().to_owned();
        if what == "complete" {
            let count = body["parts"].as_array().map_or(0, Vec::len);
            let whole: Vec<u8> =
                (0..count).flat_map(|i| self.parts.get(&(oid.clone(), i)).cloned().unwrap_or_default()).collect();
            assert_eq!(hash(&whole), oid, "the parts make the file");
            self.objects.insert(oid, whole);
            return Answer::json(&json!({}));
        }
        if self.objects.contains_key(&oid) { Answer::json(&json!({})) } else { Answer::error("404 Not Found", "") }
    }

    fn commit(&mut self, body: &[u8], name: &str, address: &str) -> Answer {
        let mut files = self.repositories[name].commits.last().cloned().unwrap_or_default();
        for line in body.split(|byte| *byte == b'\n').filter(|line| !line.is_empty()) {
            let line: Value = serde_json::from_slice(line).expect("a line of JSON");
            let value = &line["value"];
            let path = || value["path"].as_str().unwrap_or_default().to_owned();
            match line["key"].as_str() {
                Some("file") => {
                    let content = value["content"].as_str().unwrap_or_default();
                    let decoded = base64::engine::general_purpose::STANDARD.decode(content).expect("base64");
                    files.insert(path(), decoded);
                }
                Some("lfsFile") => {
                    let oid = value["oid"].as_str().unwrap_or_default();
                    files.insert(path(), self.objects[oid].clone());
                }
                key => assert_eq!(key, Some("header")),
            }
        }
        let commits = &mut self.repositories.get_mut(name).expect("a repository").commits;
        commits.push(files);
        let sha = self.wrong_commit.clone().unwrap_or_else(|| sha(name, commits.len() - 1));
        Answer::json(&json!({"success": true, "commitOid": sha, "commitUrl": format!("{address}/{name}/commit/{sha}")}))
    }
}

impl Answer {
    fn ok(body: Vec<u8>) -> Self {
        Self { status: "200 OK", headers: vec![], body, breaks: None, endless: false }
    }

    fn json(value: &Value) -> Self {
        Self {
            headers: vec![("content-type", "application/json".to_owned())],
            ..Self::ok(value.to_string().into_bytes())
        }
    }

    fn error(status: &'static str, code: &str) -> Self {
        let headers = if code.is_empty() { vec![] } else { vec![("x-error-code", code.to_owned())] };
        Self { status, headers, ..Self::ok(b"an error".to_vec()) }
    }
}

/// The kind, the repository and what follows, of an address of the API or of a page.
fn route(path: &str) -> Option<(&str, String, String)> {
    let path = path.strip_prefix('/')?;
    let (kind, rest) = match path.strip_prefix("api/") {
        Some(api) => api.split_once('/')?,
        None => match path.strip_prefix("datasets/") {
            Some(rest) => ("datasets", rest),
            None => ("models", path.strip_prefix("models/").unwrap_or(path)),
        },
    };
    let mut parts = rest.splitn(3, '/');
    let (owner, name, rest) = (parts.next()?, parts.next()?, parts.next()?);
    Some((kind, format!("{owner}/{}", name.trim_end_matches(".git")), rest.to_owned()))
}

fn entry(path: &str, bytes: &[u8], state: &State) -> Value {
    let size = state.listed.get(path).copied().unwrap_or(bytes.len() as u64);
    let git_id = state.git_ids.get(path).map_or("0", String::as_str);
    let mut entry = json!({"type": "file", "path": path, "size": size, "oid": git_id});
    if bytes.len() >= LARGE {
        let oid = state.wrong_oid.clone().unwrap_or_else(|| hash(bytes));
        entry["lfs"] = json!({"oid": oid, "size": bytes.len(), "pointerSize": 130});
    }
    entry
}

/// A hash that stands for a commit.
fn sha(repository: &str, index: usize) -> String {
    hash(format!("{repository} {index}").as_bytes())[..40].to_owned()
}

pub(crate) fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn read(reader: &mut impl std::io::BufRead) -> Option<Request> {
    let mut line = String::new();
    reader.read_line(&mut line).ok().filter(|count| *count > 0)?;
    let mut words = line.split_whitespace();
    let (method, path) = (words.next()?.to_owned(), words.next()?.to_owned());
    let mut headers = BTreeMap::new();
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).ok()?;
        match line.trim_end().split_once(": ") {
            Some((name, value)) => headers.insert(name.to_lowercase(), value.to_owned()),
            None => break,
        };
    }
    let length = headers.get("content-length").and_then(|length| length.parse().ok()).unwrap_or(0);
    let mut body = vec![0; length];
    reader.read_exact(&mut body).ok()?;
    Some(Request { method, path, headers, body })
}
