//! `cargo xtask book DIR`: the documentation as static pages, which need no network.
//!
//! The pages are `docs/*.md` and others that `docs/SUMMARY.md` names, and pages that are generated from the registries of
//! the program (`swm envs --json` and others). They are written to `DIR/src`, with their links rewritten, and mdBook makes
//! `DIR/book` of them. Links to files that are no page, such as source code, become plain text.

mod check;
mod pages;
mod registries;

use crate::links::{self, SUMMARY, Target};
use anyhow::{Context as _, Result, bail};
use pages::Page;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Writes the book to a folder, which is replaced.
pub fn book(root: &Path, folder: &Path) -> Result<()> {
    let source = folder.join("src");
    for old in [&source, &folder.join("book")] {
        if old.exists() {
            std::fs::remove_dir_all(old).with_context(|| format!("deleting {}", old.display()))?;
        }
    }
    let program = program(root)?;
    let groups = registries::groups(&program, &source)?;
    let summary = read(root, SUMMARY)?;
    let written: Vec<String> = links::links(&summary)
        .iter()
        .filter_map(|link| match links::resolve(SUMMARY, &link.target) {
            Target::File(path, _) => Some(path),
            _ => None,
        })
        .collect();
    let names: BTreeMap<String, String> = written.iter().map(|path| (path.clone(), page_name(path))).collect();
    write(&source, "SUMMARY.md", &contents(&summary, &names, &groups)?)?;
    for path in &written {
        let text = rewritten(root, &source, path, &read(root, path)?, &names)?;
        write(&source, &names[path], &text)?;
    }
    let interfaces = Interfaces::of_environment();
    interfaces.link(&source, &names)?;
    for page in groups.iter().flat_map(|group| &group.pages) {
        write(&source, &page.path, &page.text)?;
    }
    for name in ["book.toml", "book.css"] {
        std::fs::copy(root.join("docs").join(name), folder.join(name))
            .with_context(|| format!("copying docs/{name}"))?;
    }
    build(folder)?;
    interfaces.write(&folder.join("book"))?;
    check::site(&folder.join("book"))?;
    println!("{}", folder.join("book/index.html").display());
    Ok(())
}

/// The program whose registries are described: `$SWM`, else the one that `cargo build --release -p swm` wrote.
fn program(root: &Path) -> Result<PathBuf> {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), PathBuf::from);
    let program = std::env::var_os("SWM").map_or_else(|| target.join("release/swm"), PathBuf::from);
    if !program.is_file() {
        bail!("{} does not exist: build it with `make build`, or name it in SWM", program.display());
    }
    Ok(program)
}

/// Returns the name of a page in the book: without `docs/`, and `two_room.md` for `two_room/README.md`.
fn page_name(path: &str) -> String {
    if path == "README.md" {
        return "index.md".to_owned();
    }
    let path = path.strip_prefix("docs/").unwrap_or(path);
    path.strip_suffix("/README.md").map_or_else(|| path.to_owned(), |folder| format!("{folder}.md"))
}

/// Returns the table of contents with the names of the book, and the generated pages where a comment names their group:
/// `<!-- environments -->`.
fn contents(summary: &str, names: &BTreeMap<String, String>, groups: &[pages::Group]) -> Result<String> {
    let mut text = String::new();
    for line in summary.lines() {
        let comment = line.trim().strip_prefix("<!-- ").and_then(|rest| rest.strip_suffix(" -->"));
        let Some(name) = comment else {
            let link = links::links(line);
            match link.first().map(|link| (link, links::resolve(SUMMARY, &link.target))) {
                Some((link, Target::File(path, _))) => {
                    text += &line.replace(&format!("({})", link.target), &format!("({})", names[&path]));
                }
                _ => text += line,
            }
            text += "\n";
            continue;
        };
        let group = groups.iter().find(|group| group.name == name);
        let group = group.with_context(|| format!("{SUMMARY} names no group of generated pages: {name}"))?;
        let entry = |(index, page): (usize, &Page)| {
            format!("{}- [{}]({})\n", if index == 0 { "" } else { "  " }, page.title, page.path)
        };
        text.extend(group.pages.iter().enumerate().map(entry));
    }
    Ok(text)
}

/// Returns a page with links that work in the book; images are copied to it.
fn rewritten(root: &Path, source: &Path, path: &str, text: &str, names: &BTreeMap<String, String>) -> Result<String> {
    let up = "../".repeat(names[path].matches('/').count());
    let mut out = String::new();
    let mut done = 0;
    for link in links::links(text) {
        if link.range.start < done {
            continue;
        }
        let Target::File(target, heading) = links::resolve(path, &link.target) else { continue };
        let heading = if heading.is_empty() { String::new() } else { format!("#{heading}") };
        let label = &text[link.label.clone()];
        let replaced = match names.get(&target) {
            Some(page) if !link.image => format!("[{label}]({up}{page}{heading})"),
            _ if link.image => {
                copy(&root.join(&target), &source.join("images").join(target.replace('/', "-")))?;
                format!("![{label}]({up}images/{})", target.replace('/', "-"))
            }
            // A file of the repository that is no page of the book.
            _ => label.to_owned(),
        };
        out += &text[done..link.range.start];
        out += &replaced;
        done = link.range.end;
    }
    Ok(out + &text[done..])
}

