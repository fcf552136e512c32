//! The layer rules: packages that a crate must not depend on, directly or indirectly. The rules keep the core,
//! environment, planning and report crates fast to build and usable without a deep-learning framework or a database.

use crate::graph::Graph;

/// A rule about some crates of the workspace.
pub enum Rule {
    /// `crates` must not depend on a package with a forbidden name, directly or indirectly.
    Never {
        /// The crates; empty means all.
        crates: &'static [&'static str],
        /// Whether a package's name is forbidden.
        forbidden: fn(&str) -> bool,
        /// The rule in words.
        words: &'static str,
    },
    /// Only `users` may depend directly on `crates`.
    Only {
        /// The crates that may depend on `crates`.
        users: &'static [&'static str],
        /// The crates with restricted users.
        crates: &'static [&'static str],
        /// The rule in words.
        words: &'static str,
    },
}

/// The rules of this workspace.
pub const RULES: &[Rule] = &[
    Rule::Never {
        crates: &[
            "swm-core",
            "swm-envs",
            "swm-gym",
            "swm-plan",
            "swm-report",
            "swm-raster",
            "swm-image",
            "swm-kernels",
        ],
        forbidden: |name| ["burn", "lance", "mujoco", "ffmpeg"].iter().any(|family| of_family(name, family)),
        words: "core, envs, gym, plan, report, raster, image and kernels depend on no deep learning, dataset engine, MuJoCo or FFmpeg",
    },
    Rule::Never {
        crates: &[],
        // Lance's file crate uses the types of `datafusion-common`. All other DataFusion crates are parts of the query
        // engine.
        forbidden: |name| of_family(name, "datafusion") && name != "datafusion-common",
        words: "no crate depends on DataFusion's query engine",
    },
    Rule::Never {
        crates: &["swm-plan"],
        forbidden: |name| name == "swm-models",
        words: "solvers depend on the contract of cost models only",
    },
    Rule::Never {
        crates: &["swm-eval"],
        forbidden: |name| ["swm-plan", "swm-models", "swm-envs", "swm-mujoco", "swm-gym"].contains(&name),
        words: "evaluation depends on the contracts of planners, models and environments only",
    },
    Rule::Never {
        crates: &["swm-bench"],
        forbidden: |name| ["swm-models", "swm-envs", "swm-mujoco", "swm-gym"].contains(&name),
        words: "benchmarks depend on the contracts of models and environments only",
    },
    Rule::Only {
        users: &["swm"],
        crates: &["swm-envs", "swm-mujoco"],
        words: "only the facade depends on concrete environments",
    },
    Rule::Only {
        users: &["swm", "swm-fuzz"],
        crates: &["swm-models"],
        words: "only the facade and the fuzzers depend on model families",
    },
    Rule::Only { users: &["swm-data"], crates: &["swm-video"], words: "only the dataset crate depends on FFmpeg" },
    Rule::Only {
        users: &["swm", "swm-python", "swm-fuzz"],
        crates: &["swm-gym"],
        words: "only the facade, the Python extension and the fuzzers depend on the Gymnasium bridge",
    },
];

/// Whether a package is `family` or one of its parts, `family-…`.
fn of_family(name: &str, family: &str) -> bool {
    name.strip_prefix(family).is_some_and(|rest| rest.is_empty() || rest.starts_with(['-', '_']))
}

