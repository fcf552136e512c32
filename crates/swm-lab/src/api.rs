//! The routes of the lab, behind [`crate::access`]. They answer to `GET` and change nothing, but those that save episodes as a
//! new dataset, and start and stop trainings, collections and evaluations, by `POST`; all else that changes something goes through the socket of a session.

use crate::datasets::{self, Chosen, Datasets};
use crate::plans::{self, PlanSession};
use crate::processes::Processes;
use crate::requests;
use crate::serve::PATIENCE;
use crate::session::{self, Player, Running, Session, Setup, messages};
use crate::still::StillQuery;
use crate::{Lab, access, assets, reports, runs};
use axum::Router;
use axum::body::Body;
use axum::extract::{Path, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::json;
use sha1::{Digest as _, Sha1};
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{EnvChoice, Error, Result};
use tokio::sync::{Semaphore, watch};

/// Requests that read datasets or render at the same time; others wait.
const AT_ONCE: usize = 4;
/// The largest body of a request, in bytes: a hundred thousand episodes.
const MOST_BODY: usize = 1 << 20;
/// What RFC 6455 adds to the key of a handshake.
const HANDSHAKE: &str = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";

/// What all routes share.
#[derive(Clone)]
pub struct Shared {
    pub lab: Arc<Lab>,
    pub datasets: Arc<Datasets>,
    pub running: Running,
    pub processes: Processes,
    pub reports: Arc<reports::Known>,
    pub work: Arc<Semaphore>,
    /// The folder of files that are made for an answer.
    pub scratch: Arc<std::path::Path>,
    pub stop: watch::Receiver<bool>,
}

impl Shared {
    pub fn new(mut lab: Lab, scratch: &std::path::Path, stop: watch::Receiver<bool>) -> Self {
        Self {
            datasets: Arc::new(Datasets::new(lab.datasets.clone(), std::mem::take(&mut lab.sources))),
            lab: Arc::new(lab),
            running: Running::default(),
            processes: Processes::default(),
            reports: Arc::default(),
            work: Arc::new(Semaphore::new(AT_ONCE)),
            scratch: scratch.into(),
            stop,
        }
    }

    /// Runs work that blocks on a thread for it.
    async fn work<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Self) -> Result<T> + Send + 'static,
    ) -> Result<T, Failed> {
        self.within(&self.work, work).await
    }

    /// As [`Shared::work`], for work that reads a dataset of a folder or a source.
    async fn read<T: Send + 'static>(
        &self,
        folder: usize,
        work: impl FnOnce(&Self) -> Result<T> + Send + 'static,
    ) -> Result<T, Failed> {
        self.within(self.datasets.limit(folder).unwrap_or(&self.work), work).await
    }

    async fn within<T: Send + 'static>(
        &self,
        limit: &Arc<Semaphore>,
        work: impl FnOnce(&Self) -> Result<T> + Send + 'static,
    ) -> Result<T, Failed> {
        let permit = Arc::clone(limit).acquire_owned().await.ok();
        let shared = self.clone();
        let done = tokio::task::spawn_blocking(move || {
            // Work goes on after its client has gone, and counts until it ends.
            let _permit = permit;
            work(&shared)
        });
        let done = done.await;
        let done = done.unwrap_or_else(|error| Err(Error::external("answering a request of a page", error)));
        done.map_err(Failed)
    }

    /// The registered environment that a page names.
    fn env(&self, id: &str) -> Result<EnvChoice> {
        self.lab.envs.choose(id)
    }
}

/// An error as the answer to a request.
struct Failed(Error);

impl From<Error> for Failed {
    fn from(error: Error) -> Self {
        Self(error)
    }
}

impl IntoResponse for Failed {
    fn into_response(self) -> Response {
        let message = self.0.to_string();
        tracing::debug!("a request failed: {message}");
        (StatusCode::BAD_REQUEST, answer("application/json", json!({"error": message}).to_string())).into_response()
    }
}

/// The answer of a route.
type Answer = Result<Response, Failed>;

