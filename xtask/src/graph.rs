//! The dependency graph: who needs whom to be built and to run. Needs of tests alone are left out.

use anyhow::{Context as _, Result};
use cargo_metadata::{DependencyKind, MetadataCommand};
use std::collections::{HashMap, VecDeque};
use std::path::Path;
use std::process::Command;

/// A package and what it needs.
#[derive(Debug)]
pub struct Package {
    /// Its name; two versions of a package share it.
    pub name: String,
    /// Whether it is a crate of the workspace.
    pub member: bool,
    /// The places of what it needs directly.
    pub needs: Vec<usize>,
}

/// All packages of the workspace and of its dependencies.
#[derive(Debug)]
pub struct Graph {
    packages: Vec<Package>,
}

impl Graph {
    /// The graph of the workspace in a folder, on this platform, as `cargo metadata` resolves it. That is a little
    /// more than what is built (it counts optional packages that another feature could switch on), so a check
    /// that passes here holds for every choice of features in the lock file.
    pub fn load(root: &Path) -> Result<Self> {
        let version = Command::new("rustc").arg("-vV").output().context("asking rustc for the platform")?;
        let version = String::from_utf8_lossy(&version.stdout).into_owned();
        let host = version.lines().find_map(|line| line.strip_prefix("host: ")).context("`rustc -vV` names no host")?;
        let metadata = MetadataCommand::new()
            .manifest_path(root.join("Cargo.toml"))
            .other_options(vec!["--filter-platform".to_owned(), host.to_owned()])
            .exec()
            .context("running `cargo metadata`")?;
        let place: HashMap<_, _> = metadata.packages.iter().enumerate().map(|(i, package)| (&package.id, i)).collect();
        let mut packages: Vec<Package> = metadata
            .packages
            .iter()
            .map(|package| Package {
                name: package.name.to_string(),
                member: metadata.workspace_members.contains(&package.id),
                needs: vec![],
            })
            .collect();
        for node in metadata.resolve.as_ref().context("`cargo metadata` resolved nothing")?.nodes.iter() {
            let needed = node.deps.iter().filter(|need| {
                need.dep_kinds.iter().any(|kind| matches!(kind.kind, DependencyKind::Normal | DependencyKind::Build))
            });
            packages[place[&node.id]].needs = needed.map(|need| place[&need.pkg]).collect();
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

    /// The crates of the workspace that a package needs directly.
    pub fn member_needs<'a>(&'a self, package: &'a Package) -> impl Iterator<Item = &'a str> {
        package.needs.iter().map(|&i| &self.packages[i]).filter(|need| need.member).map(|need| need.name.as_str())
    }

    /// The shortest way from a package to one whose name is `forbidden`, by names; none where there is no way.
    pub fn way(&self, from: &Package, forbidden: fn(&str) -> bool) -> Option<Vec<&str>> {
        let start = self.packages.iter().position(|package| std::ptr::eq(package, from))?;
        let mut before: HashMap<usize, usize> = HashMap::from([(start, start)]);
        let mut queue = VecDeque::from([start]);
        while let Some(at) = queue.pop_front() {
            if at != start && forbidden(&self.packages[at].name) {
                let mut way = vec![self.packages[at].name.as_str()];
                let mut step = at;
                while step != start {
                    step = before[&step];
                    way.push(&self.packages[step].name);
                }
                way.reverse();
                return Some(way);
            }
            for &next in &self.packages[at].needs {
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
    /// A graph of `(name, needs)`; names that begin with `swm` or are `xtask` are crates of the workspace.
    pub fn synthetic(packages: &[(&str, &[&str])]) -> Self {
        let place = |name: &str| packages.iter().position(|(other, _)| *other == name).expect("a package of the graph");
        let packages = packages
            .iter()
            .map(|(name, needs)| Package {
                name: (*name).to_owned(),
                member: name.starts_with("swm") || *name == "xtask",
                needs: needs.iter().map(|need| place(need)).collect(),
            })
            .collect();
        Self { packages }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shortest_way_is_found_and_circles_end() {
        let graph = Graph::synthetic(&[
            ("swm-a", &["x", "y"]),
            ("x", &["z", "swm-a"]),
            ("y", &["burn"]),
            ("z", &["burn"]),
            ("burn", &[]),
        ]);
        let start = graph.member("swm-a").expect("there");
        assert_eq!(graph.way(start, |name| name == "burn"), Some(vec!["swm-a", "y", "burn"]));
        assert_eq!(graph.way(start, |name| name == "lance"), None);
        assert!(graph.member("x").is_none());
    }
}
