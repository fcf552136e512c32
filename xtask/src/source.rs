//! The tracked source files of the workspace, and Rust source without its comments, strings and unit tests.

use anyhow::{Context as _, Result, bail};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A file of the repository.
#[derive(Debug)]
pub struct File {
    /// The path from the root, with `/` between folders.
    pub path: String,
    /// The content.
    pub text: String,
}

/// The files that git tracks, or would track, whose names end in one of `endings`, sorted by path.
pub fn files(root: &Path, endings: &[&str]) -> Result<Vec<File>> {
    let listed = Command::new("git")
        .args(["ls-files", "--cached", "--others", "--exclude-standard"])
        .current_dir(root)
        .output()
        .context("running `git ls-files`")?;
    if !listed.status.success() {
        bail!("`git ls-files` failed: {}", String::from_utf8_lossy(&listed.stderr));
    }
    let listed = String::from_utf8(listed.stdout).context("a file name is not UTF-8")?;
    let mut paths: Vec<&str> =
        listed.lines().filter(|path| endings.iter().any(|ending| path.ends_with(ending))).collect();
    paths.sort_unstable();
    paths.dedup();
    let mut files = vec![];
    for path in paths {
        let full: PathBuf = root.join(path);
        // A deleted file stays listed until the deletion is staged.
        if full.is_file() {
            let text = std::fs::read_to_string(&full).with_context(|| format!("reading {path}"))?;
            files.push(File { path: path.to_owned(), text });
        }
    }
    Ok(files)
}

/// Rust source with comments, string literals and character literals replaced by spaces. Line numbers do not change.
pub fn code(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    let mut previous = ' ';
    while let Some(c) = rest.chars().next() {
        let skipped = skipped(rest, previous);
        if skipped > 0 {
            out.extend(rest[..skipped].chars().map(|c| if c == '\n' { '\n' } else { ' ' }));
            rest = &rest[skipped..];
            previous = ' ';
        } else {
            out.push(c);
            previous = c;
            rest = &rest[c.len_utf8()..];
        }
    }
    out
}

/// Returns the length in bytes of the comment or literal at the start of `rest`; 0 if there is none.
fn skipped(rest: &str, previous: char) -> usize {
    let end_of = |from: usize, end: &str| rest[from..].find(end).map_or(rest.len(), |at| from + at + end.len());
    if rest.starts_with("//") {
        return rest.find('\n').unwrap_or(rest.len());
    }
    if rest.starts_with("/*") {
        return end_of(2, "*/");
    }
    let word = previous.is_alphanumeric() || previous == '_';
    if !word && let Some(raw) = rest.strip_prefix("br").or_else(|| rest.strip_prefix('r')) {
        let hashes = raw.len() - raw.trim_start_matches('#').len();
        if raw[hashes..].starts_with('"') {
            let open = rest.len() - raw.len() + hashes + 1;
            return end_of(open, &format!("\"{}", "#".repeat(hashes)));
        }
    }
    if rest.starts_with('"') {
        let mut escaped = false;
        for (at, c) in rest.char_indices().skip(1) {
            match c {
                '"' if !escaped => return at + 1,
                '\\' => escaped = !escaped,
                _ => escaped = false,
            }
        }
        return rest.len();
    }
    if let Some(inner) = rest.strip_prefix('\'') {
        let mut chars = inner.char_indices();
        match chars.next() {
            Some((_, '\\')) => return inner[2..].find('\'').map_or(0, |at| 1 + 2 + at + 1),
            // A lifetime has no closing quote right after its first character.
            Some((_, c)) if inner[c.len_utf8()..].starts_with('\'') => return 1 + c.len_utf8() + 1,
            _ => {}
        }
    }
    0
}

/// Rust source, as [`code`] returns it, without its `#[cfg(test)]` modules.
pub fn without_tests(code: &str) -> String {
    let mut out = code.to_owned();
    while let Some(start) = out.find("#[cfg(test)]") {
        let body = &out[start..];
        let end = match (body.find('{'), body.find(';')) {
            (Some(open), semicolon) if semicolon.is_none_or(|at| open < at) => {
                let mut depth = 0usize;
                let close = body.char_indices().skip(open).find(|&(_, c)| {
                    match c {
                        '{' => depth += 1,
                        '}' => depth -= 1,
                        _ => {}
                    }
                    depth == 0
                });
                close.map_or(body.len(), |(at, _)| at + 1)
            }
            (_, Some(at)) => at + 1,
            _ => body.len(),
        };
        let blank: String = body[..end].chars().map(|c| if c == '\n' { '\n' } else { ' ' }).collect();
        out.replace_range(start..start + end, &blank);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_and_literals_become_spaces() {
        let text = "let a = \"use crate::x; \\\" {\"; // use b\nlet c = 'x'; let d: &'a str = r#\"{\"#; /* { */ let e = '\\'';";
        let code = code(text);
        assert_eq!(code.len(), text.len());
        for removed in ["use", "{", "b\n"] {
            assert!(!code.contains(removed), "{removed} in {code}");
        }
        for kept in ["let a =", "let c =", "&'a str", "let e ="] {
            assert!(code.contains(kept), "{kept} not in {code}");
        }
    }

    #[test]
    fn test_modules_are_removed() {
        let text =
            "fn a() { b() }\n#[cfg(test)]\nmod tests { fn c() { d() } }\nfn e() {}\n#[cfg(test)]\nmod far;\nfn g() {}";
        let rest = without_tests(text);
        assert!(rest.contains("fn a") && rest.contains("fn e") && rest.contains("fn g"));
        assert!(!rest.contains("fn c") && !rest.contains("far"));
        assert_eq!(rest.lines().count(), text.lines().count());
    }
}
