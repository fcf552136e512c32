//! The server: it listens, checks every request, and ends when it is asked to.

use crate::access::{self, Access, Refusal, Token};
use crate::api::{self, Shared};
use crate::connections::{Connection, Connections};
use crate::{Lab, assets};
use axum::Router;
use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse as _, Response};
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use swm_core::{Error, Result};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{oneshot, watch};
use tower_service::Service as _;

/// The largest head of a request, in bytes.
const HEAD: usize = 32 << 10;
/// The largest number of headers of a request.
const HEADERS: usize = 64;
/// The time in which the head of a request has to arrive, and its body.
pub const PATIENCE: Duration = Duration::from_secs(10);
/// How often the server looks whether it is to stop.
const POLL: Duration = Duration::from_millis(50);

/// The longest wait for environments at the end.
const ENDING: Duration = Duration::from_secs(10);

/// Where the server listens.
#[derive(Clone)]
pub struct Options {
    /// The address.
    pub address: IpAddr,
    /// The port; 0 for any free one.
    pub port: u16,
    /// The token.
    pub token: Token,
}

/// A server that listens, and has not answered yet.
pub struct Server {
    runtime: tokio::runtime::Runtime,
    listener: TcpListener,
    address: SocketAddr,
    access: Access,
    lab: Lab,
}

/// Listens on an address.
///
/// # Errors
/// When the port is taken or the address is not one of this machine.
pub fn serve(lab: Lab, options: &Options) -> Result<Server> {
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    let runtime = builder.worker_threads(2).thread_name("swm-lab-io").enable_all().build();
    let runtime = runtime.map_err(|error| Error::external("starting the threads of the lab", error))?;
    let address = SocketAddr::new(options.address, options.port);
    let failed = |error: std::io::Error| {
        Error::config(address.to_string(), error.to_string(), "choose another --port, or --port 0 for any free one")
    };
    let listener = runtime.block_on(TcpListener::bind(address)).map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    let access =
        Access { token: options.token.clone(), is_local: options.address.is_loopback(), refusals: Arc::default() };
    // Compressed before the first request.
    assets::all();
    Ok(Server { runtime, listener, address, access, lab })
}

impl Server {
    /// The address with the token, to open in a browser.
    pub fn url(&self) -> String {
        format!("http://{}/{}/", self.address, self.access.token.as_str())
    }

    /// The address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests until `stop` is set; then sockets are closed, environments end and store what was recorded, and processes stop.
    pub fn run(self, stop: &AtomicBool) {
        let Self { runtime, listener, access, lab, .. } = self;
        let (stopping, stopped) = watch::channel(false);
        // Removed at the end, also under work that is not waited for.
        let scratch = tempfile::tempdir().ok();
        let folder = scratch.as_ref().map_or_else(std::env::temp_dir, |scratch| scratch.path().to_owned());
        let shared = Shared::new(lab, &folder, stopped);
        let (running, processes, lab) = (shared.running.clone(), shared.processes.clone(), Arc::clone(&shared.lab));
        let router = api::routes(shared);
        runtime.block_on(async {
            let connections = Connections::new();
            let mut polls = tokio::time::interval(POLL);
            loop {
                tokio::select! {
                    accepted = accept(&listener) => {
                        let Some(stream) = accepted else { continue };
                        tokio::spawn(connection(stream, access.clone(), router.clone(), connections.add()));
                    }
                    _ = polls.tick() => if stop.load(Ordering::Relaxed) { break },
                }
            }
            stopping.send_replace(true);
        });
        // Before all waiting, which a second Ctrl-C ends together with this program.
        processes.stop_all(&*lab.program);
        drop(router);
        // Requests that read a dataset meanwhile are not waited for.
        runtime.shutdown_timeout(Duration::from_secs(2));
        // Recorded episodes are committed when their environments end.
        let until = Instant::now() + ENDING;
        while running.count() > 0 && Instant::now() < until {
            std::thread::sleep(POLL);
        }
        processes.end(&*lab.program);
        drop(scratch);
    }
}

/// Waits for a connection. An error, such as too many open files, is waited out.
async fn accept(listener: &TcpListener) -> Option<TcpStream> {
    match listener.accept().await {
        Ok((stream, _)) => {
            stream.set_nodelay(true).ok();
            Some(stream)
        }
        Err(error) => {
            tracing::warn!("accepting a connection failed: {error}");
            tokio::time::sleep(POLL).await;
            None
        }
    }
}

/// Answers the requests of a connection, until it ends or is closed in favour of newer ones.
async fn connection(
    stream: TcpStream,
    access: Access,
    router: Router,
    (client, admitted): (Connection, oneshot::Receiver<()>),
) {
    let client = Arc::new(client);
    let service = service_fn(move |request: Request<Incoming>| {
        let (access, mut router, client) = (access.clone(), router.clone(), Arc::clone(&client));
        async move {
            let mut response = match check(&access, request) {
                Ok(request) => {
                    client.admit().await;
                    router.call(request).await.unwrap_or_else(|never| match never {})
                }
                Err(refusal) => refused(refusal),
            };
            access::add_headers(response.headers_mut());
            Ok::<_, Infallible>(response)
        }
    });
    let mut builder = http1::Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(PATIENCE).max_buf_size(HEAD).max_headers(HEADERS);
    let mut serving = pin!(builder.serve_connection(TokioIo::new(stream), service).with_upgrades());
    let served = tokio::select! {
        served = &mut serving => served,
        known = admitted => match known {
            Ok(()) => serving.await,
            Err(_) => return tracing::debug!("an unknown connection was closed, because newer ones came"),
        },
    };
    if let Err(error) = served {
        tracing::debug!("a connection failed: {error}");
    }
}

/// Returns a request without the token.
///
/// # Errors
/// The reason to refuse the request, which is logged.
fn check(access: &Access, request: Request<Incoming>) -> std::result::Result<Request<Body>, Refusal> {
    let checked = access.check(request.uri(), request.headers());
    let uri = checked.inspect_err(|refusal| {
        if let Some(left_out) = access.refusals.count(Instant::now()) {
            let others = if left_out == 0 { String::new() } else { format!(" ({left_out} others before)") };
            // The path is left out: it may hold the token.
            tracing::warn!("refused a {} request{others}: {}", request.method(), refusal.message().trim_end());
        }
    })?;
    let mut request = request.map(Body::new);
    *request.uri_mut() = uri;
    Ok(request)
}

/// The answer to a refused request, after which the connection is closed: a stranger holds none.
fn refused(refusal: Refusal) -> Response {
    let headers = [(header::CONTENT_TYPE, "text/plain; charset=utf-8"), (header::CONNECTION, "close")];
    (refusal.status(), headers, refusal.message()).into_response()
}
