//! Tests of `swm leaderboard`: entries, their verification against forgeries, and the pages.

use crate::{Swm, text};
use serde_json::json;
use std::fs;
use std::path::Path;
use swm::core::results::{Counting, EpisodeResult, Run, Searches};
use swm::leaderboard::{Entry, Submission, entries};

/// A planner that is fast, and whose episodes are short.
const PLANNER: [&str; 6] = ["--solver", "cem,samples=16,iterations=2,elites=4", "--budget", "12", "--videos", "0"];
/// The number of episodes.
const EPISODES: usize = 6;

/// Evaluates a capsule of the zoo and submits the results: `entry.json`.
fn submitted(swm: &Swm) -> Entry {
    let eval = ["eval", "zoo:two-room/pldm", "no-op", "--episodes", "6", "-o", "found"];
    swm.json(&[&eval[..], &PLANNER].concat());
    let found = swm.json(&["leaderboard", "submit", "found", "-o", "entry.json"]);
    let entry = Entry::read(&swm.path("entry.json")).expect("an entry");
    assert_eq!(
        (&found["hash"], &found["weights"]),
        (&entry.hash.as_str().into(), &entry.weights().expect("a hash").into())
    );
    entry
}

/// Writes a changed entry whose hash is right, as a forger would.
fn forged(swm: &Swm, entry: &Entry, name: &str, change: impl FnOnce(&mut Entry)) {
    let mut changed = entry.clone();
    change(&mut changed);
    changed.sealed().and_then(|entry| entry.write(&swm.path(name))).expect("a file");
}

/// Changes an episode of the policy, and the statistics with it.
fn change_episode(entry: &mut Entry, number: usize) {
    let run = entry.results.runs.iter_mut().find(|run| run.policy == entry.policy).expect("the run of the policy");
    let mut episodes = run.episodes.clone();
    episodes[number].success ^= true;
    *run = Run::new(&run.condition, &run.policy, Counting::default(), episodes, run.timing.clone());
    entry.results.comparisons.clear();
}

/// Whether an entry holds for shares that four seeds choose.
fn shares(swm: &Swm, file: &str) -> [bool; 4] {
    ["1", "2", "3", "4"].map(|seed| {
        let share = ["--share", "0.3", "--seed", seed, "--threads", "1"];
        swm.run(&[&["leaderboard", "verify", file][..], &share].concat()).status.success()
    })
}

/// The numbers of the episodes that a verification played.
fn played(found: &serde_json::Value) -> Vec<u64> {
    let numbers = found["verification"]["played"].as_array().expect("numbers");
    numbers.iter().filter_map(serde_json::Value::as_u64).collect()
}

#[test]
fn an_entry_holds_and_a_share_finds_the_changes_that_it_plays() {
    let swm = Swm::new();
    let entry = submitted(&swm);
    assert!(entry.author.len() > 3 && entry.licence.contains("MIT"), "those of the capsule");
    assert_eq!(entry.results.runs.len(), 3);
    let verify = |more: &[&str]| swm.json(&[&["leaderboard", "verify", "entry.json"], more].concat());
    let found = verify(&["--envs", "2"]);
    assert_eq!((&found["holds"], &found["verification"]["class"]), (&true.into(), &"exact".into()));
    assert_eq!((played(&found).len(), played(&verify(&["--share", "0.3"])).len()), (EPISODES, 2));

    forged(&swm, &entry, "episode.json", |entry| change_episode(entry, 4));
    let output = swm.run(&["leaderboard", "verify", "episode.json"]);
    assert!(!output.status.success() && text(&output.stdout).contains("episode 4 of pldm"), "{}", text(&output.stdout));
    let misses = ["1", "2", "3", "4"].map(|seed| !played(&verify(&["--share", "0.3", "--seed", seed])).contains(&4));
    assert_eq!(shares(&swm, "episode.json"), misses, "a share finds what it plays");

    // Seeds, starts and goals are compared whatever is played.
    forged(&swm, &entry, "start.json", |entry| entry.results.runs[1].episodes[5].seed += 1);
    forged(&swm, &entry, "starts.json", |entry| change_hash(entry, "starts"));
    forged(&swm, &entry, "seed.json", |entry| {
        entry.results.manifest.seed += 1;
        entry.results.manifest.config["seed"] = entry.results.manifest.seed.into();
    });
    for file in ["start.json", "starts.json", "seed.json"] {
        assert_eq!(shares(&swm, file), [false; 4], "{file}");
    }
}

