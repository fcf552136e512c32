//! A full disk: every format keeps the finished episodes that fit, and the error states how many are stored.
//!
//! A child process writes with a limit on the size of files, or on a small file system if the test may mount one.

use crate::sample::{check, episode, options, schema, write};
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_data::{CommitPolicy, WriteMode, WriteOptions, create, open};

/// Environment variable of child processes: the path to write to.
const TARGET: &str = "SWM_TEST_FULL_DISK";
/// Environment variable of child processes: the number of episodes to write.
const EPISODES: &str = "SWM_TEST_FULL_DISK_EPISODES";

/// Environment variable of child processes: whether to replace the dataset.
const REPLACES: &str = "SWM_TEST_FULL_DISK_REPLACES";

/// A child process. Writes episodes without a commit until writing fails; then prints the error.
#[test]
fn child_that_fills_the_disk() {
    let Some(path) = std::env::var_os(TARGET).map(PathBuf::from) else { return };
    let commit = CommitPolicy { interval: std::time::Duration::from_secs(600), ..CommitPolicy::default() };
    let mode = if std::env::var_os(REPLACES).is_some() { WriteMode::Overwrite } else { WriteMode::Create };
    let mut writer = create(&path, &schema(), WriteOptions { commit, ..options(mode) }).expect("creating");
    let episodes: usize = std::env::var(EPISODES).ok().and_then(|count| count.parse().ok()).expect("a count");
    let finished = (0..episodes).try_for_each(|e| writer.write_episode(&episode(e))).and_then(|()| writer.finish());
    match finished {
        Err(error) => println!("failed: {error}"),
        Ok(()) => println!("failed: it did not fill the disk"),
    }
}

/// Writes until the disk is full, and returns the number of stored episodes and the error.
fn fill(path: &Path, limit: &str, episodes: usize) -> (usize, String) {
    fill_with(path, limit, episodes, &[])
}

fn fill_with(path: &Path, limit: &str, episodes: usize, variables: &[(&str, &str)]) -> (usize, String) {
    let mut command = Command::new("sh");
    let child = "exec \"$0\" --exact full_disk::child_that_fills_the_disk --nocapture";
    command.args(["-c", &format!("{limit} {child}")]).arg(std::env::current_exe().expect("the test executable"));
    command.envs(variables.iter().copied());
    let output = command.env(TARGET, path).env(EPISODES, episodes.to_string()).output().expect("running the child");
    let text = String::from_utf8_lossy(&output.stdout);
    let failure = text.lines().find_map(|line| line.split_once("failed: ")).unwrap_or_else(|| {
        panic!("{text}\n{}", String::from_utf8_lossy(&output.stderr));
    });
    let reader = open(path).expect("opening");
    check(&*reader, 0);
    (reader.episodes().len(), failure.1.to_owned())
}

fn check_error(stored: usize, error: &str, format: &str) {
    let expected =
        if stored == 1 { "(1 episode is stored)".to_owned() } else { format!("({stored} episodes are stored)") };
    assert!(error.contains(&expected), "{format}: {error}");
}

#[test]
fn replacement_that_does_not_fit_keeps_the_old_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "h5", "lerobot"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..3);
        let before = folder.path().read_dir().expect("listing").count();
        for blocks in [0, 1, 2, 4] {
            let limit = format!("trap '' XFSZ; ulimit -f {blocks};");
            let (stored, error) = fill_with(&path, &limit, 60, &[(REPLACES, "yes")]);
            if stored == 3 {
                assert!(!error.contains("did not fill"), "{format}: {error}");
            }
            assert!(stored > 0, "{format}, {blocks}: {error}");
            let aside = ["ep_len.replaced", "meta/replaced"].map(|name| path.join(name).exists());
            assert_eq!(aside, [false; 2], "{format}, {blocks}: nothing is left aside");
        }
        assert_eq!(folder.path().read_dir().expect("listing").count(), before, "{format}: nothing is beside it");
    }
}

#[test]
fn largest_file_keeps_what_fits() {
    let folder = tempfile::tempdir().expect("creating a folder");
    // Column files and Lance write one file per commit; a file of HDF5 is larger from the start.
    for (format, blocks, episodes) in [("folder", 32, 60), ("video", 32, 60), ("h5", 2560, 2_000), ("lance", 20, 60)] {
        let path = folder.path().join(format!("data.{format}"));
        let (stored, error) = fill(&path, &format!("trap '' XFSZ; ulimit -f {blocks};"), episodes);
        assert!(error.contains("File too large") && stored > 0, "{format}, {stored} episodes: {error}");
        check_error(stored, &error, format);
    }
}

/// A small file system in memory, until it is dropped.
pub(crate) struct SmallDisk<'a>(&'a Path);

impl<'a> SmallDisk<'a> {
    /// Mounts a file system of this size over a folder; `None` without the right to mount.
    pub fn mount(folder: &'a Path, size: &str) -> Option<Self> {
        let options = format!("size={size}");
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", &options, "tmpfs"]).arg(folder).output();
        if !mount.is_ok_and(|output| output.status.success()) {
            println!("SKIPPED: mounting a small file system needs more rights than this test has");
            return None;
        }
        Some(Self(folder))
    }
}

impl Drop for SmallDisk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

#[test]
fn full_disk_keeps_what_fits() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let Some(mounted) = SmallDisk::mount(folder.path(), "4m") else { return };
    // The first commit of HDF5 allocates a chunk for every column.
    let formats =
        [("folder", 96, 200), ("video", 64, 200), ("h5", 2048, 2_000), ("lance", 96, 100), ("lerobot", 64, 200)];
    for (format, free, episodes) in formats {
        let (path, ballast) = (mounted.0.join(format!("data.{format}")), mounted.0.join("ballast"));
        std::fs::write(&ballast, vec![1; (4 << 20) - (free << 10)]).expect("filling the disk");
        let (stored, error) = fill(&path, "", episodes);
        // LeRobot stores the episodes of a commit in the same files, all or none.
        assert!(error.contains("No space left") && (stored > 0 || format == "lerobot"), "{format}: {error}");
        check_error(stored, &error, format);
        match path.is_dir() {
            true => std::fs::remove_dir_all(&path).expect("removing the dataset"),
            false => std::fs::remove_file(&path).expect("removing the dataset"),
        }
    }
}
