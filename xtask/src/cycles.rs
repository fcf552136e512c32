//! Import cycles between the files of a crate.
//!
//! A file imports another when its code names a path of this crate (`crate::…`, `super::…`, `self::…`) that leads into
//! the other file. A re-exported name counts as an import of the file that defines the name, so a crate root of
//! re-exports is not part of a cycle. Unit tests are ignored.

use crate::source::{self, File};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The largest cycle that is accepted, in files.
const LARGEST: usize = 4;

/// Returns a sentence for each cycle of more than four files.
pub fn violations(files: &[File]) -> Vec<String> {
    let mut crates: BTreeMap<&str, Vec<&File>> = BTreeMap::new();
    for file in files {
        if let Some(at) = file.path.find("/src/") {
            crates.entry(&file.path[..at]).or_default().push(file);
        }
    }
    let mut found = vec![];
    for (name, files) in crates {
        for cycle in Imports::of(name, &files).cycles() {
            if cycle.len() > LARGEST {
                found.push(format!(
                    "{name}: {} files import each other in a cycle (at most {LARGEST} may): {}",
                    cycle.len(),
                    cycle.join(", ")
                ));
            }
        }
    }
    found
}

/// A path in this crate, such as `["batch", "Batch"]`.
type ModulePath = Vec<String>;

/// The files of a crate and their imports.
struct Imports<'a> {
    names: Vec<&'a str>,
    edges: Vec<BTreeSet<usize>>,
}

impl<'a> Imports<'a> {
    fn of(root: &str, files: &[&'a File]) -> Self {
        let modules: Vec<ModulePath> =
            files.iter().map(|file| module(&file.path[root.len() + "/src/".len()..])).collect();
        let index: HashMap<&[String], usize> = modules.iter().enumerate().map(|(i, m)| (m.as_slice(), i)).collect();
        let sources: Vec<String> = files.iter().map(|file| source::without_tests(&source::code(&file.text))).collect();
        let mut exports: HashMap<ModulePath, ModulePath> = HashMap::new();
        let mut imported: Vec<Vec<ModulePath>> = vec![];
        for (module, source) in modules.iter().zip(&sources) {
            let mut paths = vec![];
            for (public, path) in imports(source, module, &index) {
                if public {
                    let mut name = module.clone();
                    name.push(path.last().cloned().unwrap_or_default());
                    exports.insert(name, path);
                } else {
                    paths.push(path);
                }
            }
            imported.push(paths);
        }
        let edges = imported
            .iter()
            .enumerate()
            .map(|(from, paths)| {
                let targets = paths.iter().filter_map(|path| resolve(path, &index, &exports));
                targets.filter(|&to| to != from).collect()
            })
            .collect();
        Self { names: files.iter().map(|file| file.path.as_str()).collect(), edges }
    }

    /// The strongly connected components of more than one file.
    fn cycles(&self) -> Vec<Vec<&'a str>> {
        let n = self.edges.len();
        let reach: Vec<Vec<bool>> = (0..n)
            .map(|start| {
                let mut seen = vec![false; n];
                let mut stack: Vec<usize> = self.edges[start].iter().copied().collect();
                while let Some(at) = stack.pop() {
                    if !std::mem::replace(&mut seen[at], true) {
                        stack.extend(&self.edges[at]);
                    }
                }
                seen
            })
            .collect();
        let mut done = vec![false; n];
        let mut cycles = vec![];
        for a in 0..n {
            if done[a] || !reach[a][a] {
                continue;
            }
            let members: Vec<usize> = (0..n).filter(|&b| reach[a][b] && reach[b][a]).collect();
            members.iter().for_each(|&b| done[b] = true);
            cycles.push(members.into_iter().map(|b| self.names[b]).collect());
        }
        cycles
    }
}

/// The module path of a file under `src/`.
fn module(path: &str) -> ModulePath {
    let path = path.trim_end_matches(".rs");
    let path = path.strip_suffix("/mod").unwrap_or(path);
    match path {
        "lib" | "main" | "mod" => vec![],
        _ => path.split('/').map(str::to_owned).collect(),
    }
}

/// The file that a path leads into, through re-exports.
fn resolve(
    path: &[String],
    index: &HashMap<&[String], usize>,
    exports: &HashMap<ModulePath, ModulePath>,
) -> Option<usize> {
    let mut path = path.to_vec();
    // A longer chain of re-exports is a cycle.
    for _ in 0..8 {
        let next = (1..=path.len()).find_map(|n| {
            let target = exports.get(&path[..n])?;
            (target[..] != path[..n]).then(|| target.iter().chain(&path[n..]).cloned().collect::<ModulePath>())
        });
        let Some(next) = next else { break };
        path = next;
    }
    // The path of a module, as in `use crate::batch;`, leads to the file of the module. The crate root defines no
    // items.
    (1..=path.len()).rev().find_map(|n| index.get(&path[..n]).copied())
}

