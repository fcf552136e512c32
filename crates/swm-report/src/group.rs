//! Which runs belong side by side: those of one environment and protocol, by condition, whatever file they
//! come from.

use crate::text::escape;
use std::path::PathBuf;
use swm_core::Results;
use swm_core::results::Run;

/// How many policies get a colour of their own before colours repeat.
const COLOURS: usize = 6;

/// Everything measured in one environment under one protocol.
pub(crate) struct Group<'a> {
    pub env: &'a str,
    pub protocol: &'a str,
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
    /// The policy's name, with the number of its file where several files stand side by side.
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
            let place = groups.iter().position(|g| g.env == result.env && g.protocol == result.protocol);
            let place = place.unwrap_or_else(|| {
                groups.push(Self { env: &result.env, protocol: &result.protocol, conditions: vec![] });
                groups.len() - 1
            });
            let shared = results.iter().filter(|(_, r)| r.env == result.env && r.protocol == result.protocol).count();
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
                let mark = if shared > 1 { format!(" [{}]", file + 1) } else { String::new() };
                conditions[at].rows.push(Row { run, file, label: format!("{}{mark}", run.policy), class });
            }
        }
        groups
    }

    pub(crate) fn rows(&self) -> impl Iterator<Item = &Row<'a>> {
        self.conditions.iter().flat_map(|condition| &condition.rows)
    }

    /// The name of the group, escaped.
    pub(crate) fn title(&self) -> String {
        format!("{} · {}", escape(self.env), escape(self.protocol))
    }
}

impl<'a> Condition<'a> {
    /// The random floor of the condition, if it was measured.
    pub(crate) fn floor(&self) -> Option<&Row<'a>> {
        self.rows.iter().find(|row| row.is_floor())
    }
}
