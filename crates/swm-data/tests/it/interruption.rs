//! Writers that are killed or run out of disk space keep committed episodes and leave no partial episodes.

use crate::full_disk::SmallDisk;
use crate::sample::{check, episode, options, schema, write};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
use swm_data::{CommitPolicy, WriteMode, WriteOptions, create, open};

/// Environment variable of child processes: the path to write to.
const TARGET: &str = "SWM_TEST_CHILD_TARGET";

/// A child process of the tests below. Writes episodes and prints a line for each, until writing fails; then prints the
/// error.
#[test]
fn child_that_writes() {
    let Some(path) = std::env::var_os(TARGET).map(PathBuf::from) else { return };
    let commit = CommitPolicy { episodes: 3, interval: Duration::from_millis(20), ..CommitPolicy::default() };
    let mut writer =
        create(&path, &schema(), WriteOptions { commit, ..options(WriteMode::Append) }).expect("creating the dataset");
    for e in writer.episodes()..100_000 {
        if let Err(error) = writer.write_episode(&episode(e)) {
            println!("failed: {error}");
            assert!(writer.finish().is_err(), "`finish` reports that a commit failed");
            return;
        }
        println!("episode {e}");
    }
}

/// The command that runs a child test after `shell` has set the limits of the process.
fn run_child(test: &str, path: &Path, shell: &str) -> Command {
    let mut command = Command::new("sh");
    let program = std::env::current_exe().expect("finding the test executable");
    command.args(["-c", &format!("{shell} exec \"$0\" --exact interruption::{test} --nocapture")]).arg(program);
    command.env(TARGET, path).stdout(Stdio::piped()).stderr(Stdio::null());
    command
}

/// A child process that opens the dataset with few file descriptors.
#[test]
fn child_that_reads() {
    let Some(path) = std::env::var_os(TARGET).map(PathBuf::from) else { return };
    let reader = open(&path).expect("opening the dataset");
    check(&*reader, 0);
    println!("read {} episodes", reader.episodes().len());
}

#[test]
fn opens_many_fragments_with_few_file_descriptors() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 1, 0..170);
    let output = run_child("child_that_reads", &path, "ulimit -n 160;").output().expect("running the child process");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("read 170 episodes"), "{text}");
}

#[test]
fn killed_writer_keeps_committed_episodes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let mut stored = 0;
    for written in [7, 20, 33] {
        let mut child = run_child("child_that_writes", &path, "").spawn().expect("starting the child process");
        let mut lines = BufReader::new(child.stdout.take().expect("the output of the child process")).lines();
        let mut seen = 0;
        while seen < written {
            let line = lines.next().expect("another line").expect("a line of text");
            seen += usize::from(line.contains("episode "));
        }
        child.kill().expect("killing the child process");
        child.wait().expect("waiting for the child process");
        let reader = open(&path).expect("opening the dataset");
        // A commit has three episodes; two more may wait for the committing thread, and three may be in progress.
        let now = reader.episodes().len();
        assert!(now + 9 > stored + written, "{now} episodes of {}", stored + written);
        check(&*reader, 0);
        stored = now;
    }
    write(&path, WriteMode::Append, 2, stored..stored + 2);
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), stored + 2);
    check(&*reader, 0);
}

/// Runs the child until writing fails, and checks the error and the dataset.
fn write_until_failure(path: &Path, shell: &str, expected: &str) {
    let output = run_child("child_that_writes", path, shell).output().expect("running the child process");
    let text = String::from_utf8_lossy(&output.stdout);
    let failure = text.lines().find(|line| line.starts_with("failed: ")).unwrap_or_else(|| panic!("{text}"));
    assert!(failure.contains(expected), "{failure}");
    let written = text.lines().filter(|line| line.starts_with("episode ")).count();
    let reader = open(path).expect("opening the dataset");
    assert!(reader.episodes().len() + 9 > written, "{} of {written}", reader.episodes().len());
    check(&*reader, 0);
}

#[test]
fn file_size_limit_keeps_committed_episodes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 1, 0..4);
    // A fragment of three episodes is larger than 8 blocks; the existing manifests are smaller.
    write_until_failure(&path, "trap '' XFSZ; ulimit -f 8;", "File too large");
    assert_eq!(open(&path).expect("opening the dataset").episodes().len(), 4);
}

#[test]
fn full_disk_keeps_committed_episodes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let Some(_mounted) = SmallDisk::mount(folder.path(), "1m") else { return };
    write_until_failure(&folder.path().join("d.lance"), "", "No space left on device");
}
