//! Links of Markdown pages: finding them, resolving them against the repository, and the check that all of them lead
//! somewhere.

use crate::source::File;
use pulldown_cmark::{Event, Options, Parser, Tag, TagEnd};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

/// The table of contents of the book.
pub const SUMMARY: &str = "docs/SUMMARY.md";

/// A link or an image of a page.
#[derive(Debug, PartialEq)]
pub struct Link {
    /// The bytes of the whole link in the text of the page.
    pub range: Range<usize>,
    /// The bytes of what the reader sees: the text between the brackets.
    pub label: Range<usize>,
    /// Where it leads, as written.
    pub target: String,
    /// Whether it is an image.
    pub image: bool,
}

/// Where a link leads.
#[derive(Debug, PartialEq)]
pub enum Target<'a> {
    /// A page on the web.
    Web,
    /// A file or folder of the repository, from its root, and the heading after `#` (empty for none).
    File(String, &'a str),
    /// A path that leaves the repository.
    Outside,
}

/// The extensions of Markdown that GitHub and mdBook share.
pub fn options() -> Options {
    Options::ENABLE_TABLES | Options::ENABLE_STRIKETHROUGH | Options::ENABLE_FOOTNOTES
}

/// Returns the links and images of a page, in order. Code has none.
pub fn links(text: &str) -> Vec<Link> {
    let mut found: Vec<Link> = vec![];
    let mut open = vec![];
    for (event, range) in Parser::new_ext(text, options()).into_offset_iter() {
        match event {
            Event::Start(Tag::Link { dest_url, .. }) => {
                open.push(found.len());
                found.push(Link {
                    label: range.start..range.start,
                    range,
                    target: dest_url.into_string(),
                    image: false,
                });
            }
            Event::Start(Tag::Image { dest_url, .. }) => {
                open.push(found.len());
                found.push(Link {
                    label: range.start..range.start,
                    range,
                    target: dest_url.into_string(),
                    image: true,
                });
            }
            Event::End(TagEnd::Link | TagEnd::Image) => {
                open.pop();
            }
            _ => {
                for link in open.iter().copied() {
                    let label = &mut found[link].label;
                    *label = if label.start == label.end { range.clone() } else { label.start..range.end };
                }
            }
        }
    }
    found
}

/// Returns where a link of the page at `page` leads.
pub fn resolve<'a>(page: &str, target: &'a str) -> Target<'a> {
    if target.contains("://") || target.starts_with("mailto:") {
        return Target::Web;
    }
    let (path, heading) = target.split_once('#').unwrap_or((target, ""));
    if path.is_empty() {
        return Target::File(page.to_owned(), heading);
    }
    let folder = page.rsplit_once('/').map_or("", |(folder, _)| folder);
    let mut parts: Vec<&str> = folder.split('/').filter(|part| !part.is_empty()).collect();
    for part in path.split('/') {
        match part {
            "" | "." => {}
            ".." => {
                if parts.pop().is_none() {
                    return Target::Outside;
                }
            }
            name => parts.push(name),
        }
    }
    Target::File(parts.join("/"), heading)
}

/// Returns the ids of a page's headings, as GitHub and mdBook form them.
pub fn headings(text: &str) -> BTreeSet<String> {
    let mut ids = BTreeSet::new();
    let mut heading: Option<String> = None;
    for event in Parser::new_ext(text, options()) {
        match event {
            Event::Start(Tag::Heading { .. }) => heading = Some(String::new()),
            Event::End(TagEnd::Heading(_)) => {
                let id = id_of(&heading.take().unwrap_or_default());
                let repeated = (1..).map(|n| format!("{id}-{n}"));
                let free = std::iter::once(id.clone()).chain(repeated).find(|id| !ids.contains(id));
                ids.extend(free);
            }
            Event::Text(text) | Event::Code(text) => {
                if let Some(heading) = &mut heading {
                    heading.push_str(&text);
                }
            }
            _ => {}
        }
    }
    ids
}

