//! Pointers: what Git leaves in place of a large file where its extension is missing.

use std::io::Read as _;
use std::path::Path;
use swm_core::{Error, Result};

/// The first lines of a pointer of Git LFS (which also stands for files in Xet storage), and of one of Git Xet.
const LFS: &[u8] = b"version https://git-lfs.github.com/spec/v1";
const XET: &[u8] = b"# xet version";
/// The largest pointer, in bytes.
const MAX_BYTES: u64 = 1024;
/// The most files of a folder that are looked at, and how deep folders are.
const MAX_FILES: usize = 10_000;
const MAX_DEPTH: usize = 6;

/// Checks that a file, or the files of a folder, are not pointers of Git LFS or Git Xet.
///
/// # Errors
/// When one is; the error says where the content is found.
pub fn check_no_pointer(path: &Path) -> Result<()> {
    let mut left = MAX_FILES;
    check(path, MAX_DEPTH, &mut left)
}

fn check(path: &Path, depth: usize, left: &mut usize) -> Result<()> {
    let Ok(found) = std::fs::metadata(path) else { return Ok(()) };
    if *left == 0 {
        return Ok(());
    }
    *left -= 1;
    if found.is_dir() {
        let entries = std::fs::read_dir(path).into_iter().flatten().flatten();
        return if depth == 0 {
            Ok(())
        } else {
            entries.map(|entry| entry.path()).try_for_each(|path| check(&path, depth - 1, left))
        };
    }
    // Files of the kernel, some of which block their reader, have no size.
    if !found.is_file() || found.len() == 0 || found.len() > MAX_BYTES {
        return Ok(());
    }
    let mut bytes = vec![];
    let Ok(file) = std::fs::File::open(path) else { return Ok(()) };
    if file.take(MAX_BYTES).read_to_end(&mut bytes).is_err() {
        return Ok(());
    }
    let name = match (bytes.starts_with(LFS), bytes.starts_with(XET)) {
        (true, _) => "Git LFS",
        (_, true) => "Git Xet",
        _ => return Ok(()),
    };
    let text = String::from_utf8_lossy(&bytes);
    let size =
        text.lines().find_map(|line| line.strip_prefix("size ")).and_then(|size| size.trim().parse::<u64>().ok());
    let size = size.map_or(String::new(), |size| format!(" of {size} bytes"));
    let problem =
        format!("is a pointer of {name} to a file{size}, not the file: Git fetched the repository without it");
    let fix = if name == "Git LFS" { "run `git lfs pull` in the repository" } else { "fetch it with Git Xet" };
    Err(Error::corrupt(path, problem, format!("{fix}, or download it with `swm pull hf://OWNER/NAME`")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pointers_are_named_in_files_and_folders() {
        let folder = tempfile::tempdir().expect("a folder");
        let inner = folder.path().join("rooms.lance").join("data");
        std::fs::create_dir_all(&inner).expect("a folder");
        std::fs::write(inner.join("a.lance"), [7; 2000]).expect("a file");
        check_no_pointer(folder.path()).expect("no pointer");
        let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n";
        std::fs::write(inner.join("b.lance"), pointer).expect("a file");
        let error = check_no_pointer(folder.path()).expect_err("a pointer").to_string();
        assert!(
            ["b.lance", "Git LFS", "12345 bytes", "git lfs pull"].iter().all(|part| error.contains(part)),
            "{error}"
        );
        std::fs::write(inner.join("b.lance"), "# xet version 0\nfilesize = 12\n").expect("a file");
        assert!(check_no_pointer(&inner.join("b.lance")).expect_err("a pointer").to_string().contains("Git Xet"));
        check_no_pointer(&folder.path().join("nothing")).expect("nothing there");
    }
}
