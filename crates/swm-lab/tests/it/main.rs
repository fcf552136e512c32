//! Tests of the lab over loopback: what it answers, what it refuses, and that it lives on.
#![allow(missing_docs, reason = "a test crate has no public items")]

mod data;
mod live;
mod planning;
mod plans;
mod processes;
mod refusals;
mod rendering;
mod reports;
mod sources;

use serde_json::Value;
use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use swm_core::policy::ExpertPolicy;
use swm_core::{EnvEntry, Policy, Result};
use swm_eval::World;
use swm_lab::folders::Folders;
use swm_lab::sources::Source;
use swm_lab::{Lab, Options, Token, serve};
use tokio_tungstenite::tungstenite::WebSocket;
use tokio_tungstenite::tungstenite::protocol::{Message, Role};

pub const TOKEN: &str = "token-of-the-tests";
/// A test that hangs fails after this time.
const PATIENCE: Duration = Duration::from_secs(60);

/// A lab in a temporary folder, which ends with this value.
pub struct TestLab {
    pub home: tempfile::TempDir,
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// The first expert, whatever the name.
pub fn expert(entry: &EnvEntry, _: &str, world: &World) -> Result<Box<dyn Policy>> {
    Ok(Box::new(ExpertPolicy::new(world.spec(), vec![(entry.experts[0].make)()])))
}

impl TestLab {
    pub fn start() -> Self {
        Self::with(vec![])
    }

    /// A lab with datasets at URIs.
    pub fn with(sources: Vec<Source>) -> Self {
        let home = tempfile::tempdir().expect("a folder");
        let lab = Lab {
            envs: &swm_envs::ENVS,
            wrapping: Box::new(rendering::Registered),
            policy: expert,
            planning: Box::new(planning::Simulated),
            program: Box::new(processes::Shell),
            reports: Box::new(reports::Files),
            results: Folders::new(vec![home.path().to_owned()]),
            datasets: Folders::new(vec![home.path().join("datasets")]),
            sources,
            runs: Folders::new(vec![home.path().join("checkpoints")]),
            threads: 1,
            measured: None,
        };
        let token = Token::parse(TOKEN).expect("a token");
        let options = Options { address: IpAddr::V4(Ipv4Addr::LOCALHOST), port: 0, token };
        let server = serve(lab, &options).expect("a free port");
        let (address, stop) = (server.address(), Arc::<AtomicBool>::default());
        assert_eq!(server.url(), format!("http://{address}/{TOKEN}/"));
        let stopped = Arc::clone(&stop);
        let thread = Some(std::thread::spawn(move || server.run(&stopped)));
        Self { home, address, stop, thread }
    }

