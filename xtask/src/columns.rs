//! Checks that the names of standard columns are string literals in `swm-core` only.

use crate::source::File;

/// The file that defines the names.
const HOME: &str = "crates/swm-core/src/columns";

/// Names that are used for columns only. (`action` and `goal`, for example, are also settings and JSON fields.)
const NAMES: &[&str] =
    &["\"pixels\"", "\"terminated\"", "\"truncated\"", "\"episode_idx\"", "\"step_idx\"", "\"variation."];

/// Returns a sentence for each literal outside the defining file. Unit tests, at the end of a file, may use literals.
pub fn violations(files: &[File]) -> Vec<String> {
    let mut found = vec![];
    for file in files.iter().filter(|file| !file.path.starts_with(HOME) && !file.path.starts_with("xtask/")) {
        let code = file.text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
        for (number, line) in code.lines().enumerate() {
            let line = line.trim_start();
            if line.starts_with("//") || line.contains("serde(") {
                continue;
            }
            if let Some(name) = NAMES.iter().find(|name| line.contains(**name)) {
                found.push(format!("{}:{}: {name}: use the constant of `swm_core::columns`", file.path, number + 1));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn column_name_literals_outside_the_columns_module_are_violations() {
        let file = |path: &str, text: &str| File { path: path.to_owned(), text: text.to_owned() };
        let text = "let a = \"pixels\";\n// \"pixels\"\n#[cfg(test)]\nmod tests { const A: &str = \"pixels\"; }";
        assert_eq!(violations(&[file("crates/swm-core/src/columns.rs", text)]), Vec::<String>::new());
        let found = violations(&[file("crates/a/src/b.rs", text)]);
        assert!(found.len() == 1 && found[0].starts_with("crates/a/src/b.rs:1:"), "{found:?}");
    }
}
