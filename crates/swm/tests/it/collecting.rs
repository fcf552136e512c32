//! Tests of `swm collect`: determinism, interruption, resumption, shards and invalid requests.

use crate::{Swm, text};
use std::time::{Duration, Instant};

const ROOMS: &[&str] =
    &["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "32", "--max-steps", "40", "--seed", "3"];

fn with<'a>(args: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
    args.iter().chain(more).copied().collect()
}

/// Returns the content hash and the number of episodes of a dataset.
fn content(swm: &Swm, name: &str) -> (String, usize) {
    let found = swm.json(&["inspect", name]);
    let hash = found["content_hash"].as_str().expect("the hash is a string").to_owned();
    (hash, usize::try_from(found["episodes"].as_u64().expect("an integer")).expect("the count fits usize"))
}

#[test]
fn dataset_does_not_depend_on_thread_and_environment_counts() {
    let swm = Swm::new();
    let hashes = [("1", "1"), ("2", "3"), ("2", "8")].map(|(threads, envs)| {
        let more = ["--episodes", "9", "--overwrite", "--threads", threads, "--envs", envs];
        swm.json(&with(ROOMS, &more));
        content(&swm, "rooms")
    });
    assert_eq!(hashes[0].1, 9);
    assert_eq!(hashes[0], hashes[1]);
    assert_eq!(hashes[0], hashes[2]);
}

#[test]
fn killed_collection_keeps_committed_episodes_and_resumes() {
    let swm = Swm::new();
    let all = ["--episodes", "100000"];
    let mut child = swm.command(&with(ROOMS, &all)).stderr(std::process::Stdio::null()).spawn().expect("swm starts");
    // Kill the process after the first commit.
    let start = Instant::now();
    let partial = loop {
        assert!(start.elapsed() < Duration::from_secs(60), "nothing was committed in a minute");
        std::thread::sleep(Duration::from_millis(50));
        let output = swm.run(&["inspect", "rooms", "--json"]);
        if output.status.success() {
            let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("parsing the JSON");
            if found["episodes"].as_u64() > Some(0) {
                break found["episodes"].as_u64();
            }
        }
    };
    child.kill().expect("killing the collection");
    child.wait().expect("the process ends");
    let (_, kept) = content(&swm, "rooms");
    assert!(
        kept as u64 >= partial.expect("the loop has read the number of episodes"),
        "{kept} episodes, {partial:?} were committed"
    );
    assert!(kept < 100_000, "the collection ended before it was killed");
    let target = (kept + 5).to_string();
    swm.json(&with(ROOMS, &["--episodes", &target, "--resume"]));
    let resumed = content(&swm, "rooms");
    swm.json(&with(ROOMS, &["--episodes", &target, "--overwrite"]));
    assert_eq!(resumed, content(&swm, "rooms"));
}

#[test]
fn dataset_alone_is_continued_as_it_began() {
    let swm = Swm::new();
    let mixture = ["--policy", "expert:2", "--policy", "random", "--action-noise", "0.1", "--codec", "jpeg"];
    let factors = ["--variation", "agent", "--pin", "wall.thickness=7", "--wrapper", "noise,std=3"];
    let all = [ROOMS, &mixture[..], &factors].concat();
    swm.json(&with(&all, &["--episodes", "5"]));
    let whole = content(&swm, "rooms");
    swm.json(&with(&all, &["--episodes", "2", "--overwrite"]));
    let resume = ["collect", "--resume", "-o", "rooms"];
    assert_eq!(swm.json(&resume)["collected"]["added"], 0);
    let output = swm.run(&with(&resume, &["--episodes", "5", "--envs", "3"]));
    let log = text(&output.stderr);
    assert!(output.status.success() && log.contains("continuing: swm collect --policy=expert:2"), "{log}");
    assert_eq!(content(&swm, "rooms"), whole);

    let fails = |more: &[&str], parts: &[&str]| swm.fails(&with(&resume, more), 2, parts);
    fails(&["--seed", "4"], &["with seed 4", "with seed 3"]);
    fails(&["--policy", "random"], &["with policy \"random\"", "\"expert\""]);
    fails(&["--image", "64"], &["[64,64]", "[32,32]"]);
    fails(&["--pin", "wall.thickness=8"], &["8.0", "7.0"]);
    fails(&["--codec", "png"], &["codec \"png\"", "quality"]);
    swm.fails(&["collect", "--resume", "-o", "room"], 2, &["unknown dataset 'room'", "did you mean rooms"]);
    swm.fails(&["collect", "-o", "rooms"], 2, &["<ENV>"]);
    assert_eq!(content(&swm, "rooms"), whole);

    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "parts", "--no-pixels", "--episodes", "4", "--shard", "1/2"]);
    let shard = swm.json(&["collect", "--resume", "-o", "parts", "--shard", "1/2"]);
    assert_eq!(shard["collected"]["added"], 0);
    swm.fails(
        &["collect", "--resume", "-o", "parts", "--shard", "0/2"],
        2,
        &["does not record how", "swm collect ENV"],
    );
    std::fs::create_dir(swm.path("empty")).expect("a folder");
    swm.fails(&["collect", "--resume", "-o", "./empty"], 2, &["does not record how", "swm collect ENV"]);
}

