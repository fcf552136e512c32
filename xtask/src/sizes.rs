//! Checks the length of source files. (Clippy's `too_many_lines` checks the length of functions.)

use crate::source::File;

/// The maximum number of lines of a file, unit tests included.
const MOST: usize = 500;

/// Returns a sentence for each file that is too long.
pub fn violations(files: &[File]) -> Vec<String> {
    let long = files.iter().map(|file| (file, file.text.lines().count())).filter(|(_, lines)| *lines > MOST);
    long.map(|(file, lines)| format!("{}: {lines} lines (at most {MOST}): split it by concept", file.path)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_file_is_a_violation() {
        let file = |lines: usize| File { path: "a.rs".to_owned(), text: "x\n".repeat(lines) };
        assert_eq!(violations(&[file(MOST)]), Vec::<String>::new());
        assert!(violations(&[file(MOST + 1)])[0].contains("501 lines"));
    }
}