/// The interfaces whose pages other tools make.
struct Interfaces {
    /// A Python with pdoc and the package.
    pdoc: Option<PathBuf>,
    /// The folder that `cargo doc` wrote.
    rustdoc: Option<PathBuf>,
}

impl Interfaces {
    /// Those that `$SWM_PDOC` and `$SWM_RUSTDOC` name.
    fn of_environment() -> Self {
        let path = |name: &str| std::env::var_os(name).map(PathBuf::from);
        Self { pdoc: path("SWM_PDOC"), rustdoc: path("SWM_RUSTDOC") }
    }

    /// Adds links to the pages about the Python package and about the architecture.
    fn link(&self, source: &Path, names: &BTreeMap<String, String>) -> Result<()> {
        let of_python = self.pdoc.is_some().then_some(("python/README.md", PYTHON, "of the Python package"));
        let of_rust = self.rustdoc.is_some().then_some(("ARCHITECTURE.md", RUST, "of the crates"));
        for (page, target, what) in [of_python, of_rust].into_iter().flatten() {
            let Some(name) = names.get(page) else { bail!("{SUMMARY} does not name {page}") };
            let text = std::fs::read_to_string(source.join(name))?;
            let up = "../".repeat(name.matches('/').count());
            write(source, name, &format!("{text}\n## Interface\n\n[The complete interface {what}]({up}{target})\n"))?;
        }
        Ok(())
    }

    /// Writes the pages into the finished book.
    fn write(&self, book: &Path) -> Result<()> {
        if let Some(python) = &self.pdoc {
            let mut command = Command::new(python);
            let folder = book.join("interface/python");
            command
                .args(["-m", "pdoc", "--docformat", "google", "--output-directory"])
                .arg(folder)
                .arg("stable_worldmodel");
            let output = command.output().with_context(|| format!("starting {}", python.display()))?;
            if !output.status.success() {
                bail!("pdoc: {}", String::from_utf8_lossy(&output.stderr));
            }
        }
        if let Some(folder) = &self.rustdoc {
            copy_folder(folder, &book.join("interface/rust"))?;
        }
        Ok(())
    }
}

/// The first pages of the interfaces in the book.
const PYTHON: &str = "interface/python/stable_worldmodel.html";
const RUST: &str = "interface/rust/swm/index.html";

fn copy_folder(from: &Path, to: &Path) -> Result<()> {
    for entry in std::fs::read_dir(from).with_context(|| format!("reading {}", from.display()))? {
        let path = entry?.path();
        let to = to.join(path.file_name().unwrap_or_default());
        if path.is_dir() { copy_folder(&path, &to)? } else { copy(&path, &to)? }
    }
    Ok(())
}

/// Runs mdBook, whose warnings are errors.
fn build(folder: &Path) -> Result<()> {
    let output = Command::new("mdbook").arg("build").arg(folder).output();
    let output = output.context("starting mdbook: `make docs` installs it")?;
    let log = String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout);
    if !output.status.success() || log.contains("WARN") || log.contains("ERROR") {
        bail!("mdbook build: {log}");
    }
    Ok(())
}

fn read(root: &Path, path: &str) -> Result<String> {
    std::fs::read_to_string(root.join(path)).with_context(|| format!("reading {path}"))
}

fn write(folder: &Path, name: &str, text: &str) -> Result<()> {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().unwrap_or(folder))?;
    std::fs::write(&path, text).with_context(|| format!("writing {}", path.display()))
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    std::fs::create_dir_all(to.parent().unwrap_or(to))?;
    std::fs::copy(from, to).with_context(|| format!("copying {}", from.display()))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_of_the_book_lead_to_pages_and_other_files_become_text() {
        let names = [("README.md", "index.md"), ("docs/a.md", "a.md"), ("crates/x/room/README.md", "crates/x/room.md")];
        assert!(names.iter().all(|(path, name)| page_name(path) == *name));
        let names = names.iter().map(|(path, name)| ((*path).to_owned(), (*name).to_owned())).collect();
        let text = "[room](../crates/x/room/README.md#b), [`code`](../crates/x/lib.rs), [web](https://x.org)";
        let (root, source) = (Path::new("."), Path::new("."));
        let a = rewritten(root, source, "docs/a.md", text, &names).expect("a page without images");
        assert_eq!(a, "[room](crates/x/room.md#b), `code`, [web](https://x.org)");
        let room = rewritten(root, source, "crates/x/room/README.md", "[a](../../../docs/a.md)", &names);
        assert_eq!(room.expect("a page without images"), "[a](../../a.md)");
    }

    #[test]
    fn contents_have_the_generated_pages() {
        let page = |title: &str| Page { title: title.to_owned(), path: format!("g/{title}.md"), text: String::new() };
        let groups = [pages::Group { name: "g", pages: vec![page("All"), page("one")] }];
        let names = [("docs/a.md".to_owned(), "a.md".to_owned())].into();
        let text = contents("- [A](a.md)\n<!-- g -->\n", &names, &groups).expect("known groups");
        assert_eq!(text, "- [A](a.md)\n- [All](g/All.md)\n  - [one](g/one.md)\n");
        assert!(contents("<!-- h -->", &names, &groups).is_err());
    }
}
