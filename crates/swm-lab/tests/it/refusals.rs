//! What the lab refuses: other hosts, origins and tokens, paths outside its folders, other methods, and long heads.

use super::{TOKEN, TestLab};
use std::fs;
use std::io::{Read as _, Write as _};

#[test]
fn foreign_hosts_origins_and_tokens_are_refused() {
    let lab = TestLab::start();
    let (host, path) = (lab.host(), format!("/{TOKEN}/api/envs"));
    let own = format!("http://{host}");
    let status = |path: &str, headers: &[(&str, &str)]| lab.request(path, headers).0;
    assert_eq!(status(&path, &[("Host", &host), ("Origin", &own)]), 200);
    assert_eq!(status(&path, &[("Host", "evil.example")]), 421);
    assert_eq!(status(&path, &[("Host", &host), ("Origin", "http://evil.example")]), 403);
    assert_eq!(status(&path, &[("Host", &host), ("Sec-Fetch-Site", "cross-site")]), 403);
    for wrong in ["/", "/api/envs", "/wrong-token-of-the-tests/api/envs", &format!("/{}/api/envs", &TOKEN[1..])] {
        assert_eq!(status(wrong, &[("Host", &host)]), 403, "{wrong}");
    }
    // A socket is refused as any request is: browsers do not apply the policy of same origin to it.
    let socket =
        [("Host", host.as_str()), ("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Version", "13")];
    let socket =
        |origin| [&socket[..], &[("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ=="), ("Origin", origin)]].concat();
    assert_eq!(status(&format!("/{TOKEN}/api/live?env=swm/PushT-v1"), &socket("http://evil.example")), 403);
    assert_eq!(status(&format!("/{TOKEN}/api/live?env=swm/PushT-v1"), &[("Host", &host)]), 400);
    assert_eq!(status(&path, &[("Host", &host)]), 200, "the lab lives");
}

#[test]
fn paths_outside_the_folders_are_errors() {
    let lab = TestLab::start();
    let secret = lab.home.path().join("secret/train.jsonl");
    fs::create_dir_all(lab.home.path().join("checkpoints")).expect("a folder");
    fs::create_dir_all(secret.parent().expect("a parent")).expect("a folder");
    fs::write(&secret, "{\"loss\": 1}\n").expect("a file");
    std::os::unix::fs::symlink(lab.home.path().join("secret"), lab.home.path().join("checkpoints/link"))
        .expect("a link");
    let absolute = secret.parent().expect("a parent").display().to_string();
    for name in ["../secret", "..%2Fsecret", "link", "%2e%2e/secret", "", ".", &absolute, "a%00b"] {
        for route in ["lines", "episodes", "rows", "values", "frame", "video", "distribution", "report"] {
            let (status, body) = lab.get(&format!("api/{route}?name={name}"));
            assert_eq!(status, 400, "{route} {name}: {}", String::from_utf8_lossy(&body));
        }
    }
    for path in ["../Cargo.toml", "..%2f..%2fetc%2fpasswd", "/etc/passwd", "index.html/../../x", "%2e%2e%2fx"] {
        assert_eq!(lab.get(path).0, 404, "{path}");
    }
    for env in ["module:Env-v0", "os:system", "CartPole-v1", "../x", ""] {
        for route in ["env", "still", "command", "live"] {
            assert_eq!(lab.get(&format!("api/{route}?env={env}")).0, 400, "{route} {env}");
        }
    }
    for query in [
        "view=depths",
        "view=$(ls)",
        "view=;ls:depth",
        "wrappers=$(ls)",
        "image=100000",
        "image=0",
        "image=-1",
        "pin=agent.color=1",
        "pin=x",
        "seed=-1",
        "variation=nothing",
        "shell=1",
    ] {
        for route in ["still", "command"] {
            assert_eq!(lab.get(&format!("api/{route}?env=swm/PushT-v1&{query}")).0, 400, "{route} {query}");
        }
    }
}