/// Adds the policy `larger`, which has another kind of model than the policy of the entry, and whose run is the floor's.
fn add_policy(entry: &mut Entry, kind: &str) {
    let policies = entry.results.manifest.config["policies"].as_array_mut().expect("policies");
    let mut policy = policies.iter().find(|policy| policy["name"] == entry.policy).expect("the policy").clone();
    let checkpoint = policy["acts"]["plan"]["model"]["checkpoint"].take();
    let model = match kind {
        "true_dynamics" => json!({"checkpoint": checkpoint, "cost": "success"}),
        _ => json!({"checkpoint": checkpoint, "dataset": "rooms", "columns": ["state"], "true_dynamics": true}),
    };
    policy["acts"]["plan"]["model"] = json!({kind: model});
    policy["name"] = "larger".into();
    policies.push(policy);
    entry.results.runs.push(Run { policy: "larger".to_owned(), ..entry.results.runs[0].clone() });
    entry.results.comparisons.clear();
}

/// Changes a hash in the manifest.
fn change_hash(entry: &mut Entry, name: &str) {
    let hash = entry.results.manifest.hashes.get_mut(name).expect("a hash");
    *hash = hash.replace(|c: char| c.is_ascii_digit(), "a");
}

#[test]
fn forged_rewards_time_limits_weights_and_versions_are_refused() {
    let swm = Swm::new();
    let entry = submitted(&swm);
    let refused = |name: &str, code: i32, parts: &[&str], change: &dyn Fn(&mut Entry)| {
        forged(&swm, &entry, name, change);
        swm.fails(&["leaderboard", "verify", name], code, parts);
    };
    refused("reward.json", 1, &["does not hold"], &|entry| entry.results.runs[2].episodes[1].total_reward += 1e-9);
    refused("longer.json", 1, &["does not hold"], &|entry| entry.results.manifest.config["budget"] = 13.into());
    let shorter = ["an episode of 12 steps, and its budget is 11"];
    refused("shorter.json", 1, &shorter, &|entry| entry.results.manifest.config["budget"] = 11.into());
    refused("weights.json", 2, &["its hash is", "restore"], &|entry| change_hash(entry, "weights of pldm"));
    let version: &dyn Fn(&mut Entry) = &|entry| entry.results.manifest.swm_version += "9";
    refused("version.json", 2, &["was made with stable-worldmodel"], version);
    // Other weights in place of the entry's.
    let other = ["leaderboard", "verify", "entry.json", "--checkpoint", "zoo:two-room/lewm"];
    swm.fails(&other, 2, &["its hash is"]);
}

#[test]
fn another_processor_tolerates_no_outcome_of_few() {
    let swm = Swm::new();
    let entry = submitted(&swm);
    let elsewhere = |name: &str, numbers: &[usize]| {
        forged(&swm, &entry, name, |entry| {
            entry.processor = "abacus".to_owned();
            numbers.iter().for_each(|&number| change_episode(entry, number));
        });
    };
    elsewhere("none.json", &[]);
    let found = swm.json(&["leaderboard", "verify", "none.json"]);
    assert_eq!((&found["holds"], &found["verification"]["class"]), (&true.into(), &"outcomes".into()));
    swm.fails(&["leaderboard", "verify", "none.json", "--exact"], 2, &["abacus"]);
    // 5 % of six episodes are none.
    elsewhere("one.json", &[4]);
    swm.fails(&["leaderboard", "verify", "one.json"], 1, &["does not hold: 1 difference"]);
}

