//! [`Group`]: the runs of one environment, protocol and counting, by condition, from all files.

use crate::text::escape;
use std::path::PathBuf;
use swm_core::Results;
use swm_core::results::{Comparison, Counting, Family, Paired, Run, pairs};

/// The number of different colours of policies.
const COLOURS: usize = 6;

/// All runs in one environment with the same protocol and counting.
pub(crate) struct Group<'a> {
    pub env: &'a str,
    pub protocol: &'a str,
    pub counting: Counting,
    pub conditions: Vec<Condition<'a>>,
}

/// All runs under one condition.
pub(crate) struct Condition<'a> {
    pub name: &'a str,
    pub rows: Vec<Row<'a>>,
}

/// One run with its label and colour.
pub(crate) struct Row<'a> {
    pub run: &'a Run,
    /// The index of the run's results file.
    pub file: usize,
    /// The name of the policy, with the number of the results file if several runs have the same name.
    pub label: String,
    /// The CSS class of the policy's colour: `floor`, `expert`, or `c0` and so on.
    pub class: String,
}

impl Row<'_> {
    /// Whether this is the random-policy floor.
    pub(crate) fn is_floor(&self) -> bool {
        self.class == "floor"
    }
}

impl<'a> Group<'a> {
    /// The groups of these results, in the order in which they first appear.
    pub(crate) fn all(results: &'a [(PathBuf, Results)]) -> Vec<Self> {
        let mut groups: Vec<Self> = vec![];
        let mut learned: Vec<&str> = vec![];
        for (file, (_, result)) in results.iter().enumerate() {
            let counting = result.counting;
            let same = |g: &Self| (g.env, g.protocol, g.counting) == (&*result.env, &*result.protocol, counting);
            let index = groups.iter().position(same).unwrap_or_else(|| {
                let (env, protocol) = (&*result.env, &*result.protocol);
                groups.push(Self { env, protocol, counting, conditions: vec![] });
                groups.len() - 1
            });
            let conditions = &mut groups[index].conditions;
            for run in &result.runs {
                let at = conditions.iter().position(|c| c.name == run.condition).unwrap_or_else(|| {
                    conditions.push(Condition { name: &run.condition, rows: vec![] });
                    conditions.len() - 1
                });
                let class = match run.policy.as_str() {
                    "random" => "floor".to_owned(),
                    "expert" => "expert".to_owned(),
                    name => {
                        let colour = learned.iter().position(|&other| other == name).unwrap_or_else(|| {
                            learned.push(name);
                            learned.len() - 1
                        });
                        format!("c{}", colour % COLOURS)
                    }
                };
                let rows = &mut conditions[at].rows;
                // Evaluations of several models on the same starts contain the same floor.
                if class == "floor" && rows.iter().any(|row| row.is_floor() && row.run.episodes == run.episodes) {
                    continue;
                }
                rows.push(Row { run, file, label: run.policy.clone(), class });
            }
        }
        for condition in groups.iter_mut().flat_map(|group| &mut group.conditions) {
            let policies: Vec<&str> = condition.rows.iter().map(|row| row.run.policy.as_str()).collect();
            for row in &mut condition.rows {
                if policies.iter().filter(|&&policy| policy == row.run.policy).count() > 1 {
                    row.label = format!("{} [{}]", row.run.policy, row.file + 1);
                }
            }
        }
        groups
    }

    /// All runs, by condition.
    pub(crate) fn rows(&self) -> impl Iterator<Item = &Row<'a>> {
        self.conditions.iter().flat_map(|condition| &condition.rows)
    }

    /// The heading of the group, escaped.
    pub(crate) fn title(&self) -> String {
        format!("{} · {}, {}", escape(self.env), escape(self.protocol), escape(&self.counting.to_string()))
    }
}

impl<'a> Condition<'a> {
    /// The random-policy floor of the condition, if it was measured.
    pub(crate) fn floor(&self) -> Option<&Row<'a>> {
        self.rows.iter().find(|row| row.is_floor())
    }

    /// The floor to compare a run with: the floor in the same file or, if there is none, the first floor of the
    /// condition.
    pub(crate) fn floor_of(&self, run: &Row<'_>) -> Option<&Row<'a>> {
        self.rows.iter().find(|row| row.is_floor() && row.file == run.file).or_else(|| self.floor())
    }

    /// The compared pairs of runs that played the same starts, the later run first: usually a model, then the
    /// random-policy floor. They form a family; `None` without pairs.
    pub(crate) fn pairs(&self, counting: Counting) -> Option<(Family, Vec<Pair<'_, 'a>>)> {
        let runs: Vec<&Run> = self.rows.iter().map(|row| row.run).collect();
        let pairs = pairs(&runs).map(|(later, earlier)| (&self.rows[later], &self.rows[earlier]));
        let mut pairs: Vec<Pair<'_, 'a>> = pairs
            .filter_map(|(a, b)| Some(Pair { a, b, table: Comparison::of(a.run, b.run, counting)?.table }))
            .collect();
        let mut tables: Vec<&mut Paired> = pairs.iter_mut().map(|pair| &mut pair.table).collect();
        let family = Family::correct(self.name, &mut tables, 0)?;
        Some((family, pairs))
    }
}

/// Two runs on the same starts.
pub(crate) struct Pair<'g, 'a> {
    pub a: &'g Row<'a>,
    pub b: &'g Row<'a>,
    pub table: Paired,
}