#[test]
fn other_methods_and_long_heads_are_refused() {
    let lab = TestLab::start();
    let host = lab.host();
    let status = |request: String| {
        let mut stream = lab.connect();
        // A server may close the connection before it has read everything.
        stream.write_all(request.as_bytes()).ok();
        let mut answer = vec![];
        stream.read_to_end(&mut answer).ok();
        String::from_utf8_lossy(answer.get(9..12).unwrap_or_default()).into_owned()
    };
    for method in ["POST", "PUT", "DELETE", "OPTIONS"] {
        let request = format!(
            "{method} /{TOKEN}/api/envs HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
        );
        assert_eq!(status(request), "405", "{method}");
    }
    let long = format!("GET /{TOKEN}/api/envs HTTP/1.1\r\nHost: {host}\r\nX: {}\r\n\r\n", "x".repeat(1 << 20));
    assert!(["431", ""].contains(&status(long).as_str()));
    let many: String = (0..200).map(|i| format!("X-{i}: 1\r\n")).collect();
    assert!(["431", ""].contains(&status(format!("GET /{TOKEN}/ HTTP/1.1\r\nHost: {host}\r\n{many}\r\n")).as_str()));
    assert_eq!(lab.post("api/bench", "{}").0, 400, "only a benchmark takes measurements");
    assert_eq!(status("\0\u{1}garbage\r\n\r\n".to_owned()), "400");
    assert_eq!(lab.get("api/envs").0, 200, "the lab lives");
}

#[test]
fn connections_without_the_token_are_not_held() {
    let lab = TestLab::start();
    // More connections than the lab holds; each sends many requests at once and reads no answer.
    let requests = format!("GET /x/ HTTP/1.1\r\nHost: {}\r\n\r\n", lab.host()).repeat(2000);
    let connections: Vec<_> = (0..300)
        .map(|_| {
            let mut stream = lab.connect();
            stream.write_all(requests.as_bytes()).ok();
            stream
        })
        .collect();
    assert_eq!(lab.get("api/envs").0, 200, "the lab answers while they are open");
    let mut answer = vec![];
    (&connections[0]).read_to_end(&mut answer).ok();
    assert!(String::from_utf8_lossy(&answer).matches("HTTP/1.1 403").count() <= 1, "an answer ends the connection");
}

#[test]
fn half_open_connections_delay_no_answer() {
    let lab = TestLab::start();
    let half = |number: usize| {
        let mut stream = lab.connect();
        if number % 2 == 1 {
            stream.write_all(format!("GET /{TOKEN}/api/envs HTTP/1.1\r\nHo").as_bytes()).expect("sending");
        }
        stream
    };
    let mut connections: Vec<_> = (0..300).map(half).collect();
    assert_eq!(lab.get("api/envs").0, 200);
    // The answer did not wait until the heads were late: newer connections are still open, of which this is an old one.
    let mut waiting = connections.swap_remove(251);
    let rest = format!("st: {}\r\nConnection: close\r\n\r\n", lab.host());
    let mut answer = vec![];
    waiting.write_all(rest.as_bytes()).and_then(|()| waiting.read_to_end(&mut answer)).expect("an answer");
    assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));
    let oldest = connections[1].read(&mut [0]);
    let is_closed = match &oldest {
        Ok(count) => *count == 0,
        Err(error) => error.kind() == std::io::ErrorKind::ConnectionReset,
    };
    assert!(is_closed, "the oldest ones are closed: {oldest:?}");
}

#[test]
fn answers_bind_pages_to_the_lab() {
    let lab = TestLab::start();
    let mut stream = lab.connect();
    let request =
        format!("GET /{TOKEN}/ HTTP/1.1\r\nHost: {}\r\nConnection: close\r\nAccept-Encoding: gzip\r\n\r\n", lab.host());
    stream.write_all(request.as_bytes()).expect("sending");
    let mut answer = vec![];
    stream.read_to_end(&mut answer).expect("an answer");
    let answer = String::from_utf8_lossy(&answer).to_lowercase();
    for part in
        ["default-src 'none'", "frame-ancestors 'none'", "nosniff", "no-referrer", "no-store", "content-encoding: gzip"]
    {
        assert!(answer.contains(part), "{part}");
    }
    assert!(!answer.contains("unsafe-"), "the policy permits no inline code");
}