#[test]
fn another_device_is_no_way_around_the_comparison() {
    let swm = Swm::new();
    let entry = submitted(&swm);
    let elsewhere = |name: &str, change: &dyn Fn(&mut Entry)| {
        forged(&swm, &entry, name, |entry| {
            entry.results.manifest.device = "cuda:0".to_owned();
            change(entry);
        });
    };
    elsewhere("honest.json", &|_| ());
    let found = swm.json(&["leaderboard", "verify", "honest.json"]);
    assert_eq!((&found["holds"], &found["verification"]["class"]), (&true.into(), &"outcomes".into()));
    swm.fails(&["leaderboard", "verify", "honest.json", "--exact"], 2, &["'cuda:0'", "'cpu (flex)'"]);
    // Steps, rewards, starts and goals are compared as well.
    let change_all = |entry: &mut Entry, change: &dyn Fn(&mut EpisodeResult)| {
        let run = entry.results.runs.iter_mut().find(|run| run.policy == entry.policy).expect("the run of the policy");
        let mut episodes = run.episodes.clone();
        episodes.iter_mut().for_each(change);
        *run = Run::new(&run.condition, &run.policy, Counting::default(), episodes, run.timing.clone());
        entry.results.comparisons.clear();
    };
    elsewhere("steps.json", &|entry| change_all(entry, &|episode| episode.steps = 1));
    elsewhere("rewards.json", &|entry| change_all(entry, &|episode| episode.total_reward += 12345.0));
    elsewhere("starts.json", &|entry| change_hash(entry, "starts"));
    elsewhere("goals.json", &|entry| change_hash(entry, "goals"));
    for file in ["steps.json", "rewards.json", "starts.json", "goals.json"] {
        swm.fails(&["leaderboard", "verify", file], 1, &["does not hold"]);
    }
}

#[test]
fn entries_that_contradict_themselves_are_refused_before_anything_is_played() {
    let swm = Swm::new();
    let entry = submitted(&swm);
    let refused = |what: &str, change: &dyn Fn(&mut Entry)| {
        forged(&swm, &entry, "bad.json", change);
        swm.fails(&["leaderboard", "verify", "bad.json"], 1, &[what]);
        swm.fails(&["leaderboard", "build", ".", "-o", "site"], 1, &[what]);
    };
    // The folder has the results of the evaluation, too, which are no entry.
    fs::remove_dir_all(swm.path("found")).expect("removing the results");
    refused("states 1 successes", &|entry| {
        let run = &mut entry.results.runs[2];
        run.success.successes = 1;
        run.episodes.iter_mut().for_each(|episode| episode.success = false);
    });
    refused("another environment, protocol, counting or seed", &|entry| entry.results.manifest.seed += 1);
    refused("another environment, protocol, counting or seed", &|entry| entry.results.env = "swm/PushT-v1".to_owned());
    refused("has videos", &|entry| entry.results.runs[0].videos.push("entry.mp4".to_owned()));
    refused("searches", &|entry| {
        entry.results.runs[1].searches = Some(Searches { plans: 9, best: vec![], mean: vec![], spread: vec![] });
    });
    refused("its runs are not those of its request", &|entry| {
        entry.results.runs.pop();
        entry.results.comparisons.clear();
    });
    refused("has 5 episodes", &|entry| {
        let run = &mut entry.results.runs[0];
        let fewer = run.episodes[..EPISODES - 1].to_vec();
        *run = Run::new(&run.condition, &run.policy, Counting::default(), fewer, run.timing.clone());
        entry.results.comparisons.clear();
    });
    refused("author", &|entry| entry.author = "\u{1b}[31mroot".to_owned());
    refused("author", &|entry| entry.author = "x".repeat(500));
    refused("device", &|entry| entry.results.manifest.device = "cpu\nthe entry holds".to_owned());
    refused("device", &|entry| entry.results.manifest.device = "\u{1b}[2Jcpu".to_owned());
    refused("device", &|entry| entry.results.manifest.device = "x".repeat(500));
    refused("a second policy with weights", &|entry| entry.policy = "no-op".to_owned());
    refused("no weights with a hash", &|entry| drop(entry.results.manifest.hashes.remove("weights of pldm")));
    refused("no hash of the goals", &|entry| drop(entry.results.manifest.hashes.remove("goals")));
    refused("number of steps", &|entry| entry.results.manifest.config["budget"] = (1_u64 << 40).into());
    refused("more than 10000", &|entry| entry.results.manifest.config["budget"] = 20_000.into());
    refused("model steps", &|entry| {
        let samples =
            &mut entry.results.manifest.config["policies"][1]["acts"]["plan"]["solver"]["settings"]["samples"];
        *samples = (1_u64 << 60).into();
    });
    // Plans in the environment itself or by a probe, as autopsies have them, are neither trained nor baselines.
    refused("its policy 'larger' is no baseline", &|entry| add_policy(entry, "true_dynamics"));
    refused("its policy 'larger' is no baseline", &|entry| add_policy(entry, "probe"));
    refused("its policy 'random' is another one", &|entry| {
        entry.results.manifest.config["policies"][0]["acts"] = "no_op".into()
    });
    forged(&swm, &entry, "bad.json", |entry| {
        entry.results.env = "evil_mod:X-v0".to_owned();
        entry.results.manifest.config["env"] = "evil_mod:X-v0".into();
    });
    swm.fails(&["leaderboard", "verify", "bad.json"], 2, &["imports a Python module", "--trust"]);
}

