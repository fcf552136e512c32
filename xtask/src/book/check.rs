//! Checks of the finished pages: every link outside the pages of rustdoc leads to a file, and nothing is loaded from the network.

use anyhow::{Result, bail};
use std::path::{Path, PathBuf};

/// Checks all pages below a folder.
///
/// # Errors
/// If a link leads to no file, or a page loads a script, a style sheet, a font or an image from elsewhere.
pub fn site(folder: &Path) -> Result<()> {
    let mut found = vec![];
    let mut pages = vec![];
    html_files(folder, &mut pages)?;
    for page in &pages {
        let text = std::fs::read_to_string(page)?;
        let problems = problems(folder, page, &text);
        found.extend(problems.into_iter().map(|problem| format!("{}: {problem}", page.display())));
    }
    if !found.is_empty() {
        bail!("the book has {} faults\n  {}", found.len(), found.join("\n  "));
    }
    println!(
        "book: {} pages, every link outside the pages of rustdoc leads to a file, nothing is loaded from the network",
        pages.len()
    );
    Ok(())
}

fn html_files(folder: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            html_files(&path, found)?;
        } else if path.extension().is_some_and(|extension| extension == "html") {
            found.push(path);
        }
    }
    Ok(())
}

/// Returns a sentence for each fault of a page.
fn problems(root: &Path, page: &Path, text: &str) -> Vec<String> {
    let mut found = vec![];
    // mdBook's page for unknown addresses names files from the root of the site.
    let folder = if page.ends_with("404.html") { root } else { page.parent().unwrap_or(root) };
    // rustdoc checks the links of our crates; texts of other crates, which traits bring with them, link to their own pages.
    let is_of_rustdoc = page.starts_with(root.join("interface/rust"));
    for (attribute, loads) in [(" src=\"", true), (" href=\"", false)] {
        for (at, _) in text.match_indices(attribute) {
            let rest = &text[at + attribute.len()..];
            let target = rest.split('"').next().unwrap_or_default();
            let tag = &text[text[..at].rfind('<').unwrap_or(0)..at];
            let is_remote = target.contains("://") || target.starts_with("//");
            if is_remote && (loads || tag.starts_with("<link")) {
                found.push(format!("{target} is loaded from the network"));
            }
            let path = target.split(['#', '?']).next().unwrap_or_default();
            // `${` begins an expression in a script.
            let is_local = !is_remote && !path.is_empty() && !path.contains(':') && !path.contains("${");
            if is_local && !is_of_rustdoc && !folder.join(path).exists() {
                found.push(format!("{target} leads to no file"));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remote_files_and_missing_pages_are_faults() {
        let (root, page) = (Path::new("/no such folder"), Path::new("/no such folder/a.html"));
        let text = "<script src=\"https://x.org/a.js\"></script><a href=\"https://x.org\">x</a><a href=\"b.html#c\">b</a>\
                    <a href=\"#d\">d</a><link rel=\"icon\" href=\"//x.org/i.svg\">";
        let found = problems(root, page, text);
        assert_eq!(found.len(), 3, "{found:?}");
        assert!(found[0].contains("a.js is loaded") && found[1].contains("b.html#c leads to no file"), "{found:?}");
        let of_rustdoc = Path::new("/no such folder/interface/rust/swm/a.html");
        assert_eq!(problems(root, of_rustdoc, text).len(), 2);
        assert!(problems(root, page, "<a href=\"${url}\">").is_empty());
    }
}