/// The crate-local paths that a file names. The flag is true for a path that the file re-exports.
fn imports(code: &str, module: &[String], index: &HashMap<&[String], usize>) -> Vec<(bool, ModulePath)> {
    let mut found = vec![];
    for statement in code.split_inclusive(';') {
        // The last `use` before the semicolon begins the statement.
        let Some(at) =
            statement.rfind("use ").filter(|&at| !statement[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_'))
        else {
            continue;
        };
        let public = statement[..at].trim_end().ends_with("pub");
        for path in expand(statement[at + 4..].trim_end_matches(';')) {
            if let Some(path) = absolute(&path, module, index) {
                found.push((public, path));
            }
        }
    }
    // Paths in expressions and signatures.
    for start in ["crate::", "super::"] {
        for (at, _) in code.match_indices(start) {
            let end =
                code[at..].find(|c: char| !c.is_alphanumeric() && c != '_' && c != ':').map_or(code.len(), |n| at + n);
            let path: ModulePath =
                code[at..end].split("::").filter(|part| !part.is_empty()).map(str::to_owned).collect();
            if let Some(path) = absolute(&path, module, index).filter(|path| path.len() > 1) {
                // The loop above has already found the paths of `use` statements, including those in braces.
                let line = code[..at].rfind(['\n', ';', '{', '}']).map_or(0, |n| n + 1);
                if !code[line..at].contains("use ") {
                    found.push((false, path));
                }
            }
        }
    }
    found
}

/// Expands an import tree into paths: `a::{b, c::{self, d}}` becomes `a::b`, `a::c`, `a::c::d`.
fn expand(tree: &str) -> Vec<ModulePath> {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else {
        let path = tree.split(" as ").next().unwrap_or_default();
        let parts = path.split("::").map(|part| part.trim().to_owned()).filter(|part| !part.is_empty());
        return vec![parts.collect()];
    };
    let prefix: ModulePath =
        tree[..open].split("::").map(|part| part.trim().to_owned()).filter(|part| !part.is_empty()).collect();
    let inner = tree[open + 1..].trim_end().trim_end_matches('}');
    let (mut depth, mut start, mut paths) = (0usize, 0usize, vec![]);
    let mut branches = vec![];
    for (at, c) in inner.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth = depth.saturating_sub(1),
            ',' if depth == 0 => {
                branches.push(&inner[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    branches.push(&inner[start..]);
    for branch in branches.into_iter().filter(|branch| !branch.trim().is_empty()) {
        // `trim_end_matches` above has removed the closing braces of the last branch.
        let missing = branch.matches('{').count().saturating_sub(branch.matches('}').count());
        let branch = format!("{branch}{}", "}".repeat(missing));
        for path in expand(&branch) {
            let own = path.iter().filter(|part| *part != "self");
            paths.push(prefix.iter().chain(own).cloned().collect());
        }
    }
    paths
}

/// Returns the path from the crate root; `None` for paths into other crates.
fn absolute(path: &[String], module: &[String], index: &HashMap<&[String], usize>) -> Option<ModulePath> {
    let first = path.first()?.as_str();
    let (mut base, mut rest) = match first {
        "crate" => (vec![], &path[1..]),
        "self" => (module.to_vec(), &path[1..]),
        "super" => (module.to_vec(), path),
        _ => {
            let mut child = module.to_vec();
            child.push(first.to_owned());
            return index.contains_key(child.as_slice()).then(|| module.iter().chain(path).cloned().collect());
        }
    };
    while rest.first().is_some_and(|part| part == "super") {
        base.pop();
        rest = &rest[1..];
    }
    base.extend(rest.iter().cloned());
    Some(base)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &str, text: &str) -> File {
        File { path: path.to_owned(), text: text.to_owned() }
    }

    fn cycles(files: &[(&str, &str)]) -> Vec<Vec<String>> {
        let files: Vec<File> = files.iter().map(|(path, text)| file(&format!("c/src/{path}"), text)).collect();
        let files: Vec<&File> = files.iter().collect();
        let imports = Imports::of("c", &files);
        imports
            .cycles()
            .iter()
            .map(|cycle| cycle.iter().map(|name| name["c/src/".len()..].to_owned()).collect())
            .collect()
    }

    #[test]
    fn reexports_lead_to_the_defining_file() {
        let root = ("lib.rs", "mod a;\nmod b;\npub use a::A;\npub use b::B;");
        assert_eq!(cycles(&[root, ("a.rs", "use crate::B;"), ("b.rs", "")]), Vec::<Vec<String>>::new());
        assert_eq!(cycles(&[root, ("a.rs", "use crate::B;"), ("b.rs", "use crate::{A};")]), [["a.rs", "b.rs"]]);
    }

    #[test]
    fn imports_of_every_form_are_found() {
        for import in
            ["use super::b::B;", "use crate::b::{self, x::{y, z}};", "fn f() { crate::b::g() }", "use crate::{q, b};"]
        {
            let found = cycles(&[("lib.rs", ""), ("a.rs", import), ("b.rs", "use crate::a;")]);
            assert_eq!(found, [["a.rs", "b.rs"]], "{import}");
        }
        let test = "#[cfg(test)]\nmod tests { use crate::b::B; }";
        assert_eq!(cycles(&[("lib.rs", ""), ("a.rs", test), ("b.rs", "use crate::a;")]), Vec::<Vec<String>>::new());
    }

    #[test]
    fn only_large_cycles_are_violations() {
        let ring = |n: usize| -> Vec<File> {
            (0..n).map(|i| file(&format!("c/src/m{i}.rs"), &format!("use crate::m{}::X;", (i + 1) % n))).collect()
        };
        assert_eq!(violations(&ring(4)), Vec::<String>::new());
        assert!(violations(&ring(5))[0].contains("5 files"));
    }
}
