//! A writing process is killed (SIGKILL) at random times: committed episodes must be readable, and the next writer must
//! continue and ignore leftover files.
//!
//! The regular tests kill each kind of writer four times;
//! `cargo test --release -p swm-data --test it kill -- --ignored` kills each kind fifty times.

use crate::sample::{check, episode, options, schema};
use rand::Rng as _;
use std::io::{BufRead as _, BufReader, Lines};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};
use swm_core::Key;
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::{CommitPolicy, Constants, Location, WriteMode, WriteOptions, Writer, create, open};

/// Environment variable of child processes: the path to write to.
const TARGET: &str = "SWM_TEST_KILLED";

/// A child process and its output, which must stay open while the child prints.
struct Running {
    child: Child,
    _output: Lines<BufReader<ChildStdout>>,
}

/// Starts a child test below and waits until the child begins to write.
fn start(test: &str, path: &Path) -> Running {
    let mut command = Command::new(std::env::current_exe().expect("finding the test executable"));
    command.args(["--exact", &format!("kill::{test}"), "--nocapture"]).env(TARGET, path);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("starting the child process");
    let mut output = BufReader::new(child.stdout.take().expect("the output of the child process")).lines();
    let begun = output.any(|line| line.is_ok_and(|line| line.contains("begun")));
    assert!(begun, "the child ended before it began");
    Running { child, _output: output }
}

/// Kills a child after a keyed random time; returns whether the child was still running.
fn kill(mut running: Running, key: Key, longest: Duration) -> bool {
    // Busy waiting, because the scheduler may extend a sleep.
    let end = Instant::now() + longest.mul_f64(key.rng().random());
    while Instant::now() < end {
        std::hint::spin_loop();
    }
    running.child.kill().expect("killing the child process");
    !running.child.wait().expect("waiting for the child process").success()
}

fn target() -> Option<PathBuf> {
    std::env::var_os(TARGET).map(PathBuf::from)
}

fn frequent_commits() -> CommitPolicy {
    CommitPolicy { episodes: 2, interval: Duration::from_millis(5), ..CommitPolicy::default() }
}

fn write_until(mut writer: Box<dyn Writer>, until: usize) {
    println!("begun");
    for e in writer.episodes()..until {
        let constants = Constants::from([("number".to_owned(), e.to_string().into_bytes())]);
        writer.write_episode_with(&episode(e), &constants).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

/// A child process: creates or continues a dataset until it is killed.
#[test]
fn child_that_appends() {
    let Some(path) = target() else { return };
    let options = WriteOptions { commit: frequent_commits(), ..options(WriteMode::Append) };
    write_until(create(&path, &schema(), options).expect("continuing the dataset"), 1_000_000);
}

/// A child process: replaces a dataset with ten episodes repeatedly.
#[test]
fn child_that_replaces() {
    let Some(path) = target() else { return };
    loop {
        let options = WriteOptions { commit: frequent_commits(), ..options(WriteMode::Overwrite) };
        write_until(create(&path, &schema(), options).expect("replacing the dataset"), 10);
    }
}

/// A child process: writes or continues two shards, and commits both shards.
#[test]
fn child_that_writes_shards() {
    let Some(path) = target() else { return };
    println!("begun");
    for index in 0..2 {
        let options = WriteOptions { commit: frequent_commits(), ..options(WriteMode::Append) };
        let shard = Shard { index, count: 2 };
        let mut writer = create_shard(&Location::from(&path), &schema(), options, shard).expect("continuing the shard");
        for e in writer.episodes()..6 {
            writer.write_episode(&episode(6 * index + e)).expect("writing an episode");
        }
        writer.finish().expect("finishing the dataset");
    }
    commit_shards(&Location::from(&path)).expect("committing the shards");
}

/// Checks that everything is readable and that episode indices have no gap.
fn check_all(path: &Path, constants: bool) -> usize {
    let reader = open(path).expect("opening the dataset");
    check(&*reader, 0);
    for (at, stored) in reader.episodes().iter().enumerate() {
        assert_eq!(stored.index, at as i64);
        if constants {
            assert_eq!(reader.constants(at).expect("reading constants")["number"], at.to_string().into_bytes());
        }
    }
    reader.content_hash().expect("hashing the content");
    reader.episodes().len()
}

fn killed_appends(kills: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let mut stored = 0;
    for index in 0..kills {
        let child = start("child_that_appends", &path);
        assert!(
            kill(child, Key::new(0).with("append").at(index), Duration::from_millis(120)),
            "the child ended before it was killed"
        );
        let now = check_all(&path, true);
        assert!(now >= stored, "{now} episodes after {stored}");
        stored = now;
    }
    assert!(stored > 0);
    // The next writer continues and ignores leftovers.
    let mut writer = create(&path, &schema(), options(WriteMode::Append)).expect("continuing the dataset");
    let constants = Constants::from([("number".to_owned(), stored.to_string().into_bytes())]);
    writer.write_episode_with(&episode(stored), &constants).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    assert_eq!(check_all(&path, true), stored + 1);
}

fn killed_replacements(kills: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    replacements(&path, kills, |path| assert!(check_all(path, true) <= 10));
}

/// Kills processes that replace a dataset, and calls `check` after each kill.
pub fn replacements(path: &Path, kills: u64, check: impl Fn(&Path)) {
    for index in 0..kills {
        let child = start("child_that_replaces", path);
        assert!(
            kill(child, Key::new(0).with("replace").at(index), Duration::from_millis(120)),
            "the child ended before it was killed"
        );
        check(path);
    }
}

fn killed_shards(kills: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for index in 0..kills {
        let path = folder.path().join(format!("{index}.lance"));
        let child = start("child_that_writes_shards", &path);
        if kill(child, Key::new(0).with("parts").at(index), Duration::from_millis(60)) {
            // Another run completes the commit, unless this run was killed between the commit and the cleanup.
            let committed = open(&path).is_ok();
            if committed {
                assert_eq!(check_all(&path, false), 12, "both shards are committed together");
                let _ = commit_shards(&Location::from(&path));
            } else {
                let status =
                    start("child_that_writes_shards", &path).child.wait().expect("waiting for the child process");
                assert!(status.success(), "kill {index}");
            }
        }
        assert_eq!(check_all(&path, false), 12, "kill {index}");
        assert!(!path.join("_shards/0-of-2/done.json").exists(), "the log of the shard is removed");
    }
}

#[test]
fn killed_append_keeps_committed_episodes() {
    killed_appends(4);
}

#[test]
fn killed_replacement_leaves_the_old_or_new_dataset() {
    killed_replacements(4);
}

#[test]
fn killed_shards_are_continued() {
    killed_shards(4);
}

#[test]
#[ignore = "takes a minute"]
fn fifty_killed_appends_keep_committed_episodes() {
    killed_appends(50);
}

#[test]
#[ignore = "takes a minute"]
fn fifty_killed_replacements_leave_the_old_or_new_dataset() {
    killed_replacements(50);
}

#[test]
#[ignore = "takes a minute"]
fn fifty_killed_shards_are_continued() {
    killed_shards(50);
}