#[test]
fn edited_files_and_files_that_are_no_entries_are_refused() {
    let swm = Swm::new();
    submitted(&swm);
    fs::remove_dir_all(swm.path("found")).expect("removing the results");
    let own = fs::read_to_string(swm.path("entry.json")).expect("the entry");
    for (content, what) in [
        (own.replacen("\"total_reward\": ", "\"total_reward\": 1", 1), "was edited"),
        (own.replacen("\"steps\": ", "\"steps\": 100", 1), "and its budget is 12"),
        (own.replacen("\"version\": 1", "\"version\": 2", 1), "layout 2"),
        (own.replacen("\"author\"", "\"who\"", 1), "unknown field"),
        // Fields that reading leaves out, so that the hash holds.
        (own.replacen("\"steps\": ", "\"note\": \"won\", \"steps\": ", 1), "results.runs[0].episodes[0].note"),
        (own.replacen("\"runs\": [", "\"notes\": [1], \"runs\": [", 1), "results.notes"),
        (own.replacen("\"device\": ", "\"place\": {}, \"device\": ", 1), "results.manifest.place"),
        ("{}".to_owned(), "missing field"),
        ("[".repeat(10_000), "no entry"),
    ] {
        fs::write(swm.path("bad.json"), content).expect("a file");
        swm.fails(&["leaderboard", "verify", "bad.json"], 1, &[what]);
    }
    fs::remove_file(swm.path("bad.json")).expect("removing a file");
    fs::copy(swm.path("entry.json"), swm.path("twin.json")).expect("a copy");
    swm.fails(&["leaderboard", "build", "."], 2, &["is the same entry"]);
    fs::rename(swm.path("twin.json"), swm.path("a\nmoved: b.json")).expect("renaming a file");
    let output = swm.run(&["leaderboard", "build", "."]);
    let errors = text(&output.stderr);
    assert!(errors.contains("a\\nmoved: b.json") && errors.lines().count() == 1, "{errors}");
}