/// The routes.
pub fn routes(shared: Shared) -> Router {
    Router::new()
        .route("/api/envs", get(envs))
        .route("/api/env", get(env))
        .route("/api/wrappers", get(wrappers))
        .route("/api/still", get(still))
        .route("/api/command", get(command))
        .route("/api/live", get(open::<Player>))
        .route("/api/plan", get(open::<PlanSession>))
        .route("/api/planners", get(planners))
        .route("/api/status", get(status))
        .route("/api/datasets", get(list_datasets))
        .route("/api/names", get(names))
        .route("/api/summary", get(summary))
        .route("/api/episodes", get(episodes))
        .route("/api/rows", get(rows))
        .route("/api/values", get(values))
        .route("/api/frame", get(frame))
        .route("/api/video", get(video))
        .route("/api/distribution", get(distribution))
        .route("/api/doctor", get(doctor))
        .route("/api/save", post(save))
        .route("/api/runs", get(list_runs))
        .route("/api/lines", get(lines))
        .route("/api/reports", get(list_reports))
        .route("/api/report", get(report))
        .route("/api/processes", get(list_processes))
        .route("/api/start", post(start))
        .route("/api/stop", post(stop))
        .route("/api/bench", post(measured))
        .route("/", get(|headers: HeaderMap| async move { asset("", &headers) }))
        .route("/{file}", get(|Path(file): Path<String>, headers: HeaderMap| async move { asset(&file, &headers) }))
        .with_state(shared)
}

fn answer(kind: &'static str, body: impl Into<Body>) -> Response {
    ([(header::CONTENT_TYPE, HeaderValue::from_static(kind))], body.into()).into_response()
}

fn as_json(value: &impl Serialize) -> Answer {
    let text = serde_json::to_string(value).map_err(|error| Error::external("writing JSON", error))?;
    Ok(answer("application/json", text))
}

fn asset(path: &str, headers: &HeaderMap) -> Response {
    let Some(asset) = assets::find(path) else {
        return (StatusCode::NOT_FOUND, answer("text/plain", "there is no such page; open the lab's first page\n"))
            .into_response();
    };
    let accepted = headers.get(header::ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or_default();
    if accepted.contains("gzip") && !asset.gzip.is_empty() {
        let encoding = [(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"))];
        return (encoding, answer(asset.kind, asset.gzip.as_slice())).into_response();
    }
    answer(asset.kind, asset.bytes)
}

/// All registered environments, from the registry alone.
async fn envs(State(shared): State<Shared>) -> Answer {
    let rows = shared.lab.envs.rows.iter().map(|row| {
        let experts: Vec<&str> = row.experts.iter().map(|expert| expert.id).collect();
        json!({"id": row.id, "summary": row.summary, "experts": experts})
    });
    as_json(&rows.collect::<Vec<_>>())
}

/// The query of a request about an environment.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct EnvQuery {
    env: String,
    image: Option<usize>,
}

async fn env(State(shared): State<Shared>, Query(query): Query<EnvQuery>) -> Answer {
    let described = shared.work(move |shared| {
        let choice = shared.env(&query.env)?;
        Ok(messages::describe(&choice.entry, choice.env()?.spec()))
    });
    as_json(&described.await?)
}

/// The wrappers that a page may choose.
async fn wrappers(State(shared): State<Shared>) -> Answer {
    as_json(&shared.lab.wrapping.listed())
}

/// The models and the solvers that fit an environment, the solvers with their defaults.
async fn planners(State(shared): State<Shared>, Query(query): Query<EnvQuery>) -> Answer {
    let listed = shared.work(move |shared| {
        let env = shared.env(&query.env)?.env()?;
        Ok(plans::listed(&*shared.lab.planning, env.spec()))
    });
    as_json(&listed.await?)
}

async fn still(State(shared): State<Shared>, Query(query): Query<StillQuery>) -> Answer {
    let png = shared.work(move |shared| {
        let still = query.still()?;
        still.png(&mut *still.rendering.env(&shared.env(&query.env)?, &*shared.lab.wrapping)?)
    });
    Ok(answer("image/png", png.await?))
}

async fn command(State(shared): State<Shared>, Query(query): Query<StillQuery>) -> Answer {
    let text = shared.work(move |shared| {
        let still = query.still()?;
        still.command(still.rendering.env(&shared.env(&query.env)?, &*shared.lab.wrapping)?.spec())
    });
    Ok(answer("text/plain; charset=utf-8", text.await?))
}

/// Upgrades to the socket of a session: a live environment, or plans in one.
async fn open<S: Session>(State(shared): State<Shared>, Query(query): Query<EnvQuery>, mut request: Request) -> Answer {
    let setup = Setup { env: shared.env(&query.env)?, side: query.image.unwrap_or(crate::still::SIDE) };
    let headers = request.headers();
    let is = |name, expected: &str| {
        let value = headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok()).unwrap_or_default();
        value.split(',').any(|part| part.trim().eq_ignore_ascii_case(expected))
    };
    let is_handshake = is(header::UPGRADE, "websocket")
        && is(header::CONNECTION, "upgrade")
        && is(header::SEC_WEBSOCKET_VERSION, "13");
    let key = headers.get(header::SEC_WEBSOCKET_KEY).filter(|_| is_handshake).cloned().ok_or_else(|| {
        Error::config("the socket", "the request is no WebSocket handshake of version 13", "connect with a WebSocket")
    })?;
    let accept = STANDARD.encode(Sha1::new().chain_update(key.as_bytes()).chain_update(HANDSHAKE).finalize());
    let upgrade = hyper::upgrade::on(&mut request);
    tokio::spawn(async move {
        match upgrade.await {
            Ok(connection) => session::run::<S>(connection, shared.lab, setup, shared.running, shared.stop).await,
            Err(error) => tracing::debug!("a page left before its socket opened: {error}"),
        }
    });
    let mut response = StatusCode::SWITCHING_PROTOCOLS.into_response();
    let headers = response.headers_mut();
    headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
    headers.insert(header::CONNECTION, HeaderValue::from_static("upgrade"));
    let accept = HeaderValue::from_str(&accept).map_err(|error| Error::external("opening a socket", error))?;
    headers.insert(header::SEC_WEBSOCKET_ACCEPT, accept);
    Ok(response)
}

/// What runs: the number of live environments.
async fn status(State(shared): State<Shared>) -> Answer {
    as_json(&json!({"version": env!("CARGO_PKG_VERSION"), "environments": shared.running.count()}))
}

async fn list_datasets(State(shared): State<Shared>) -> Answer {
    as_json(&shared.work(|shared| Ok(shared.datasets.list())).await?)
}

/// The query of a request about a source.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SourceQuery {
    folder: usize,
}

