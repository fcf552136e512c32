//! Tests of reading, writing and deleting files.

use super::*;
use std::fs;

/// A new folder below the system's folder of temporary files.
fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("swm-files-{name}-{}", std::process::id()));
    fs::create_dir_all(&path).expect("creating the folder");
    path
}

#[test]
fn sparse_files_are_not_read() {
    let folder = folder("sparse");
    let path = folder.join("weights");
    for start in [&b""[..], b"a header"] {
        fs::write(&path, start).expect("writing the file");
        File::options().write(true).open(&path).and_then(|file| file.set_len(20 << 30)).expect("a longer file");
        let error = read(&path, u64::MAX).expect_err("a sparse file").to_string();
        assert!(error.contains("sparse") && error.contains("21474836480"), "{error}");
    }
    let long = vec![7; (LONG + 1) as usize];
    fs::write(&path, &long).expect("writing the file");
    assert!(read(&path, u64::MAX).expect("a file") == long);
    fs::remove_dir_all(&folder).expect("removing the folder");
}

#[test]
fn temporary_files_of_killed_writers_are_deleted() {
    let root = folder("temporary");
    for name in [".results.json.12.tmp", ".results.json.x.tmp", ".thesis.12.tmp", "results.json"] {
        fs::write(root.join(name), name).expect("writing a file");
    }
    delete_temporary(&root, |name| name == "results.json").expect("deleting");
    let mut left: Vec<_> = fs::read_dir(&root).expect("reading").flatten().map(|entry| entry.file_name()).collect();
    left.sort();
    assert_eq!(left, [".results.json.x.tmp", ".thesis.12.tmp", "results.json"]);
    fs::remove_dir_all(root).expect("cleaning up");
}

#[test]
fn delete_keeps_links_folders_and_names_that_match_no_pattern() {
    let root = folder("delete");
    let (run, outside) = (root.join("run"), root.join("outside.txt"));
    fs::create_dir_all(run.join("weights.bin.d")).expect("creating a folder");
    fs::write(&outside, "thesis").expect("writing a file");
    for name in ["config.json", "thesis.tex"] {
        fs::write(run.join(name), name).expect("writing a file");
    }
    std::os::unix::fs::symlink(&outside, run.join("weights.bin")).expect("making a link");
    fs::create_dir_all(run.join("logs/old")).expect("creating a folder");
    fs::write(run.join("logs/run-1.log"), "").expect("writing a file");
    let patterns = ["config.json", "weights.bin", "weights.bin.d", "logs/run-*.log", "outside/*"];

    let remaining = delete(&run, &patterns).expect("deleting the files");
    assert_eq!(remaining, ["logs", "thesis.tex", "weights.bin", "weights.bin.d"].map(|name| run.join(name)));
    assert!(!run.join("config.json").exists() && !run.join("logs/run-1.log").exists());
    assert!(run.join("logs/old").is_dir(), "a folder without a deleted file stays");
    assert_eq!(fs::read_to_string(&outside).expect("reading the file outside the folder"), "thesis");

    std::os::unix::fs::symlink(&run, root.join("link")).expect("making a link");
    assert!(delete(&root.join("link"), &["*"]).is_err());
    assert!(run.join("thesis.tex").exists());
    fs::remove_dir_all(&root).expect("removing the folder of the test");
}

#[test]
fn delete_removes_folders_that_it_empties() {
    let root = folder("empty");
    fs::create_dir_all(root.join("a/b")).expect("creating folders");
    fs::write(root.join("a/b/c.txt"), "").expect("writing a file");
    assert!(delete(&root, &["a/*/c.txt"]).expect("deleting the files").is_empty());
    assert!(!root.exists());
    assert!(delete(&root, &["a"]).expect("deleting in a missing folder").is_empty());
}

#[test]
fn reads_regular_files_up_to_the_limit() {
    let root = folder("read");
    let path = root.join("file");
    write(&path, b"four").expect("writing the file");
    assert_eq!(read(&path, 4).expect("reading the file"), b"four");
    assert!(read(&path, 3).expect_err("a longer file").to_string().contains("longer than 3 bytes"));
    assert!(read(Path::new("/dev/zero"), 10).expect_err("reading a device").to_string().contains("not a regular file"));
    assert!(read(&root, 10).expect_err("reading a folder").to_string().contains("is a folder"));
    delete_file(&path).expect("deleting the file");
    fs::remove_dir(&root).expect("removing the empty folder");
}

#[test]
fn outputs_without_permission_to_read_are_called_so() {
    let root = folder("permission");
    let path = root.join("index.html");
    write(&path, b"other").expect("writing the file");
    let check =
        || check_own(&path, |path| read(path, 10).is_ok_and(|bytes| bytes == b"own")).map_err(|e| e.to_string());
    assert!(check().expect_err("a file of another program").contains("not written by this program"));
    fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o000)).expect("changing the permissions");
    // The superuser reads every file.
    if File::open(&path).is_err() {
        let error = check().expect_err("a file that cannot be read");
        assert!(error.contains("no permission to read it") && error.contains("change the permissions"), "{error}");
    }
    fs::remove_dir_all(&root).expect("removing the folder of the test");
}

#[test]
fn missing_is_told_from_what_cannot_be_read() {
    let root = folder("exists");
    fs::write(root.join("file"), "").expect("writing a file");
    std::os::unix::fs::symlink(root.join("loop"), root.join("loop")).expect("making a link");
    for (name, exists_there) in
        [("", true), ("file", true), ("none", false), ("none/below", false), ("file/below", false)]
    {
        assert_eq!(exists(&root.join(name)).expect("known"), exists_there, "{name}");
    }
    assert_eq!(entries(&root).expect("listing"), ["file", "loop"].map(|name| root.join(name)));
    assert_eq!(["none", "file"].map(|name| entries(&root.join(name)).expect("no folder").len()), [0, 0]);
    for error in [exists(&root.join("loop/below")).map(drop), entries(&root.join("loop")).map(drop)] {
        assert!(matches!(error, Err(Error::Io { .. })), "{error:?}");
    }
    fs::remove_dir_all(&root).expect("removing the folder of the test");
}