    pub fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).expect("the lab listens");
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        stream
    }

    /// Sends a request with these headers; returns the status and the body.
    pub fn request(&self, path: &str, headers: &[(&str, &str)]) -> (u16, Vec<u8>) {
        let mut stream = self.connect();
        let mut head = format!("GET {path} HTTP/1.1\r\nConnection: close\r\n");
        for (name, value) in headers {
            let _ = write!(head, "{name}: {value}\r\n");
        }
        stream.write_all(format!("{head}\r\n").as_bytes()).expect("sending");
        let mut answer = vec![];
        stream.read_to_end(&mut answer).expect("an answer");
        let end = answer.windows(4).position(|part| part == b"\r\n\r\n").expect("the end of the head");
        let status = String::from_utf8_lossy(&answer[9..12]).parse().expect("a status");
        (status, answer[end + 4..].to_vec())
    }

    pub fn host(&self) -> String {
        self.address.to_string()
    }

    /// Sends a request with the token, as a page does.
    pub fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.request(&format!("/{TOKEN}/{path}"), &[("Host", &self.host())])
    }

    /// Sends a body with the token, as a page does; returns the status and the answer.
    pub fn post(&self, path: &str, body: &str) -> (u16, String) {
        let mut stream = self.connect();
        let (host, length) = (self.host(), body.len());
        let head = format!(
            "POST /{TOKEN}/{path} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nConnection: close\r\n\
             Content-Length: {length}\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).expect("sending");
        // The server may answer before it has read a body that is too long.
        stream.write_all(body.as_bytes()).ok();
        let mut answer = vec![];
        stream.read_to_end(&mut answer).ok();
        let answer = String::from_utf8_lossy(&answer).into_owned();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
        (head.get(9..12).and_then(|status| status.parse().ok()).unwrap_or_default(), body.to_owned())
    }

    /// The JSON of a successful request.
    pub fn json(&self, path: &str) -> Value {
        let (status, body) = self.get(path);
        let text = String::from_utf8_lossy(&body).into_owned();
        assert_eq!(status, 200, "{path}: {text}");
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{path}: {error}: {text}"))
    }

    /// Opens the socket of an environment.
    pub fn live(&self, env: &str) -> Live {
        self.session("live", env)
    }

    /// Opens a socket.
    pub fn session(&self, route: &str, env: &str) -> Live {
        let mut stream = self.connect();
        let host = self.host();
        let head = format!(
            "GET /{TOKEN}/api/{route}?env={env}&image=32 HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nUpgrade: websocket\r\n\
             Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).expect("sending");
        let mut answer = vec![];
        while !answer.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).expect("an answer");
            answer.push(byte[0]);
        }
        let answer = String::from_utf8_lossy(&answer).to_lowercase();
        assert!(answer.starts_with("http/1.1 101"), "{answer}");
        // The example of RFC 6455.
        assert!(answer.contains("sec-websocket-accept: s3pplmbitxaq9kygzzhzrbk+xoo="), "{answer}");
        Live { socket: WebSocket::from_raw_socket(stream, Role::Client, None) }
    }

    /// Waits until this many environments run.
    pub fn wait_for_environments(&self, count: u64) {
        let until = std::time::Instant::now() + PATIENCE;
        while self.json("api/status")["environments"] != count {
            assert!(std::time::Instant::now() < until, "other than {count} environments run");
            std::thread::yield_now();
        }
    }
}

impl Drop for TestLab {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || std::thread::panicking(), "the lab panicked");
    }
}

/// What the socket of an environment sends.
pub enum Received {
    Frame(Value, Vec<u8>),
    Reply(Value),
    Closed,
}

/// The page's end of a socket.
pub struct Live {
    pub socket: WebSocket<TcpStream>,
}

impl Live {
    pub fn send(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).expect("sending");
    }

    pub fn receive(&mut self) -> Received {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => return Received::Reply(serde_json::from_str(&text).expect("JSON")),
                Ok(Message::Binary(bytes)) => {
                    let size = u32::from_le_bytes(bytes[..4].try_into().expect("four bytes")) as usize;
                    let header = serde_json::from_slice(&bytes[4..4 + size]).expect("JSON");
                    return Received::Frame(header, bytes[4 + size..].to_vec());
                }
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => {}
                Ok(Message::Close(_)) | Err(_) => return Received::Closed,
            }
        }
    }

    /// Receives until a reply of this type, and says that frames were shown.
    pub fn reply(&mut self, kind: &str) -> Value {
        loop {
            match self.receive() {
                Received::Reply(reply) if reply["type"] == kind => return reply,
                Received::Reply(reply) => assert_ne!(reply["type"], "failed", "{reply}"),
                Received::Frame(..) => self.send(&serde_json::json!({"type": "shown"})),
                Received::Closed => panic!("the socket closed before '{kind}'"),
            }
        }
    }

    /// Receives until a frame whose header satisfies a condition, and says that frames were shown.
    pub fn frame(&mut self, wanted: impl Fn(&Value) -> bool) -> (Value, Vec<u8>) {
        loop {
            match self.receive() {
                Received::Frame(header, jpeg) => {
                    self.send(&serde_json::json!({"type": "shown"}));
                    if wanted(&header) {
                        return (header, jpeg);
                    }
                }
                Received::Reply(reply) => assert_ne!(reply["type"], "failed", "{reply}"),
                Received::Closed => panic!("the socket closed before the frame"),
            }
        }
    }
}
