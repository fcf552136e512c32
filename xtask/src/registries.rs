//! Checks that every `pub const ENTRY` is in a registry list of its crate.

use crate::source::{self, File};

/// Returns a sentence for each entry that is in no list.
pub fn violations(files: &[File]) -> Vec<String> {
    let code: Vec<(&File, String)> =
        files.iter().map(|file| (file, source::without_tests(&source::code(&file.text)))).collect();
    let mut found = vec![];
    for (file, text) in &code {
        if !text.contains("pub const ENTRY:") {
            continue;
        }
        let path = file.path.trim_end_matches(".rs").trim_end_matches("/mod");
        let name = path.rsplit('/').next().unwrap_or_default();
        let owner = file.path.split("/src/").next().unwrap_or_default();
        let listed = code.iter().any(|(other, text)| {
            other.path.starts_with(&format!("{owner}/src/")) && text.contains(&format!("{name}::ENTRY"))
        });
        if !listed {
            found.push(format!("{}: no list of the crate holds `{name}::ENTRY`", file.path));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unlisted_entry_is_a_violation() {
        let file = |path: &str, text: &str| File { path: path.to_owned(), text: text.to_owned() };
        let cem = file("crates/p/src/solvers/cem.rs", "pub const ENTRY: Entry = Entry {};");
        let room = file("crates/p/src/room/mod.rs", "pub const ENTRY: Entry = Entry {};");
        let list = file("crates/p/src/lib.rs", "const ROWS: &[Entry] = &[solvers::cem::ENTRY]; // room::ENTRY");
        let found = violations(&[cem, room, list]);
        assert!(found.len() == 1 && found[0].contains("room/mod.rs"), "{found:?}");
    }
}
