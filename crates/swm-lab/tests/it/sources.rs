//! Datasets at URIs: a prefix of a store, a dataset on a server that does not answer, and what no page can reach.

use super::{TestLab, data};
use object_store::local::LocalFileSystem;
use serde_json::json;
use std::net::TcpListener;
use std::sync::Arc;
use std::time::{Duration, Instant};
use swm_data::Location;
use swm_data::objects::provide;
use swm_lab::sources::Source;

/// A lab with a prefix of a store, whose datasets are in the folder `store/sets` of another lab.
fn lab(others: Vec<Source>) -> (TestLab, TestLab) {
    let store = TestLab::start();
    data::collect(&store, 3);
    let name = store.host().replace(':', "-");
    let files = LocalFileSystem::new_with_prefix(store.home.path()).expect("a store");
    provide(&name, Arc::new(files));
    let at = Location::Uri(format!("store://{name}/datasets").parse().expect("a URI"));
    let prefix = Source::at(at).expect("a prefix");
    (TestLab::with(std::iter::once(prefix).chain(others).collect()), store)
}

#[test]
fn datasets_below_a_prefix_are_listed_shown_and_saved_as_local_ones() {
    let (lab, store) = lab(vec![]);
    let listed = lab.json("api/datasets");
    assert_eq!((&listed["datasets"], &listed["sources"][0]["folder"]), (&json!([]), &json!(1)));
    let uri = listed["sources"][0]["location"].as_str().expect("a URI");
    assert!(uri.starts_with("store://") && uri.ends_with("/datasets"), "{uri}");
    assert_eq!(lab.json("api/names?folder=1"), json!(["rooms.lance"]));
    let summary = lab.json("api/summary?folder=1&name=rooms.lance");
    assert_eq!(summary, {
        let mut local = store.json("api/datasets")["datasets"][0].clone();
        let fields = local.as_object_mut().expect("fields");
        fields.retain(|key, _| !["folder", "name"].contains(&key.as_str()));
        local
    });
    for route in ["episodes?", "rows?episode=2&", "values?column=action&", "distribution?column=action&y=1&", "doctor?"]
    {
        let local = store.json(&format!("api/{route}name=rooms.lance"));
        assert_eq!(lab.json(&format!("api/{route}name=rooms.lance&folder=1")), local, "{route}");
    }
    let key = &lab.json("api/episodes?folder=1&name=rooms.lance")["key"];
    let body = json!({"folder": 1, "name": "rooms.lance", "target": "cut", "episodes": [0, 2], "key": key});
    assert_eq!(lab.post("api/save", &body.to_string()), (200, r#"{"episodes":2}"#.to_owned()));
    assert_eq!(lab.json("api/datasets")["datasets"][0]["name"], "cut.lance");
    assert_eq!(store.json("api/datasets")["datasets"].as_array().map(Vec::len), Some(1), "the store is only read");
}

#[test]
fn pages_reach_no_uri_outside_the_prefix() {
    let (lab, store) = lab(vec![]);
    let datasets = store.home.path().join("datasets");
    std::fs::create_dir(store.home.path().join("secret")).expect("a folder");
    for folder in ["secret/own.lance", "datasets/deep"] {
        let copied = std::process::Command::new("cp")
            .arg("-r")
            .arg(datasets.join("rooms.lance"))
            .arg(store.home.path().join(folder))
            .status();
        assert!(copied.expect("a copy").success());
    }
    let names =
        ["../secret/own.lance", "..%2Fsecret%2Fown.lance", "%252e%252e%2Fsecret%2Fown.lance", "deep", "", "..", "/"];
    for name in names.into_iter().chain([
        "store://other/rooms.lance",
        "http://127.0.0.1:9/a.lance",
        "rooms.lance/../rooms.lance",
    ]) {
        for route in ["summary", "episodes", "rows", "values", "frame", "video", "distribution", "doctor"] {
            let (status, body) = lab.get(&format!("api/{route}?folder=1&name={name}"));
            assert_eq!(status, 400, "{route} {name}: {}", String::from_utf8_lossy(&body));
        }
        let body = json!({"folder": 1, "name": name, "target": "x", "episodes": [0]});
        assert_eq!(lab.post("api/save", &body.to_string()).0, 400, "{name}");
    }
    for folder in ["2", "-1", "18446744073709551615"] {
        assert_eq!(lab.get(&format!("api/names?folder={folder}")).0, 400, "{folder}");
        assert_eq!(lab.get(&format!("api/episodes?folder={folder}&name=rooms.lance")).0, 400, "{folder}");
    }
    assert_eq!(lab.get("api/names?folder=1&uri=store://other").0, 400);
    assert_eq!(lab.get("api/names?folder=0").0, 400, "folders are listed with their datasets");
}

#[test]
fn a_server_that_does_not_answer_delays_no_other_request() {
    // Connections are accepted by the system, and nobody reads them.
    let silent = TcpListener::bind("127.0.0.1:0").expect("a port");
    let uri = format!("http://{}/rooms.lance", silent.local_addr().expect("an address"));
    let dead = Source::at(Location::parse(&uri).expect("a URI")).expect("a dataset");
    let (lab, _store) = lab(vec![dead]);
    let lab = Arc::new(lab);
    let waiting: Vec<_> = (0..4)
        .map(|_| {
            let lab = Arc::clone(&lab);
            std::thread::spawn(move || lab.get("api/summary?folder=2&name=rooms.lance"))
        })
        .collect();
    // A connection of the lab has arrived, so that the requests are under way.
    silent.accept().expect("a connection");
    let start = Instant::now();
    assert_eq!(lab.json("api/episodes?folder=1&name=rooms.lance")["index"], json!([0, 1, 2]));
    let listed = lab.json("api/datasets");
    assert_eq!((&listed["datasets"], &listed["sources"][1]["name"]), (&json!([]), &json!("rooms.lance")));
    assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
    assert!(waiting.iter().any(|request| !request.is_finished()), "the server did not answer");
    // The server ends: connections are refused, which is an error after a few repetitions.
    drop(silent);
    for request in waiting {
        let (status, body) = request.join().expect("an answer");
        let body = String::from_utf8_lossy(&body).into_owned();
        assert!(status == 400 && body.contains(&uri), "{status} {body}");
    }
}
