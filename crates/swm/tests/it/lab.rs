//! `swm frame`, and `swm lab` as a process: the page's still is the file that the page's command writes.

use super::{Swm, text};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::{Child, Stdio};

/// A lab that ends with this value.
struct Lab(Child, String);

impl Lab {
    fn start(swm: &Swm, args: &[&str]) -> Self {
        let args = [&["lab", "--no-open", "--port", "0"], args].concat();
        let mut child =
            swm.command(&args).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("the lab starts");
        let mut url = String::new();
        BufReader::new(child.stdout.take().expect("its output")).read_line(&mut url).expect("its URL");
        Self(child, url.trim().to_owned())
    }

    /// The body of a successful request.
    fn get(&self, path: &str) -> Vec<u8> {
        let (host, token) = self.1.strip_prefix("http://").and_then(|url| url.split_once('/')).expect("a URL");
        let mut stream = TcpStream::connect(host).expect("the lab listens");
        write!(stream, "GET /{token}{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").expect("sending");
        let mut answer = vec![];
        stream.read_to_end(&mut answer).expect("an answer");
        let end = answer.windows(4).position(|part| part == b"\r\n\r\n").expect("the end of the head");
        assert!(answer.starts_with(b"HTTP/1.1 200"), "{path}: {}", text(&answer));
        answer[end + 4..].to_vec()
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

#[test]
fn the_command_of_a_page_writes_the_bytes_of_its_still() {
    let swm = Swm::new();
    let lab = Lab::start(&swm, &[]);
    for query in [
        "env=swm/PushT-v1&seed=3&pin=block.shape=1;agent.color=10,200,30;block.angle=0.1",
        "env=swm/TwoRoom-v1&seed=7&image=96&variation=all",
        "env=swm/TwoRoom-v1&seed=9007199254740991&variation=none&pin=agent.speed=2.3333333&goal=true",
    ] {
        let command = text(&lab.get(&format!("api/command?{query}")));
        let still = lab.get(&format!("api/still?{query}"));
        let args: Vec<&str> = command.split(' ').skip(1).collect();
        let output = swm.run(&args);
        assert!(output.status.success(), "{command}: {}", text(&output.stderr));
        let written = std::fs::read(swm.path("frame.png")).expect("the file of the command");
        assert!(written == still, "{command}: {} and {} bytes", written.len(), still.len());
    }
}

#[test]
fn ctrl_c_ends_the_lab() {
    let swm = Swm::new();
    let mut lab = Lab::start(&swm, &[]);
    assert!(!lab.get("").is_empty());
    let pid = libc::pid_t::try_from(lab.0.id()).expect("an id of a process");
    #[allow(unsafe_code, reason = "sending a signal is a function of the C library")]
    // SAFETY: `kill` takes any numbers; the process has not been waited for, so the id is its own.
    unsafe {
        libc::kill(pid, libc::SIGINT);
    }
    assert_eq!(lab.0.wait().expect("the lab ends").code(), Some(0));
}

#[test]
fn addresses_of_other_machines_need_a_token() {
    let swm = Swm::new();
    swm.fails(&["lab", "--no-open", "--listen", "0.0.0.0"], 2, &["--token", "SSH tunnel"]);
    swm.fails(&["lab", "--no-open", "--token", "short"], 2, &["--token", "16 to 128"]);
    swm.fails(&["lab", "--no-open", "--runs", "missing"], 2, &["missing", "is not a folder"]);
}

#[test]
fn data_is_a_folder_a_dataset_or_a_uri() {
    let swm = Swm::new();
    swm.fails(
        &["lab", "--no-open", "--data", "missing.lance"],
        2,
        &["missing.lance", "neither a folder nor a dataset"],
    );
    swm.fails(&["lab", "--no-open", "--data", "ftp://host/a.lance"], 2, &["ftp://", "s3://"]);
    swm.fails(
        &["lab", "--no-open", "--data", "http://127.0.0.1:9/sets"],
        2,
        &["http://127.0.0.1:9/sets", "one dataset"],
    );
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "sets/rooms.lance", "--episodes", "1", "--policy", "random"]);
    let file = format!("file://{}", swm.path("sets/rooms.lance").display());
    let lab = Lab::start(&swm, &["--data", "sets", "--data", &file, "--data", "s3://bucket/prefix"]);
    let json = |path: &str| serde_json::from_slice::<serde_json::Value>(&lab.get(path)).expect("JSON");
    let listed = json("api/datasets");
    assert_eq!((&listed["datasets"][0]["folder"], &listed["datasets"][0]["name"]), (&1.into(), &"rooms.lance".into()));
    let uris: Vec<_> = (0..2).map(|i| listed["sources"][i]["location"].as_str().unwrap_or_default()).collect();
    assert_eq!(uris, [&file["file://".len()..], "s3://bucket/prefix"]);
    assert_eq!(json("api/names?folder=2"), serde_json::json!(["rooms.lance"]));
    assert_eq!(json("api/summary?folder=2&name=rooms.lance")["episodes"], 1);
}

#[test]
fn frames_replace_frames_only() {
    let swm = Swm::new();
    let frame = ["frame", "swm/TwoRoom-v1", "--seed", "1", "--image", "32", "--output", "a.png"];
    assert_eq!(swm.json(&frame)["file"], "a.png");
    assert!(swm.run(&frame).status.success(), "a frame of the program is replaced");
    std::fs::write(swm.path("b.png"), "mine").expect("a file");
    swm.fails(&["frame", "swm/TwoRoom-v1", "--output", "b.png"], 2, &["b.png"]);
    swm.fails(&["frame", "swm/TwoRoom-v1", "--pin", "agent.colour=1,2,3"], 2, &["did you mean agent.color"]);
    assert_eq!(std::fs::read(swm.path("b.png")).expect("a file"), b"mine");
}
