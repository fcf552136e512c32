//! [`Graph`]: normal and build dependencies of the packages, without dev-dependencies.

use anyhow::{Context as _, Result};
use cargo_metadata::{DependencyKind, MetadataCommand};
use std::collections::{HashMap, VecDeque};
use std::path::Path;
use std::process::Command;

/// A package and its dependencies.
#[derive(Debug)]
pub struct Package {
    /// The name, which is the same for all versions of a package.
    pub name: String,
    /// Whether the package is a crate of the workspace.
    pub member: bool,
    /// The indices of the direct dependencies in the graph.
    pub dependencies: Vec<usize>,
}

/// All packages of the workspace and of its dependencies.
#[derive(Debug)]
pub struct Graph {
    packages: Vec<Package>,
}

impl Graph {
    /// Loads the graph of the workspace in the folder `root` for this platform, as `cargo metadata` resolves it.
    ///
    /// The graph includes optional packages that are not built, so a check that passes holds for every choice of
    /// features.
    pub fn load(root: &Path) -> Result<Self> {
        let version = Command::new("rustc").arg("-vV").output().context("running `rustc -vV` for the platform")?;
        let version = String::from_utf8_lossy(&version.stdout).into_owned();
        let host = version.lines().find_map(|line| line.strip_prefix("host: ")).context("`rustc -vV` names no host")?;
        let metadata = MetadataCommand::new()
            .manifest_path(root.join("Cargo.toml"))
            .other_options(vec!["--filter-platform".to_owned(), host.to_owned()])
            .exec()
            .context("running `cargo metadata`")?;
        let index: HashMap<_, _> = metadata.packages.iter().enumerate().map(|(i, package)| (&package.id, i)).collect();
        let mut packages: Vec<Package> = metadata
            .packages
            .iter()
            .map(|package| Package {
                name: package.name.to_string(),
                member: metadata.workspace_members.contains(&package.id),
                dependencies: vec![],
            })
            .collect();
        for node in metadata.resolve.as_ref().context("`cargo metadata` resolved nothing")?.nodes.iter() {
            let needed = node.deps.iter().filter(|need| {
                need.dep_kinds.iter().any(|kind| matches!(kind.kind, DependencyKind::Normal | DependencyKind::Build))
            });
            packages[index[&node.id]].dependencies = needed.map(|need| index[&need.pkg]).collect();
        }
        Ok(Self { packages })
    }

    /// The crates of the workspace.
    pub fn members(&self) -> impl Iterator<Item = &Package> {
        self.packages.iter().filter(|package| package.member)
    }

    /// A crate of the workspace, by name.
    pub fn member(&self, name: &str) -> Option<&Package> {
        self.members().find(|package| package.name == name)
    }

    /// The names of a package's direct dependencies in the workspace.
    pub fn member_dependencies<'a>(&'a self, package: &'a Package) -> impl Iterator<Item = &'a str> {
        package
            .dependencies
            .iter()
            .map(|&i| &self.packages[i])
            .filter(|need| need.member)
            .map(|need| need.name.as_str())
    }

    /// Returns the names on the shortest path from a package to a package with a forbidden name; `None` if there is no
    /// such path.
    pub fn shortest_path(&self, from: &Package, forbidden: fn(&str) -> bool) -> Option<Vec<&str>> {
        let start = self.packages.iter().position(|package| std::ptr::eq(package, from))?;
        let mut before: HashMap<usize, usize> = HashMap::from([(start, start)]);
        let mut queue = VecDeque::from([start]);
        while let Some(at) = queue.pop_front() {
            if at != start && forbidden(&self.packages[at].name) {
                let mut path = vec![self.packages[at].name.as_str()];
                let mut step = at;
                while step != start {
                    step = before[&step];
                    path.push(&self.packages[step].name);
                }
                path.reverse();
                return Some(path);
            }
            for &next in &self.packages[at].dependencies {
                if let std::collections::hash_map::Entry::Vacant(entry) = before.entry(next) {
                    entry.insert(at);
                    queue.push_back(next);
                }
            }
        }
        None
    }
}

#[cfg(test)]
impl Graph {
    /// A graph of `(name, dependencies)`; names that begin with `swm` or are `xtask` are crates of the workspace.
    pub fn synthetic(packages: &[(&str, &[&str])]) -> Self {
        let index = |name: &str| packages.iter().position(|(other, _)| *other == name).expect("a package of the graph");
        let packages = packages
            .iter()
            .map(|(name, needs)| Package {
                name: (*name).to_owned(),
                member: name.starts_with("swm") || *name == "xtask",
                dependencies: needs.iter().map(|need| index(need)).collect(),
            })
            .collect();
        Self { packages }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_shortest_path_in_cyclic_graphs() {
        let graph = Graph::synthetic(&[
            ("swm-a", &["x", "y"]),
            ("x", &["z", "swm-a"]),
            ("y", &["burn"]),
            ("z", &["burn"]),
            ("burn", &[]),
        ]);
        let start = graph.member("swm-a").expect("the graph has this package");
        assert_eq!(graph.shortest_path(start, |name| name == "burn"), Some(vec!["swm-a", "y", "burn"]));
        assert_eq!(graph.shortest_path(start, |name| name == "lance"), None);
        assert!(graph.member("x").is_none());
    }
}
