//! Collecting: resumed, interrupted, killed, and asked for nonsense.

use crate::{Swm, text};
use std::time::{Duration, Instant};

const ROOMS: &[&str] =
    &["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "32", "--max-steps", "40", "--seed", "3"];

fn with<'a>(args: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
    args.iter().chain(more).copied().collect()
}

/// The dataset's content, and how many episodes it has.
fn content(swm: &Swm, name: &str) -> (String, usize) {
    let found = swm.json(&["inspect", name]);
    let hash = found["content_hash"].as_str().expect("a hash").to_owned();
    (hash, usize::try_from(found["episodes"].as_u64().expect("a number")).expect("a small number"))
}

#[test]
fn a_dataset_does_not_depend_on_threads_or_environments() {
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
fn a_killed_collection_keeps_committed_episodes_and_resumes() {
    let swm = Swm::new();
    let all = ["--episodes", "100000"];
    let mut child = swm.command(&with(ROOMS, &all)).stderr(std::process::Stdio::null()).spawn().expect("swm starts");
    // Wait for the first commit, then pull the plug.
    let begun = Instant::now();
    let partial = loop {
        assert!(begun.elapsed() < Duration::from_secs(60), "nothing was committed in a minute");
        std::thread::sleep(Duration::from_millis(50));
        let output = swm.run(&["inspect", "rooms", "--json"]);
        if output.status.success() {
            let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
            if found["episodes"].as_u64() > Some(0) {
                break found["episodes"].as_u64();
            }
        }
    };
    child.kill().expect("SIGKILL");
    child.wait().expect("it is gone");
    let (_, kept) = content(&swm, "rooms");
    assert!(kept as u64 >= partial.expect("some"), "{kept} episodes, {partial:?} were committed");
    assert!(kept < 100_000, "the collection ended before it was killed");
    let target = (kept + 5).to_string();
    swm.json(&with(ROOMS, &["--episodes", &target, "--resume"]));
    let resumed = content(&swm, "rooms");
    swm.json(&with(ROOMS, &["--episodes", &target, "--overwrite"]));
    assert_eq!(resumed, content(&swm, "rooms"));
}

#[cfg(unix)]
#[test]
fn ctrl_c_keeps_every_finished_episode() {
    let swm = Swm::new();
    let child = swm
        .command(&with(ROOMS, &["--episodes", "100000"]))
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("swm starts");
    let begun = Instant::now();
    while !swm.path("datasets/rooms.lance").exists() {
        assert!(begun.elapsed() < Duration::from_secs(60), "no dataset appeared in a minute");
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(300));
    let interrupted =
        std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill runs");
    assert!(interrupted.success());
    let output = child.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(130), "{}", text(&output.stderr));
    assert!(text(&output.stderr).contains("interrupted"), "{}", text(&output.stderr));
    assert!(content(&swm, "rooms").1 > 0);
}

#[test]
fn wrong_requests_are_refused_with_reasons() {
    let swm = Swm::new();
    swm.json(&with(ROOMS, &["--episodes", "2"]));
    let ask = |more: &[&str], code, words: &[&str]| swm.refuses(&with(ROOMS, more), code, words);
    ask(&[], 2, &["rooms", "--resume", "--overwrite"]);
    ask(&["--resume", "--pin", "agent.speed=4"], 2, &["variation", "agent.speed"]);
    ask(&["--resume", "--codec", "jpeg"], 2, &["--codec", "qoi"]);
    ask(&["--overwrite", "--variation", "agent.colour"], 2, &["did you mean agent.color"]);
    ask(&["--overwrite", "--pin", "agent.color=1,2,300"], 2, &["agent.color", "0 ..= 255"]);
    ask(&["--overwrite", "--pin", "agent.color=red"], 2, &["KEY=NUMBER"]);
    ask(&["--overwrite", "--policy", "exprt"], 2, &["unknown policy 'exprt'", "expert"]);
    swm.refuses(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "2"], 2, &["no picture size"]);
    // None of these replaced the dataset.
    assert_eq!(content(&swm, "rooms").1, 2);
}

#[test]
fn a_truncated_dataset_says_so() {
    let swm = Swm::new();
    swm.json(&with(ROOMS, &["--episodes", "3"]));
    let data = swm.path("datasets/rooms.lance/data");
    let file = std::fs::read_dir(data).expect("data files").flatten().next().expect("one").path();
    let bytes = std::fs::read(&file).expect("readable");
    std::fs::write(&file, &bytes[..bytes.len() / 2]).expect("writable");
    swm.refuses(&["inspect", "rooms"], 1, &["rooms.lance"]);
    std::fs::remove_file(&file).expect("removable");
    swm.refuses(&["inspect", "rooms"], 1, &["rooms.lance"]);
}

/// Parts of one dataset whose pictures two renderers drew. Only one renderer is sure to be there, so the second part's
/// note is changed to tell of another.
#[test]
fn parts_of_two_renderers_are_committed_only_when_asked() {
    let swm = Swm::new();
    let part = |shard| {
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
        swm.json(&with(&part(shard), &["--episodes", "2", "--renderer", "cpu"]));
    }
    let parts = swm.path("datasets/swings.lance/_shards");
    let second =
        std::fs::read_dir(parts).expect("parts").map(|entry| entry.expect("a part").path()).max().expect("two");
    let note = second.join("begun.json");
    let told = std::fs::read_to_string(&note).expect("a note").replace(r#""renderer":"cpu"#, r#""renderer":"egl"#);
    std::fs::write(&note, told).expect("writes");
    let refused = swm.run(&["datasets", "commit", "swings"]);
    let told = text(&refused.stderr);
    assert!(!refused.status.success() && told.contains("egl") && told.contains("--mix-renderers"), "{told}");
    assert_eq!(swm.json(&["datasets", "commit", "swings", "--mix-renderers"])["added"], 2);
}