#[test]
fn results_that_are_no_entry_are_not_submitted() {
    let swm = Swm::new();
    let eval = ["eval", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--budget", "3", "--no-pixels"];
    swm.json(&eval);
    let submit = ["leaderboard", "submit", "results", "-o", "entry.json", "--author", "A", "--licence", "B"];
    swm.fails(&submit, 2, &["none of their policies has weights"]);
    let both = ["eval", "zoo:two-room/pldm", "zoo:two-room/lewm", "--episodes", "2", "-o", "both"];
    swm.json(&[&both[..], &PLANNER].concat());
    let submit = ["leaderboard", "submit", "both", "-o", "entry.json"];
    swm.fails(&submit, 2, &["several", "pldm, lewm", "--policy"]);
    swm.fails(&[&submit[..], &["--policy", "lewn"]].concat(), 2, &["did you mean lewm"]);
    // One of the models is an entry, which holds without the other.
    swm.json(&[&submit[..], &["--policy", "lewm"]].concat());
    let entry = Entry::read(&swm.path("entry.json")).expect("an entry");
    assert_eq!(entry.results.runs.iter().map(|run| run.policy.as_str()).collect::<Vec<_>>(), ["random", "lewm"]);
    assert_eq!(swm.json(&["leaderboard", "verify", "entry.json"])["holds"], true);
    // A policy that plans in the environment is left out, as another model is.
    let mut more = entry.clone();
    add_policy(&mut more, "true_dynamics");
    more.results.manifest.hashes.insert("weights of lewm".to_owned(), entry.weights().expect("a hash").to_owned());
    let Entry { results, author, licence, .. } = more;
    let again = Entry::new(Submission { results, policy: None, author, licence }).expect("an entry");
    let runs = |entry: &Entry| entry.results.runs.iter().map(|run| run.policy.clone()).collect::<Vec<_>>();
    assert_eq!((runs(&again), again.weights().ok()), (runs(&entry), entry.weights().ok()));
    fs::write(swm.path("mine.json"), "{}").expect("a file");
    let own = ["leaderboard", "submit", "both", "-o", "mine.json", "--policy", "lewm"];
    swm.fails(&own, 2, &["was not written by this program"]);
}

#[test]
fn pages_rank_entries_and_run_nothing_of_theirs() {
    let swm = Swm::new();
    let entry = submitted(&swm);
    fs::create_dir(swm.path("board")).expect("a folder");
    let script = "<script>alert(1)</script>";
    for (name, author) in [("board/a.json", script), ("board/b.json", "Ada")] {
        forged(&swm, &entry, name, |entry| author.clone_into(&mut entry.author));
    }
    // A condition with an honest name and easy factors has a table of its own.
    forged(&swm, &entry, "board/c.json", |entry| {
        entry.results.manifest.config["conditions"][0]["variation"]["variation_values"] =
            serde_json::json!({"agent.speed": [9.0]});
    });
    let found = swm.json(&["leaderboard", "build", "board", "-o", "site", "--title", "Rooms & <more>"]);
    let tables = found["tables"].as_array().expect("tables");
    let conditions: Vec<&str> = tables.iter().filter_map(|table| table["condition"].as_str()).collect();
    assert_eq!(conditions, ["in distribution", "agent.speed=9"]);
    assert_eq!(tables[0]["policies"].as_array().map(Vec::len), Some(2));
    let page = fs::read_to_string(swm.path("site/index.html")).expect("the page");
    assert!(page.contains("Rooms &amp; &lt;more&gt;") && page.contains("1–2") && page.contains("default-src 'none'"));
    let pages = found["pages"].as_array().expect("pages");
    assert_eq!(pages.len(), 4);
    for page in pages {
        let html = fs::read_to_string(swm.path("site").join(page.as_str().expect("a name"))).expect("a page");
        for request in ["<script", "src=\"http", "href=\"http", "url(http", "@import"] {
            assert!(!html.contains(request), "{page}: {request}");
        }
    }
    // Every link leads to a page.
    let links: Vec<&str> = page.split("href=\"entries/").skip(1).filter_map(|part| part.split('"').next()).collect();
    assert!(links.len() == 3 && links.iter().all(|link| swm.path("site/entries").join(link).is_file()), "{links:?}");
    let again = fs::read(swm.path("site/index.html")).expect("the page");
    swm.json(&["leaderboard", "build", "board", "-o", "site", "--title", "Rooms & <more>"]);
    assert_eq!(fs::read(swm.path("site/index.html")).expect("the page"), again);
    fs::write(swm.path("site/index.html"), "my page").expect("a file");
    swm.fails(&["leaderboard", "build", "board", "-o", "site"], 2, &["was not written by this program"]);
    swm.fails(&["leaderboard", "build", "board", "-o", "board"], 2, &["is the folder of the entries"]);
    swm.fails(&["leaderboard", "build", "site", "-o", "new"], 2, &["0 entries"]);
}

#[test]
fn no_entry_is_left_out() {
    let folder = tempfile::tempdir().expect("a folder");
    let (board, own) = (folder.path().join("board"), Path::new(env!("CARGO_MANIFEST_DIR")).join("../../leaderboard"));
    let entry = |name: &str| {
        let path = board.join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("creating a folder");
        fs::copy(own.join("two-room-lewm.json"), &path).expect("copying an entry");
        path
    };
    let refused = |path: &Path, problem: &str| {
        let error = entries(&board).expect_err(problem).to_string();
        assert!(error.contains(problem) && error.contains(&*path.to_string_lossy()), "{error}");
    };
    let first = entry("a/b/entry.json");
    fs::create_dir_all(board.join("1/2/3/4/5")).expect("folders without entries");
    fs::write(board.join("1/2/3/4/5/notes.txt"), "").expect("writing a file");
    std::os::unix::fs::symlink("notes.txt", board.join("1/2/3/4/5/link.txt")).expect("making a link");
    // Hidden folders belong to other programs.
    fs::create_dir_all(board.join(".venv/a/b/c")).expect("a hidden folder");
    fs::write(board.join(".venv/a/b/c/own.json"), "{}").expect("writing a file");
    std::os::unix::fs::symlink("a", board.join(".venv/lib64")).expect("making a link");
    assert_eq!(entries(&board).expect("an entry").len(), 1);
    let deep = entry("1/2/3/4/entry.json");
    refused(&deep, "too many folders below");
    fs::remove_file(&deep).expect("removing the entry");
    for (target, link) in [(first.clone(), "linked.json"), (own, "linked"), (board.join("nothing"), "broken.json")] {
        let link = board.join(link);
        std::os::unix::fs::symlink(target, &link).expect("making a link");
        refused(&link, "is a symbolic link");
        fs::remove_file(&link).expect("removing the link");
    }
    let socket = board.join("socket.json");
    let _listener = std::os::unix::net::UnixListener::bind(&socket).expect("making a socket");
    refused(&socket, "is not a regular file");
}

/// A sample of every entry of the repository holds; there is one for each capsule of Two-Room.
#[test]
fn entries_of_the_repository_hold() {
    let swm = Swm::new();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let folder = root.join("leaderboard");
    let found = entries(&folder).expect("the entries of the repository");
    let mut evaluated: Vec<String> =
        found.iter().map(|found| found.entry.checkpoint().expect("a checkpoint")).collect();
    evaluated.sort();
    let zoo = swm.json(&["zoo"]);
    let capsules: Vec<String> = zoo
        .as_array()
        .expect("a list")
        .iter()
        .filter(|row| row["env"] == "swm/TwoRoom-v1")
        .map(|row| format!("zoo:{}", row["name"].as_str().expect("a name")))
        .collect();
    assert_eq!(evaluated, capsules);
    for swm::leaderboard::Found { file, entry } in found {
        assert!(entry.results.runs[0].episodes.len() >= 200, "{}", file.display());
        let path = folder.join(&file);
        let verified =
            swm.json(&["leaderboard", "verify", path.to_str().expect("a path"), "--share", "0.02", "--seed", "1"]);
        assert_eq!(verified["holds"], true, "{}: {verified}", file.display());
    }
}
