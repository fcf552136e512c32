//! Which runs belong side by side: those of one environment, protocol and counting, by condition, whatever file they
//! come from.

use crate::text::escape;
use std::path::PathBuf;
use swm_core::Results;
use swm_core::results::{Comparison, Counting, Paired, Run};

/// How many policies get a colour of their own before colours repeat.
const COLOURS: usize = 6;

/// Everything measured in one environment under one protocol, counted one way.
pub(crate) struct Group<'a> {
    pub env: &'a str,
    pub protocol: &'a str,
    pub counting: Counting,
    pub conditions: Vec<Condition<'a>>,
}

/// Everything measured under one condition.
pub(crate) struct Condition<'a> {
    pub name: &'a str,
    pub rows: Vec<Row<'a>>,
}

/// One run, and how it is drawn.
pub(crate) struct Row<'a> {
    pub run: &'a Run,
    /// The place of its results file.
    pub file: usize,
    /// The policy's name, with the number of its file where several runs would look alike.
    pub label: String,
    /// The class that colours it: `floor`, `expert`, or `c0` and so on.
    pub class: String,
}

impl Row<'_> {
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
            let place = groups.iter().position(same).unwrap_or_else(|| {
                let (env, protocol) = (&*result.env, &*result.protocol);
                groups.push(Self { env, protocol, counting, conditions: vec![] });
                groups.len() - 1
            });
            let conditions = &mut groups[place].conditions;
            for run in &result.runs {
                let at = conditions.iter().position(|c| c.name == run.condition).unwrap_or_else(|| {
                    conditions.push(Condition { name: &run.condition, rows: vec![] });
                    conditions.len() - 1
                });
                let class = match run.policy.as_str() {
                    "random" => "floor".to_owned(),
                    "expert" => "expert".to_owned(),
                    name => {
                        let known = learned.iter().position(|&other| other == name).unwrap_or_else(|| {
                            learned.push(name);
                            learned.len() - 1
                        });
                        format!("c{}", known % COLOURS)
                    }
                };
                let rows = &mut conditions[at].rows;
                // Evaluations of several models over the same starts all measured the same floor.
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

    pub(crate) fn rows(&self) -> impl Iterator<Item = &Row<'a>> {
        self.conditions.iter().flat_map(|condition| &condition.rows)
    }

    /// The name of the group, escaped.
    pub(crate) fn title(&self) -> String {
        format!("{} · {}, {}", escape(self.env), escape(self.protocol), escape(&self.counting.to_string()))
    }
}

impl<'a> Condition<'a> {
    /// The random floor of the condition, if it was measured.
    pub(crate) fn floor(&self) -> Option<&Row<'a>> {
        self.rows.iter().find(|row| row.is_floor())
    }

    /// The floor to hold a run against: that of its own file, else that of the condition.
    pub(crate) fn floor_of(&self, run: &Row<'_>) -> Option<&Row<'a>> {
        self.rows.iter().find(|row| row.is_floor() && row.file == run.file).or_else(|| self.floor())
    }

    /// Every pair of policies that played the same starts, the later one first: a model, then its floor.
    pub(crate) fn pairs(&self, counting: Counting) -> Vec<(&Row<'a>, &Row<'a>, Paired)> {
        let later = self.rows.iter().enumerate();
        let pairs = later.flat_map(|(i, row)| self.rows[..i].iter().map(move |other| (row, other)));
        pairs.filter_map(|(a, b)| Some((a, b, Comparison::of(a.run, b.run, counting)?.table))).collect()
    }
}
