//! Downloads and caching of Hugging Face files, with a server on the loopback interface.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use swm_models::weights::hub::Hub;

/// A safetensors file without tensors.
const FILE: &[u8] = b"\x08\0\0\0\0\0\0\0{}      ";

/// What a server sends that asks for something else.
const PAGE: &[u8] = b"<html>sign in first</html>";

/// Serves [`FILE`] as `model.safetensors` of the repository `owner/name`. Returns the address of the server and the
/// counter of its requests.
fn serve() -> (String, Arc<AtomicUsize>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("binding a port");
    let address = format!("http://{}", listener.local_addr().expect("reading the local address"));
    let requests = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&requests);
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.expect("accepting a connection");
            let mut lines = BufReader::new(stream.try_clone().expect("cloning the socket")).lines();
            let mut next = || lines.next().and_then(Result::ok).unwrap_or_default();
            let request = next();
            while !next().is_empty() {}
            count.fetch_add(1, Ordering::Relaxed);
            let served = |name: &str| request.contains(&format!("/owner/name/resolve/main/{name} "));
            let (status, body) = match () {
                () if served("model.safetensors") => ("206 Partial Content", FILE),
                () if served("page.safetensors") || served("page.bin") => ("206 Partial Content", PAGE),
                () => ("404 Not Found", &b""[..]),
            };
            let status = if request.starts_with("HEAD") {
                status.replace("206 Partial Content", "200 OK")
            } else {
                status.to_owned()
            };
            let range = format!("Content-Range: bytes 0-{}/{}\r\n", body.len().max(1) - 1, body.len());
            let head = format!(
                "HTTP/1.1 {status}\r\nContent-Length: {}\r\nETag: \"1\"\r\nLast-Modified: Sat, 01 Aug 2026 00:00:00 GMT\r\n{}Connection: close\r\n\r\n",
                body.len(),
                if request.starts_with("GET") { &range } else { "" },
            );
            stream.write_all(head.as_bytes()).expect("sending an answer");
            if request.starts_with("GET") {
                stream.write_all(body).expect("sending an answer");
            }
        }
    });
    (address, requests)
}

#[test]
fn files_are_downloaded_once() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (address, requests) = serve();
    let hub = Hub::at(&address, folder.path());
    let path = hub.fetch("owner/name", "model.safetensors").expect("downloading the served file");
    assert_eq!(std::fs::read(&path).expect("reading the cached file"), FILE);
    assert!(path.ends_with("models--owner--name/snapshots/main/model.safetensors"), "{}", path.display());
    let before = requests.load(Ordering::Relaxed);
    assert_eq!(hub.fetch("owner/name", "model.safetensors").expect("finding the cached file"), path);
    assert_eq!(requests.load(Ordering::Relaxed), before, "a cached file needs no further request");
    let missing = hub.fetch("owner/name", "other.safetensors").expect_err("a missing file").to_string();
    assert!(missing.contains("no such object"), "{missing}");
}

#[test]
fn answers_that_are_no_weights_are_refused_and_leave_nothing() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (address, _) = serve();
    let hub = Hub::at(&address, folder.path());
    for file in ["page.safetensors", "page.bin"] {
        let message = hub.fetch("owner/name", file).expect_err("a page is no file of weights").to_string();
        assert!(message.contains("26 bytes"), "{message}");
    }
    let left = std::fs::read_dir(folder.path().join("models--owner--name/snapshots/main")).expect("listing the cache");
    assert_eq!(left.count(), 0);
}

#[test]
fn names_that_lead_out_of_the_cache_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (address, requests) = serve();
    let hub = Hub::at(&address, &folder.path().join("cache"));
    for file in ["", ".", "..", "../../x", "/etc/passwd", "a//b", "a/../b", "a\\b", "a\0b"] {
        let message = hub.fetch("owner/name", file).expect_err("an invalid name").to_string();
        assert!(message.contains("file"), "{file}: {message}");
    }
    for repo in ["../name", "owner/name@../x", "owner/name@"] {
        hub.fetch(repo, "model.safetensors").expect_err("an invalid repository");
    }
    assert_eq!(requests.load(Ordering::Relaxed), 0);
    assert_eq!(std::fs::read_dir(folder.path()).expect("listing").count(), 0);
}

#[test]
fn unreachable_hub_error_names_the_fix() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    // The top-level domain `invalid` is reserved and never resolves.
    let hub = Hub::at("http://hub.invalid", folder.path());
    let message = hub.fetch("owner/name", "model.safetensors").expect_err("an unreachable hub").to_string();
    assert!(message.contains("check the network connection") && message.contains("give the file's path"), "{message}");
}