#[test]
fn other_wrappers_do_not_continue_a_collection() {
    let swm = Swm::new();
    let resume = with(ROOMS, &["--episodes", "4", "--resume"]);
    let noisy = |args: &[&'static str]| with(args, &["--wrapper", "noise,std=30"]);
    swm.json(&with(ROOMS, &["--episodes", "2"]));
    let before = content(&swm, "rooms");
    swm.fails(&noisy(&resume), 2, &["wrappers", "collect into another dataset"]);
    assert_eq!(content(&swm, "rooms"), before);
    swm.json(&noisy(&with(ROOMS, &["--episodes", "2", "--overwrite"])));
    swm.fails(&resume, 2, &["wrappers"]);
    swm.json(&noisy(&resume));
    assert_eq!(content(&swm, "rooms").1, 4);
}

#[test]
fn wrappers_change_the_colours_of_every_camera_and_no_depth() {
    let swm = Swm::new();
    let grey = ["--wrapper", "grayscale"];
    let views = ["--view", "depth", "--view", "side_pixels", "--episodes", "1", "--max-steps", "2"];
    swm.json(&[&["collect", "swm/OGBCube-v0", "-o", "cube", "--image", "32"], &views[..], &grey].concat());
    let frame = |view: &str, more: &[&str]| {
        let frame = ["frame", "swm/OGBCube-v0", "--image", "32", "-o", "frame.png", "--view", view];
        swm.json(&[&frame[..], more].concat());
        std::fs::read(swm.path("frame.png")).expect("reading a frame")
    };
    assert_ne!(frame("side_pixels", &[]), frame("side_pixels", &grey));
    assert_eq!(frame("depth", &[]), frame("depth", &grey));
}

#[cfg(unix)]
#[test]
fn interrupted_collection_keeps_finished_episodes() {
    let swm = Swm::new();
    let child = swm
        .command(&with(ROOMS, &["--episodes", "100000"]))
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("swm starts");
    let start = Instant::now();
    while !swm.path("datasets/rooms.lance").exists() {
        assert!(start.elapsed() < Duration::from_secs(60), "no dataset appeared in a minute");
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(300));
    let interrupted =
        std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("starting `kill`");
    assert!(interrupted.success());
    let output = child.wait_with_output().expect("the process ends");
    assert_eq!(output.status.code(), Some(130), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("interrupted"), "{}", text(&output.stderr));
    assert!(content(&swm, "rooms").1 > 0);
}

#[test]
fn invalid_requests_fail_without_replacing_the_dataset() {
    let swm = Swm::new();
    swm.json(&with(ROOMS, &["--episodes", "2"]));
    let fails = |more: &[&str], code, parts: &[&str]| swm.fails(&with(ROOMS, more), code, parts);
    fails(&[], 2, &["rooms", "--resume", "--overwrite"]);
    fails(&["--resume", "--pin", "agent.speed=4"], 2, &["variation", "agent.speed"]);
    fails(&["--resume", "--codec", "jpeg"], 2, &["--codec", "qoi"]);
    fails(&["--overwrite", "--variation", "agent.colour"], 2, &["did you mean agent.color"]);
    fails(&["--overwrite", "--pin", "agent.color=1,2,300"], 2, &["agent.color", "0 ..= 255"]);
    fails(&["--overwrite", "--pin", "agent.color=red"], 2, &["KEY=NUMBER"]);
    fails(&["--overwrite", "--policy", "exprt"], 2, &["unknown policy 'exprt'", "expert"]);
    swm.fails(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "2"], 2, &["not a frame size"]);
    assert_eq!(content(&swm, "rooms").1, 2);
}