/// Returns the id of a heading: lower case, hyphens for spaces, no punctuation.
fn id_of(heading: &str) -> String {
    let kept = heading.trim().chars().filter_map(|c| match c {
        c if c.is_alphanumeric() || c == '_' || c == '-' => Some(c.to_ascii_lowercase()),
        c if c.is_whitespace() => Some('-'),
        _ => None,
    });
    kept.collect()
}

/// Returns a sentence for each link of `pages` that leads to no file, or to no heading, of the repository at `root`, and
/// for each page of `docs/` that the table of contents lacks.
pub fn violations(root: &Path, pages: &[File]) -> Vec<String> {
    let ids: BTreeMap<&str, BTreeSet<String>> =
        pages.iter().map(|page| (page.path.as_str(), headings(&page.text))).collect();
    let mut found = vec![];
    let mut listed = BTreeSet::new();
    for page in pages {
        for link in links(&page.text) {
            let line = page.text[..link.range.start].lines().count().max(1);
            let at = format!("{}:{line}: the link to {}", page.path, link.target);
            match resolve(&page.path, &link.target) {
                Target::Web => {}
                Target::Outside => found.push(format!("{at} leaves the repository")),
                Target::File(path, _) if !root.join(&path).exists() => found.push(format!("{at} leads to no file")),
                Target::File(path, heading) => {
                    let known = ids.get(path.as_str());
                    if !heading.is_empty() && known.is_some_and(|known| !known.contains(heading)) {
                        found.push(format!("{at} leads to no heading of {path}"));
                    }
                    if page.path == SUMMARY {
                        listed.insert(path);
                    }
                }
            }
        }
    }
    let docs = pages.iter().filter(|page| page.path.starts_with("docs/") && page.path != SUMMARY);
    found.extend(
        docs.filter(|page| !listed.contains(&page.path)).map(|page| format!("{}: add it to {SUMMARY}", page.path)),
    );
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_and_their_labels_are_found_outside_code() {
        let text =
            "See [the `x` page](a.md#b), ![img](c.png).\n\n    [code](no.md)\n\n| [cell](d.md) |\n| --- |\n`[no](e)`";
        let found = links(text);
        let seen: Vec<(&str, &str, bool)> =
            found.iter().map(|link| (&text[link.label.clone()], link.target.as_str(), link.image)).collect();
        assert_eq!(seen, [("the `x` page", "a.md#b", false), ("img", "c.png", true), ("cell", "d.md", false)]);
        assert_eq!(&text[found[0].range.clone()], "[the `x` page](a.md#b)");
    }

    #[test]
    fn targets_resolve_from_the_folder_of_the_page() {
        let file = |path: &str, heading| Target::File(path.to_owned(), heading);
        assert_eq!(resolve("docs/models/a.md", "../b.md#c"), file("docs/b.md", "c"));
        assert_eq!(resolve("README.md", "docs/"), file("docs", ""));
        assert_eq!(resolve("docs/a.md", "#c"), file("docs/a.md", "c"));
        assert_eq!(resolve("a.md", "../b.md"), Target::Outside);
        assert_eq!(resolve("a.md", "https://example.org/b.md"), Target::Web);
    }

    #[test]
    fn headings_have_the_ids_of_github() {
        let ids = headings("# A `b_c`, d\n\n## Does it?\n\n## Does it?\n");
        assert_eq!(ids.into_iter().collect::<Vec<_>>(), ["a-b_c-d", "does-it", "does-it-1"]);
    }

    #[test]
    fn broken_links_and_pages_without_an_entry_are_violations() {
        let folder = std::env::temp_dir();
        let file = |path: &str, text: &str| File { path: path.to_owned(), text: text.to_owned() };
        let pages = [file("docs/a.md", "[x](b.md) [y](#z) [w](../../c.md)"), file(SUMMARY, "# Contents")];
        let found = violations(&folder.join("no such folder"), &pages).join("\n");
        for expected in ["docs/a.md:1: the link to b.md leads to no file", "../../c.md leaves", "docs/a.md: add it to"]
        {
            assert!(found.contains(expected), "{found}");
        }
    }
}
