//! [`Client`]: requests to the hub, and its errors in words.

use super::pace::Pace;
use super::{HubFile, HubUri, RepoKind};
use crate::dataset::objects;
use bytes::Bytes;
use futures::future::{Either, select};
use reqwest::header::{
    AUTHORIZATION, CONTENT_LENGTH, CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue, LINK, LOCATION,
};
use reqwest::redirect::Policy;
use reqwest::{Method, Response, StatusCode};
use serde::Deserialize;
use serde_json::Value;
use std::future::Future;
use std::path::PathBuf;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use swm_core::run::Control;
use swm_core::text::one_line;
use swm_core::{Error, Result};
use url::Url;

/// The time to connect, and the time in which nothing is sent and nothing is answered.
const CONNECT: Duration = Duration::from_secs(10);
const READ: Duration = Duration::from_secs(60);
/// The bytes of a body that are sent at once.
const BLOCK: usize = 1 << 18;
/// The most redirections of a request.
const MAX_REDIRECTIONS: usize = 10;
/// The largest answer that is read as a whole, in bytes.
const MAX_ANSWER: usize = 256 << 20;
/// The most pages of a list of files, and the most files.
const MAX_PAGES: usize = 1000;
const MAX_LISTED: usize = 1_000_000;
/// The variable with the token.
const TOKEN: &str = "HF_TOKEN";
/// The header with the hub's kind of error, and that with its message.
pub(super) const ERROR_CODE: &str = "x-error-code";
const ERROR_MESSAGE: &str = "x-error-message";

/// A connection to the hub.
#[derive(Clone)]
pub(super) struct Client {
    http: reqwest::Client,
    endpoint: Url,
    token: Option<String>,
}

/// The body of a request.
#[derive(Default)]
pub(super) struct Body {
    pub content: Content,
    pub content_type: &'static str,
}

/// The content of a body.
pub(super) enum Content {
    Bytes(Vec<u8>),
    /// This many bytes, made while they are sent.
    Blocks(u64, Blocks),
}

/// The blocks of a body.
pub(super) type Blocks = Box<dyn Iterator<Item = std::io::Result<Bytes>> + Send>;

impl Default for Content {
    fn default() -> Self {
        Self::Bytes(vec![])
    }
}

impl Client {
    pub fn from_env() -> Result<Self> {
        let variable = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let endpoint = variable("HF_ENDPOINT").unwrap_or_else(|| super::cache::ENDPOINT.to_owned());
        let file = variable("HF_TOKEN_PATH").map(PathBuf::from).or_else(|| {
            let home = variable("HF_HOME").map(PathBuf::from);
            let home = home.or_else(|| Some(PathBuf::from(variable("HOME")?).join(".cache").join("huggingface")));
            Some(home?.join("token"))
        });
        let of_file = || std::fs::read_to_string(file.as_ref()?).ok();
        let token = variable(TOKEN).or_else(of_file).map(|token| token.trim().to_owned());
        Self::new(&endpoint, token.filter(|token| !token.is_empty()))
    }