/// The names of the datasets of a source.
async fn names(State(shared): State<Shared>, Query(query): Query<SourceQuery>) -> Answer {
    as_json(&shared.read(query.folder, move |shared| shared.datasets.names(query.folder)).await?)
}

/// What the list of datasets says of one.
async fn summary(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let found = shared.read(query.folder, move |shared| shared.datasets.summary(query.folder, &query.name));
    as_json(&found.await?)
}

/// The query of a request about an entry of a folder.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct EntryQuery {
    #[serde(default)]
    folder: usize,
    name: String,
    #[serde(default)]
    episode: usize,
    #[serde(default)]
    row: usize,
    #[serde(default)]
    column: String,
    #[serde(default)]
    entry: String,
    #[serde(default)]
    offset: u64,
    #[serde(default)]
    x: usize,
    #[serde(default)]
    y: usize,
}

async fn episodes(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let table =
        shared.read(query.folder, move |shared| datasets::episodes(&*shared.datasets.get(query.folder, &query.name)?));
    as_json(&table.await?)
}

async fn rows(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let rows = shared.read(query.folder, move |shared| {
        datasets::rows(&*shared.datasets.get(query.folder, &query.name)?, query.episode)
    });
    as_json(&rows.await?)
}

async fn frame(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let jpeg = shared.read(query.folder, move |shared| {
        let reader = shared.datasets.get(query.folder, &query.name)?;
        datasets::frame(&*reader, &query.column, query.episode, query.row)
    });
    Ok(answer("image/jpeg", jpeg.await?))
}

/// The smallest, the largest and the mean value of an element of a column in every episode.
async fn values(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let values = shared.read(query.folder, move |shared| {
        datasets::values(&*shared.datasets.get(query.folder, &query.name)?, &query.column, query.x)
    });
    as_json(&values.await?)
}

/// The video of an episode, to be stored by the browser.
async fn video(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let video = shared.read(query.folder, move |shared| {
        let reader = shared.datasets.get(query.folder, &query.name)?;
        datasets::video(reader, &query.column, query.episode, &shared.scratch)
    });
    let mut response = answer("video/mp4", video.await?);
    response.headers_mut().insert(header::CONTENT_DISPOSITION, HeaderValue::from_static("attachment"));
    Ok(response)
}

async fn distribution(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let found = shared.read(query.folder, move |shared| {
        let reader = shared.datasets.get(query.folder, &query.name)?;
        crate::distribution::distribution(&*reader, &query.column, [query.x, query.y])
    });
    as_json(&found.await?)
}

