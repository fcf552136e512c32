//! Checks that all builds compile a library with the same features, so that each library is compiled only once.
//!
//! Cargo unifies features over the packages that one command builds. `workspace-hack` gives the large libraries equal
//! features in all builds (the program, the Python extension, the tests). This check compares the features that Cargo
//! resolves for each build.

use anyhow::{Context as _, Result, bail};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

/// A build: its name, the selected packages, and whether the build includes tests.
const BUILDS: &[(&str, &[&str], bool)] = &[
    ("the tests", &["--workspace"], true),
    ("the program", &["-p", "swm"], false),
    ("the Python extension", &["-p", "swm-python"], false),
    ("the tests of swm-data", &["-p", "swm-data"], true),
    ("the tests of swm-models", &["-p", "swm-models"], true),
    ("the fuzzers", &["-p", "swm-fuzz", "--features", "libfuzzer"], false),
];

/// Libraries with their features, by name and version.
type Features = BTreeMap<String, BTreeSet<String>>;

/// Returns a sentence for each library that the tests and another build compile with different features.
pub fn violations(root: &Path) -> Result<Vec<String>> {
    let resolved: Vec<(&str, Features)> = BUILDS
        .iter()
        .map(|(name, select, tests)| Ok((*name, features(root, select, *tests)?)))
        .collect::<Result<_>>()?;
    let (tests, all) = &resolved[0];
    let mut found = vec![];
    for (name, features) in &resolved[1..] {
        for (library, sets) in features {
            let missing: Vec<&String> =
                sets.iter().filter(|set| all.get(library).is_some_and(|sets| !sets.contains(*set))).collect();
            if let [set, ..] = missing[..] {
                let sets: Vec<&str> = all.get(library).into_iter().flatten().map(String::as_str).collect();
                found.push(format!(
                    "{library} has the features [{set}] in {name}, [{}] in {tests}: name them in crates/workspace-hack/Cargo.toml",
                    sets.join("] or [")
                ));
            }
        }
    }
    Ok(found)
}

fn features(root: &Path, select: &[&str], tests: bool) -> Result<Features> {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let edges = if tests { "normal,dev" } else { "normal" };
    let output = Command::new(program)
        .args(["tree", "--locked", "--edges", edges, "--prefix", "none", "--format", "{p}\t{f}"])
        .args(select)
        .current_dir(root)
        .output()
        .context("starting `cargo tree`")?;
    if !output.status.success() {
        bail!("`cargo tree` failed: {}", String::from_utf8_lossy(&output.stderr));
    }
    let text = String::from_utf8(output.stdout).context("`cargo tree` printed no UTF-8")?;
    Ok(parse(&text))
}

/// The libraries of other packages in the output of `cargo tree`, without procedural macros, which are built for the
/// host.
fn parse(text: &str) -> Features {
    let mut all = Features::new();
    for line in text.lines() {
        let Some((package, features)) = line.trim_end_matches(" (*)").split_once('\t') else { continue };
        if !package.contains('(') {
            all.entry(package.to_owned()).or_default().insert(features.to_owned());
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_of_members_and_procedural_macros_are_left_out() {
        let features = parse(
            "swm v0.1.0 (/w/swm)\t\nserde v1.0.1\tderive,std\nserde v1.0.1\tderive,std (*)\nm v1 (proc-macro)\tx\n",
        );
        assert_eq!(features.len(), 1);
        assert_eq!(features["serde v1.0.1"].iter().collect::<Vec<_>>(), ["derive,std"]);
    }
}
