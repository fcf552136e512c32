//! Checks that only `swm_core::files` deletes: the one module that removes nothing but files that the program wrote.

use crate::source::{self, File};

/// The module that deletes.
const HOME: &str = "crates/swm-core/src/files.rs";

/// Calls that delete in Rust.
const RUST: &[&str] = &["remove_dir_all(", "remove_dir(", "remove_file("];

/// Calls that delete in Python.
const PYTHON: &[&str] = &["rmtree(", "os.remove(", "os.removedirs(", "os.rmdir(", ".unlink(", ".rmdir("];

/// Files that delete by themselves, and why. An entry whose file no longer deletes is a violation.
const ALLOWED: &[(&str, &str)] = &[
    ("crates/swm-bench/src/reference/data.py", "runs in the Python of the reference, in a folder that it made"),
    ("python/stable_worldmodel/_files.py", "temporary files beside their targets, which it made"),
];

/// Whether the check covers a file: not tests, which delete their own folders, and not the tools of developers.
fn covered(path: &str) -> bool {
    let is_test = path.contains("/tests/") || path.ends_with("/tests.rs");
    !path.starts_with("xtask/") && !path.starts_with("fuzz/") && !is_test && path != HOME
}

/// Returns a sentence for each call that deletes outside the module, and for each exception that is no longer needed.
pub fn violations(files: &[File]) -> Vec<String> {
    violations_except(files, ALLOWED)
}

fn violations_except(files: &[File], allowed: &[(&str, &str)]) -> Vec<String> {
    let mut found = vec![];
    let mut needed = vec![];
    for file in files.iter().filter(|file| covered(&file.path)) {
        let (code, calls) = match file.path.ends_with(".rs") {
            true => (source::without_tests(&source::code(&file.text)), RUST),
            false => (file.text.clone(), PYTHON),
        };
        for (number, line) in code.lines().enumerate() {
            let Some(call) = calls.iter().find(|call| line.contains(**call)) else { continue };
            match allowed.iter().find(|(path, _)| *path == file.path) {
                Some((path, _)) => needed.push(*path),
                None => found.push(format!("{}:{}: {call}): use `swm_core::files`", file.path, number + 1)),
            }
        }
    }
    let unneeded = allowed.iter().filter(|(path, _)| !needed.contains(path));
    found.extend(unneeded.map(|(path, _)| format!("{path} deletes nothing: remove it from xtask/src/deletes.rs")));
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deleting_outside_the_files_module_is_a_violation() {
        let file = |path: &str, text: &str| File { path: path.to_owned(), text: text.to_owned() };
        let text = "// remove_file(a)\nfn a() { std::fs::remove_file(b) }\n#[cfg(test)]\nmod tests { fn c() { fs::remove_dir_all(d) } }";
        let files = [
            file(HOME, text),
            file("crates/a/tests/it/main.rs", text),
            file("crates/a/src/allowed.rs", text),
            file("crates/a/examples/b.rs", text),
            file("python/stable_worldmodel/c.py", "shutil.rmtree(path)"),
        ];
        let found = violations_except(&files, &[("crates/a/src/allowed.rs", "a reason"), ("crates/a/src/old.rs", "")]);
        assert_eq!(found.len(), 3, "{found:?}");
        assert!(found[0].starts_with("crates/a/examples/b.rs:2: remove_file("), "{found:?}");
        assert!(found[1].starts_with("python/stable_worldmodel/c.py:1: rmtree("), "{found:?}");
        assert!(found[2].starts_with("crates/a/src/old.rs deletes nothing"), "{found:?}");
    }
}