async fn doctor(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let found = shared.read(query.folder, move |shared| {
        shared.datasets.examine(query.folder, &query.name, &mut until_stopped(&shared.stop))
    });
    as_json(&found.await?)
}

/// Reads a body of JSON, up to [`MOST_BODY`]; `fields` names what it has.
async fn body<T: DeserializeOwned>(request: Request, fields: &str) -> Result<T, Failed> {
    let body = tokio::time::timeout(PATIENCE, axum::body::to_bytes(request.into_body(), MOST_BODY));
    let body = body.await.map_err(|_| Error::config("the body", "it did not arrive", "send it at once"))?;
    let too_long = |error| Error::config("the body", format!("{error}"), format!("send at most {MOST_BODY} bytes"));
    let malformed = |error| Error::config("the body", format!("{error}"), format!("send {fields}"));
    Ok(serde_json::from_slice(&body.map_err(too_long)?).map_err(malformed)?)
}

async fn save(State(shared): State<Shared>, request: Request) -> Answer {
    let chosen: Chosen = body(request, "folder, name, target, episodes and key").await?;
    let saved =
        shared.read(chosen.folder, move |shared| shared.datasets.save(chosen, &mut until_stopped(&shared.stop)));
    as_json(&json!({"episodes": saved.await?}))
}

async fn list_reports(State(shared): State<Shared>) -> Answer {
    let listed = shared.work(|shared| {
        let folders: Vec<_> = shared.lab.results.paths().iter().map(|path| path.display().to_string()).collect();
        let all = shared.reports.list(&*shared.lab.reports, &shared.lab.results);
        Ok(json!({"folders": folders, "reports": all}))
    });
    as_json(&listed.await?)
}

/// The page of results or of a study, under a policy of its own.
async fn report(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    let page = shared.work(move |shared| {
        let EntryQuery { folder, name, entry, .. } = query;
        reports::page(&*shared.lab.reports, &shared.lab.results, folder, &name, &entry)
    });
    let mut response = answer("text/html; charset=utf-8", page.await?);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(access::REPORT));
    Ok(response)
}

/// The families that can be trained, and the processes that were started.
async fn list_processes(State(shared): State<Shared>) -> Answer {
    let listed = shared.work(|shared| {
        let program = &*shared.lab.program;
        Ok(json!({"families": program.families(), "processes": shared.processes.list(program)}))
    });
    as_json(&listed.await?)
}

async fn start(State(shared): State<Shared>, request: Request) -> Answer {
    let wanted: requests::Request = body(request, "the command train, collect or evaluate, and its fields").await?;
    let started = shared.work(move |shared| shared.processes.start(&*shared.lab.program, wanted.order(&shared.lab)?));
    started.await?;
    as_json(&json!({}))
}

/// The body of a request to stop a process.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Stopped {
    kind: requests::Kind,
    name: String,
}

async fn stop(State(shared): State<Shared>, request: Request) -> Answer {
    let Stopped { kind, name } = body(request, "kind and name").await?;
    shared.work(move |shared| shared.processes.stop(&*shared.lab.program, kind, &name)).await?;
    as_json(&json!({}))
}

/// Hands what the page of a benchmark measured to the benchmark.
async fn measured(State(shared): State<Shared>, request: Request) -> Answer {
    let given = body(request, "what was measured").await?;
    let none = || Error::config("measurements", "this is no benchmark", "run `swm bench lab`");
    shared.lab.measured.as_ref().ok_or_else(none)?.send(given).ok();
    as_json(&json!({}))
}

/// Stops work when the lab ends.
fn until_stopped(stop: &watch::Receiver<bool>) -> Control<'_> {
    Control::new().with_poll(|| if *stop.borrow() { Err(Error::Interrupted) } else { Ok(()) })
}

async fn list_runs(State(shared): State<Shared>) -> Answer {
    let found = shared.work(|shared| {
        let folders: Vec<_> = shared.lab.runs.paths().iter().map(|path| path.display().to_string()).collect();
        Ok(json!({"folders": folders, "runs": runs::list(&shared.lab.runs)}))
    });
    as_json(&found.await?)
}

async fn lines(State(shared): State<Shared>, Query(query): Query<EntryQuery>) -> Answer {
    as_json(&shared.work(move |shared| runs::lines(&shared.lab.runs, query.folder, &query.name, query.offset)).await?)
}