    pub fn new(endpoint: &str, token: Option<String>) -> Result<Self> {
        let invalid = |problem: String| Error::config("HF_ENDPOINT", problem, "give the address of a hub, https://…");
        let parsed =
            Url::parse(endpoint.trim_end_matches('/')).map_err(|error| invalid(format!("{endpoint}: {error}")))?;
        if !["http", "https"].contains(&parsed.scheme()) {
            return Err(invalid(format!("{endpoint}: is no address of a web server")));
        }
        objects::provide_tls();
        // Redirections are followed in `send`: those of reqwest send the token to the second address of another host.
        let http = reqwest::Client::builder()
            .connect_timeout(CONNECT)
            .redirect(Policy::none())
            .user_agent(concat!("stable-worldmodel/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(|error| Error::external("making a client of the hub", error))?;
        Ok(Self { http, endpoint: parsed, token })
    }

    /// The address without a slash at its end.
    pub fn endpoint(&self) -> &str {
        self.endpoint.as_str().trim_end_matches('/')
    }

    /// The address of a repository's API, such as `…/api/datasets/OWNER/NAME`.
    pub fn api(&self, uri: &HubUri) -> String {
        let kind = if uri.kind == RepoKind::Dataset { "datasets" } else { "models" };
        format!("{}/api/{kind}/{}", self.endpoint(), uri.repo)
    }

    /// The address of a repository, such as `…/datasets/OWNER/NAME`.
    pub fn page(&self, uri: &HubUri) -> String {
        let kind = if uri.kind == RepoKind::Dataset { "datasets/" } else { "" };
        format!("{}/{kind}{}", self.endpoint(), uri.repo)
    }

    /// The commit of a revision.
    pub fn commit(&self, uri: &HubUri) -> Result<String> {
        let url = self.revision(uri);
        self.commit_of(&url, self.send(Method::GET, &url, Body::default(), HeaderMap::new(), true)?, uri)
    }

    /// The address of a revision.
    pub fn revision(&self, uri: &HubUri) -> String {
        format!("{}/revision/{}", self.api(uri), encoded(&uri.revision))
    }

    /// The commit that an answer about a revision states.
    pub fn commit_of(&self, url: &str, answer: Response, uri: &HubUri) -> Result<String> {
        #[derive(Deserialize)]
        struct Found {
            sha: String,
        }
        self.check(&answer, uri)?;
        let found: Found = parsed(url, &whole(url, answer)?)?;
        if super::uri::is_commit(&found.sha) {
            return Ok(found.sha);
        }
        Err(Error::corrupt(url, "its answer has no commit", "check the address of the hub"))
    }

    /// The files of a repository at a commit.
    pub fn files(&self, uri: &HubUri, commit: &str, control: &mut Control<'_>) -> Result<Vec<HubFile>> {
        #[derive(Deserialize)]
        struct Entry {
            #[serde(rename = "type")]
            kind: String,
            path: String,
            #[serde(default)]
            size: u64,
            lfs: Option<Lfs>,
            oid: Option<String>,
        }
        #[derive(Deserialize)]
        struct Lfs {
            oid: String,
            size: u64,
        }
        let mut url = format!("{}/tree/{commit}?recursive=true&expand=false", self.api(uri));
        let (mut files, mut read) = (vec![], 0);
        for _ in 0..MAX_PAGES {
            control.check()?;
            let (headers, bytes) = self.bytes(Method::GET, &url, Body::default(), uri)?;
            read += bytes.len();
            let entries: Vec<Entry> = parsed(&url, &bytes)?;
            for entry in entries.into_iter().filter(|entry| entry.kind == "file") {
                if !super::uri::is_inside(&entry.path) {
                    let problem = format!("it lists a file that no repository has: '{}'", entry.path.escape_debug());
                    return Err(Error::corrupt(&url, problem, "do not use this hub"));
                }
                let (size, sha256) = entry.lfs.map_or((entry.size, None), |lfs| {
                    (lfs.size, Some(lfs.oid.trim_start_matches("sha256:").to_ascii_lowercase()))
                });
                let git_id = entry.oid.filter(|id| sha256.is_none() && super::uri::is_commit(id));
                if let Some(hash) = sha256.as_ref().filter(|hash| !super::uri::is_sha256(hash)) {
                    let problem = format!("it lists '{}', which is no SHA-256 hash", hash.escape_debug());
                    return Err(Error::corrupt(&url, problem, "check the address of the hub (HF_ENDPOINT)"));
                }
                files.push(HubFile { path: entry.path, size, sha256, git_id });
            }
            match next_page(&headers) {
                Some(_) if files.len() > MAX_LISTED || read > MAX_ANSWER => break,
                Some(next) if self.is_own(&next) => url = next,
                Some(next) => {
                    let problem = format!("its list of files continues at another address: '{}'", next.escape_debug());
                    return Err(Error::corrupt(url, problem, "do not use this hub"));
                }
                None => {
                    let names = files.iter().map(|file: &HubFile| file.path.as_str());
                    if let Some(folder) = super::uri::git_folder(names) {
                        let problem =
                            format!("it lists a repository of Git, whose settings can start programs: '{folder}/HEAD'");
                        return Err(Error::corrupt(&url, problem, "do not use this repository"));
                    }
                    return Ok(files);
                }
            }
        }
        let problem = format!("its list of files has more than {MAX_PAGES} pages, or {MAX_LISTED} files");
        Err(Error::corrupt(url, problem, "name a smaller repository"))
    }

    /// Sends a request with the token; returns the headers and the body of the answer.
    pub fn bytes(&self, method: Method, url: &str, body: Body, uri: &HubUri) -> Result<(HeaderMap, Vec<u8>)> {
        let answer = self.send(method, url, body, HeaderMap::new(), true)?;
        self.check(&answer, uri)?;
        let headers = answer.headers().clone();
        Ok((headers, whole(url, answer)?))
    }

    /// Sends a request, and follows redirections. `trusted` adds the token to requests to the hub's own host.
    pub fn send(&self, method: Method, url: &str, body: Body, headers: HeaderMap, trusted: bool) -> Result<Response> {
        let (bytes, mut blocks) = match body.content {
            Content::Bytes(bytes) => (Bytes::from(bytes), None),
            Content::Blocks(length, blocks) => (Bytes::new(), Some((length, blocks))),
        };
        let is_repeatable = blocks.is_none();
        let mut url = url.to_owned();
        for _ in 0..=MAX_REDIRECTIONS {
            let mut request = self.http.request(method.clone(), &url).headers(headers.clone());
            let sent = (!body.content_type.is_empty()).then(Arc::<AtomicUsize>::default);
            if let Some(counted) = sent.clone() {
                let (length, blocks) = blocks.take().unwrap_or_else(|| (bytes.len() as u64, in_blocks(bytes.clone())));
                let blocks = blocks.inspect(move |_| _ = counted.fetch_add(1, Ordering::Relaxed));
                request = request.header(CONTENT_TYPE, body.content_type).header(CONTENT_LENGTH, length);
                request = request.body(reqwest::Body::wrap_stream(futures::stream::iter(blocks)));
            }
            if let Some(token) = self.token.as_ref().filter(|_| trusted && self.is_own(&url)) {
                request = request.header(AUTHORIZATION, authorization(token)?);
            }
            let to = url.clone();
            let answer = run(&url, async move { patiently(&to, sent.as_deref(), request.send()).await })?;
            match self.redirection(&method, &answer).filter(|_| is_repeatable) {
                Some(next) => url = next,
                None => return Ok(answer),
            }
        }
        Err(Error::external(
            named(&url),
            format!("more than {MAX_REDIRECTIONS} redirections; check the address of the hub"),
        ))
    }

    /// The address to which an answer sends a request. What is written stays at the hub's own host.
    fn redirection(&self, method: &Method, answer: &Response) -> Option<String> {
        let keeps_method = [StatusCode::TEMPORARY_REDIRECT, StatusCode::PERMANENT_REDIRECT].contains(&answer.status());
        let moves =
            [StatusCode::MOVED_PERMANENTLY, StatusCode::FOUND, StatusCode::SEE_OTHER].contains(&answer.status());
        let next = answer.url().join(answer.headers().get(LOCATION)?.to_str().ok()?).ok()?;
        let is_web = ["http", "https"].contains(&next.scheme());
        let follows = match *method {
            Method::GET => (keeps_method || moves) && is_web,
            _ => keeps_method && self.is_own(next.as_str()),
        };
        follows.then(|| next.into())
    }

    /// Whether an address belongs to the hub.
    fn is_own(&self, url: &str) -> bool {
        Url::parse(url).is_ok_and(|url| url.origin() == self.endpoint.origin())
    }

    /// Checks the status of an answer about a repository.
    pub fn check(&self, answer: &Response, uri: &HubUri) -> Result<()> {
        let status = answer.status();
        if status.is_success() {
            return Ok(());
        }
        let header = |name: &str| answer.headers().get(name).and_then(|value| value.to_str().ok()).unwrap_or_default();
        let (code, message) = (header(ERROR_CODE), one_line(header(ERROR_MESSAGE)));
        let page = self.page(uri);
        let login = match &self.token {
            None => format!("set {TOKEN} to a token of your account (the hub's settings make them)"),
            Some(_) => format!("check that the token in {TOKEN} may read it"),
        };
        let repository = uri.at("main").to_string();
        let fail = |problem: &str, fix: String| Err(Error::config(repository.clone(), problem, fix));
        match (code, status) {
            ("GatedRepo", _) => {
                fail("is gated: its owner asks readers to accept terms", format!("accept them at {page}, then {login}"))
            }
            ("RevisionNotFound", _) => {
                fail(&format!("has no revision '{}'", uri.revision), format!("{page} lists its branches and tags"))
            }
            ("EntryNotFound", _) => fail(&format!("has no '{}'", uri.path), format!("{page} lists its files")),
            ("RepoNotFound", _) | (_, StatusCode::NOT_FOUND) => {
                fail("does not exist, or is private", format!("check its name; {login}"))
            }
            (_, StatusCode::UNAUTHORIZED) => fail("does not exist, is private, or the token is wrong", login),
            (_, StatusCode::FORBIDDEN) => {
                fail("may not be accessed with this token", format!("check what the token in {TOKEN} may do"))
            }
            _ => {
                let words = if message.is_empty() { String::new() } else { format!(": {message}") };
                // The address of a storage may have a signature.
                Err(Error::external(
                    named(answer.url().as_str()),
                    format!("the hub answered {status}{words}; try again later"),
                ))
            }
        }
    }
}

/// The header with a token, which no log shows.
fn authorization(token: &str) -> Result<HeaderValue> {
    let mut value = HeaderValue::from_str(&format!("Bearer {token}"))
        .map_err(|_| Error::config(TOKEN, "the token has characters that no token has", "copy it again"))?;
    value.set_sensitive(true);
    Ok(value)
}

/// Runs a request on the threads of object stores.
pub(super) fn run<T: Send + 'static>(
    url: &str,
    request: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<T> {
    objects::block_on(request)?.unwrap_or_else(|| Err(Error::external(url, "the HTTP client panicked")))
}

/// Waits for a part of an answer, and gives up after a minute in which nothing came and none of the blocks that `sent` counts
/// was sent. Where nothing is sent, a message says after some seconds that there is no answer.
async fn patiently<T>(
    url: &str,
    sent: Option<&AtomicUsize>,
    part: impl Future<Output = reqwest::Result<T>>,
) -> Result<T> {
    let name = named(url);
    let answer = async {
        match sent {
            Some(_) => part.await,
            None => objects::answer_or_report(&name, READ, part).await,
        }
    };
    match unless_stalled(READ, sent, answer).await {
        Some(answer) => answer.map_err(|error| unreachable(url, &error)),
        None => {
            let problem = format!("nothing was received for {} s", READ.as_secs());
            Err(Error::external(named(url), format!("{problem}; check the network connection, then run it again")))
        }
    }
}

/// Waits for an answer; `None` after a time in which `sent` did not change.
async fn unless_stalled<T>(limit: Duration, sent: Option<&AtomicUsize>, answer: impl Future<Output = T>) -> Option<T> {
    let stalled = async {
        let count = || sent.map_or(0, |sent| sent.load(Ordering::Relaxed));
        let mut before = None;
        while before != Some(count()) {
            before = Some(count());
            tokio::time::sleep(limit).await;
        }
    };
    match select(pin!(answer), pin!(stalled)).await {
        Either::Left((answer, _)) => Some(answer),
        Either::Right(_) => None,
    }
}

/// The content of a body in blocks.
fn in_blocks(mut bytes: Bytes) -> Blocks {
    Box::new(std::iter::from_fn(move || {
        let block = bytes.split_to(bytes.len().min(BLOCK));
        (!block.is_empty()).then_some(Ok(block))
    }))
}

/// The hub in messages.
pub(super) fn named(url: &str) -> String {
    let host = Url::parse(url).ok().and_then(|url| url.host_str().map(str::to_owned)).unwrap_or_default();
    format!("the hub ({host})")
}

/// An error of a connection.
pub(super) fn unreachable(url: &str, error: &reqwest::Error) -> Error {
    // The innermost cause says what happened.
    let mut cause: &dyn std::error::Error = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    Error::external(named(url), format!("{cause}; check the network connection, then run it again"))
}

/// The next bytes of an answer.
pub(super) async fn next_chunk(url: &str, answer: &mut Response) -> Result<Option<Bytes>> {
    patiently(url, None, answer.chunk()).await
}

/// Reads the body of an answer.
pub(super) fn whole(url: &str, mut answer: Response) -> Result<Vec<u8>> {
    let label = url.to_owned();
    run(url, async move {
        let (mut bytes, mut pace) = (vec![], Pace::new());
        while let Some(chunk) = next_chunk(&label, &mut answer).await? {
            if bytes.len() + chunk.len() > MAX_ANSWER {
                return Err(Error::corrupt(label, "its answer is too long", "check the address of the hub"));
            }
            bytes.extend_from_slice(&chunk);
            if let Some(message) = pace.add(chunk.len(), &named(&label), None)? {
                tracing::warn!("{message}");
            }
        }
        Ok(bytes)
    })
}

pub(super) fn parsed<T: serde::de::DeserializeOwned>(url: &str, bytes: &[u8]) -> Result<T> {
    serde_json::from_slice(bytes).map_err(|error| {
        let problem = format!("its answer is not that of a hub ({error})");
        Error::corrupt(url, problem, "check the address of the hub (HF_ENDPOINT)")
    })
}

/// The address of the next page: `<URL>; rel="next"`.
fn next_page(headers: &HeaderMap) -> Option<String> {
    let links = headers.get(LINK)?.to_str().ok()?;
    let next = links.split(',').find(|link| link.contains("rel=\"next\""))?;
    Some(next.split_once('<')?.1.split_once('>')?.0.to_owned())
}

/// A revision or a path as a part of an address.
pub(super) fn encoded(name: &str) -> String {
    let keeps = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.~".contains(&byte);
    name.bytes().map(|byte| if keeps(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") }).collect()
}

/// A path as a part of an address, with its slashes.
pub(super) fn encoded_path(path: &str) -> String {
    path.split('/').map(encoded).collect::<Vec<_>>().join("/")
}

/// A JSON body.
pub(super) fn json_body(value: &Value) -> Body {
    Body { content: Content::Bytes(value.to_string().into_bytes()), content_type: "application/json" }
}

/// One header.
pub(super) fn header(name: &str, value: &str) -> Result<(HeaderName, HeaderValue)> {
    let invalid =
        || Error::external("the hub", format!("it asks for the header '{}', which is invalid", name.escape_debug()));
    let name = HeaderName::try_from(name).map_err(|_| invalid())?;
    Ok((name, HeaderValue::try_from(value).map_err(|_| invalid())?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_go_to_the_host_of_the_hub_only() {
        let client = Client::new("http://127.0.0.1:1234/", Some("hf_secret".to_owned())).expect("a client");
        assert!(client.is_own("http://127.0.0.1:1234/api/models/a/b"));
        let disguised = "http://127.0.0.1:1234@evil/a";
        for other in
            [disguised, "http://127.0.0.1:1235/a", "https://127.0.0.1:1234/a", "http://evil/127.0.0.1:1234", "nothing"]
        {
            assert!(!client.is_own(other), "{other}");
        }
        assert!(authorization("a\nb").is_err());
        assert!(!format!("{:?}", authorization("hf_secret").expect("a header")).contains("hf_secret"));
        for wrong in ["huggingface", "ftp://host"] {
            assert!(Client::new(wrong, None).is_err(), "{wrong}");
        }
    }

    #[test]
    fn uploads_last_as_long_as_blocks_are_sent() {
        let (limit, sent) = (Duration::from_millis(1), AtomicUsize::new(0));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        let upload = async {
            for _ in 0..5 {
                sent.fetch_add(1, Ordering::Relaxed);
                tokio::time::sleep(limit).await;
            }
            7
        };
        assert_eq!(runtime.block_on(async { unless_stalled(limit, Some(&sent), upload).await }), Some(7));
        let silent = std::future::pending::<()>();
        assert_eq!(runtime.block_on(async { unless_stalled(limit, Some(&sent), silent).await }), None);
        let blocks: Vec<usize> =
            in_blocks(vec![0; BLOCK + 1].into()).map(|block| block.expect("a block").len()).collect();
        assert_eq!(blocks, [BLOCK, 1]);
    }

    #[test]
    fn addresses_are_encoded() {
        assert_eq!(encoded("refs/pr/1"), "refs%2Fpr%2F1");
        assert_eq!(encoded_path("a b/ü.json"), "a%20b/%C3%BC.json");
        let mut headers = HeaderMap::new();
        headers.insert(LINK, HeaderValue::from_static("<http://h/a?cursor=1>; rel=\"next\""));
        assert_eq!(next_page(&headers).as_deref(), Some("http://h/a?cursor=1"));
    }
}