/// Returns a sentence for each violation of the rules.
pub fn violations(graph: &Graph, rules: &[Rule]) -> Vec<String> {
    let mut found = vec![];
    for rule in rules {
        match rule {
            Rule::Never { crates, forbidden, words } => {
                let bound: Vec<_> =
                    graph.members().filter(|package| crates.is_empty() || crates.contains(&&*package.name)).collect();
                if bound.is_empty() {
                    found.push(format!(
                        "a rule applies to no crate ({words}): {} do not exist; fix xtask/src/layers.rs",
                        crates.join(", ")
                    ));
                }
                for package in bound {
                    if let Some(path) = graph.shortest_path(package, *forbidden) {
                        found.push(format!("{} ({words})", path.join(" → ")));
                    }
                }
            }
            Rule::Only { users, crates, words } => {
                for package in graph.members().filter(|package| !users.contains(&&*package.name)) {
                    for need in graph.member_dependencies(package).filter(|need| crates.contains(need)) {
                        found.push(format!("{} → {need} ({words})", package.name));
                    }
                }
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A workspace that satisfies the rules, with additional dependencies of some packages.
    fn with(more: &[(&str, &'static str)]) -> Vec<String> {
        let mut packages: Vec<(&str, Vec<&str>)> = vec![
            ("swm-core", vec!["serde"]),
            ("swm-image", vec!["swm-core"]),
            ("swm-video", vec!["swm-core", "swm-image", "ffmpeg-next"]),
            ("swm-envs", vec!["swm-core"]),
            ("swm-mujoco", vec!["swm-core", "mujoco-rs"]),
            ("swm-gym", vec!["swm-core"]),
            ("swm-plan", vec!["swm-core"]),
            ("swm-report", vec!["swm-core"]),
            ("swm-data", vec!["swm-core", "lance-file"]),
            ("swm-models", vec!["swm-core", "swm-data", "swm-plan", "burn"]),
            ("swm-eval", vec!["swm-core", "swm-data"]),
            ("swm-bench", vec!["swm-core", "swm-data", "swm-plan", "swm-eval"]),
            ("swm", vec!["swm-core", "swm-envs", "swm-mujoco", "swm-models", "swm-eval", "swm-report"]),
            ("serde", vec![]),
            ("burn", vec!["burn-core"]),
            ("burn-core", vec![]),
            ("burnt-toast", vec![]),
            ("lance-file", vec!["datafusion-common"]),
            ("datafusion-common", vec![]),
            ("datafusion-physical-plan", vec![]),
            ("ffmpeg-next", vec![]),
            ("mujoco-rs", vec![]),
        ];
        for (name, need) in more {
            packages.iter_mut().find(|(other, _)| other == name).expect("the list has this package").1.push(need);
        }
        let packages: Vec<(&str, &[&str])> = packages.iter().map(|(name, needs)| (*name, needs.as_slice())).collect();
        violations(&Graph::synthetic(&packages), RULES)
    }

    #[test]
    fn a_layered_workspace_passes() {
        assert_eq!(with(&[("swm-core", "burnt-toast")]), Vec::<String>::new());
    }

    #[test]
    fn violations_name_the_dependency_path() {
        for (from, need, expected) in [
            ("swm-core", "burn", "swm-core → burn ("),
            ("swm-envs", "mujoco-rs", "swm-envs → mujoco-rs ("),
            ("swm-report", "swm-data", "swm-report → swm-data → lance-file ("),
            ("swm-plan", "ffmpeg-next", "swm-plan → ffmpeg-next ("),
            ("serde", "burn-core", "swm-core → serde → burn-core ("),
            ("swm-plan", "swm-models", "swm-plan → swm-models (solvers"),
            ("swm-eval", "swm-plan", "swm-eval → swm-plan (evaluation"),
            ("swm-eval", "swm-models", "swm-eval → swm-models (evaluation"),
            ("swm-bench", "swm-mujoco", "swm-bench → swm-mujoco (benchmarks"),
            ("swm-data", "swm-envs", "swm-eval → swm-data → swm-envs (evaluation"),
            ("swm-models", "swm-envs", "swm-models → swm-envs (only the facade"),
            ("swm-report", "swm-mujoco", "swm-report → swm-mujoco (only the facade"),
            ("swm-report", "swm-models", "swm-report → swm-models (only the facade"),
            ("swm-image", "ffmpeg-next", "swm-image → ffmpeg-next ("),
            ("swm-eval", "swm-video", "swm-eval → swm-video (only the dataset crate"),
            ("swm-data", "swm-gym", "swm-data → swm-gym (only the facade, the"),
            (
                "lance-file",
                "datafusion-physical-plan",
                "swm → swm-models → swm-data → lance-file → datafusion-physical",
            ),
        ] {
            let found = with(&[(from, need)]);
            assert!(found.iter().any(|line| line.starts_with(expected)), "{from} → {need}: {found:#?}");
        }
    }

    #[test]
    fn a_rule_without_crates_is_a_violation() {
        let found = violations(&Graph::synthetic(&[("swm", &[])]), RULES);
        assert!(found.iter().any(|line| line.contains("applies to no crate")), "{found:?}");
    }
}