#[test]
fn mixtures_of_policies_and_shards_have_the_same_content() {
    let swm = Swm::new();
    let mixture =
        with(ROOMS, &["--policy", "expert:2", "--policy", "random", "--action-noise", "0.1", "--episodes", "8"]);
    swm.json(&with(&mixture, &["--envs", "3"]));
    let whole = content(&swm, "rooms");
    let found = swm.json(&["inspect", "rooms"]);
    let config = &found["manifest"]["config"];
    assert_eq!(config["policy"][0], serde_json::json!({"name": "expert", "weight": 2.0}));
    assert_eq!(config["action_noise"], 0.1);
    assert!(found["columns"].to_string().contains("policy_index"));
    let sharded = Swm::new();
    sharded.json(&with(&mixture, &["--shard", "1/2"]));
    sharded.json(&with(&mixture, &["--shard", "0/2", "--envs", "1"]));
    sharded.json(&["datasets", "commit", "rooms"]);
    assert_eq!(content(&sharded, "rooms"), whole);
    // The same shards again would store every episode twice.
    sharded.fails(&with(&mixture, &["--shard", "0/2"]), 2, &["episodes of the collection", "_shards"]);
    assert_eq!(content(&sharded, "rooms"), whole);
    let late = Swm::new();
    late.json(&with(&mixture, &["--shard", "0/2"]));
    late.json(&with(&mixture, &["--shard", "1/2"]));
    late.json(&with(&mixture, &["--overwrite"]));
    late.fails(&["datasets", "commit", "rooms"], 2, &["episodes of the collection", "_shards"]);
    assert_eq!(content(&late, "rooms"), whole);
    let fails = |more: &[&str], parts: &[&str]| swm.fails(&with(ROOMS, more), 2, parts);
    fails(&["--resume", "--policy", "expert:2", "--policy", "random"], &["action_noise", "0.1"]);
    fails(&["--overwrite", "--policy", "expert:0", "--policy", "random"], &["the policy 'expert'", "positive"]);
    fails(&["--overwrite", "--policy", "expert:2", "--policy", "randon"], &["unknown policy 'randon'"]);
    fails(&["--overwrite", "--action-noise=-1"], &["action noise", "at least 0"]);
    let discrete =
        ["collect", "swm/PushT-Discrete-v1", "-o", "rooms", "--overwrite", "--no-pixels", "--action-noise", "0.1"];
    swm.fails(&discrete, 2, &["swm/PushT-Discrete-v1 are discrete"]);
    assert_eq!(content(&swm, "rooms"), whole);
}

#[test]
fn truncated_dataset_is_an_error() {
    let swm = Swm::new();
    swm.json(&with(ROOMS, &["--episodes", "3"]));
    let data = swm.path("datasets/rooms.lance/data");
    let file = std::fs::read_dir(data)
        .expect("listing the data files")
        .flatten()
        .next()
        .expect("the folder has a file")
        .path();
    let bytes = std::fs::read(&file).expect("the file is readable");
    std::fs::write(&file, &bytes[..bytes.len() / 2]).expect("the file is writable");
    swm.fails(&["inspect", "rooms"], 1, &["rooms.lance"]);
    std::fs::remove_file(&file).expect("the file is removable");
    swm.fails(&["inspect", "rooms"], 1, &["rooms.lance"]);
}

/// Only one renderer is certain to be available, so the test changes the renderer in the second shard's log.
#[test]
fn shards_of_two_renderers_require_mix_renderers() {
    let swm = Swm::new();
    let collect = |shard| {
        [
            "collect",
            "swm/PendulumDMControl-v0",
            "-o",
            "swings",
            "--image",
            "16",
            "--max-steps",
            "3",
            "--policy",
            "random",
            "--shard",
            shard,
        ]
    };
    for shard in ["0/2", "1/2"] {
        swm.json(&with(&collect(shard), &["--episodes", "2", "--renderer", "cpu"]));
    }
    let logs = swm.path("datasets/swings.lance/_shards");
    let second = std::fs::read_dir(logs)
        .expect("listing the folder of shards")
        .map(|entry| entry.expect("reading the entry of a shard").path())
        .max()
        .expect("two shards");
    let log = second.join("begun.json");
    let changed =
        std::fs::read_to_string(&log).expect("reading the log").replace(r#""renderer":"cpu"#, r#""renderer":"egl"#);
    std::fs::write(&log, changed).expect("the file is writable");
    swm.fails(&["datasets", "commit", "swings"], 2, &["egl", "--mix-renderers"]);
    assert_eq!(swm.json(&["datasets", "commit", "swings", "--mix-renderers"])["added"], 2);
}
