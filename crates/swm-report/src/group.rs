//! [`Group`]: the runs of one environment, protocol, counting and task, by condition, from all files.

use crate::limits;
use crate::plot::{Ink, inks};
use crate::text::{escape, shorten};
use serde_json::Value;
use std::path::PathBuf;
use swm_core::Results;
use swm_core::results::{Comparing, Comparison, Counting, Family, Paired, Proportion, Run, Stopping, Verdict, pairs};

/// All runs in one environment with the same protocol, counting and task.
pub(crate) struct Group<'a> {
    pub env: &'a str,
    pub protocol: &'a str,
    pub counting: Counting,
    pub task: Task<'a>,
    /// Whether another group differs in the task only.
    pub has_twin: bool,
    /// How the runs of a results file ended whose results decided their number of episodes, and that number.
    pub stopped: Vec<(Stopping, usize)>,
    pub conditions: Vec<Condition<'a>>,
}

/// What success means beside the counting, as far as the results say so: runs of other tasks are not compared.
#[derive(Clone, Copy, Default, PartialEq)]
pub(crate) struct Task<'a> {
    /// The time limit in steps; null for that of the environment.
    budget: Option<&'a Value>,
    /// The origin of starts and goals, and the hash of their dataset.
    starts: Option<&'a Value>,
    dataset: Option<&'a String>,
}

impl<'a> Task<'a> {
    fn of(results: &'a Results) -> Self {
        let manifest = &results.manifest;
        let [budget, starts] = ["budget", "starts"].map(|name| manifest.config.get(name));
        Self { budget, starts, dataset: manifest.hashes.get("dataset") }
    }

    /// The task in words.
    fn words(&self) -> String {
        let limit = match self.budget.and_then(Value::as_u64) {
            Some(steps) => format!("at most {steps} steps"),
            None => "the time limit of the environment".to_owned(),
        };
        let Some(starts) = self.starts.and_then(|starts| starts.get("dataset")) else { return limit };
        let name = starts.get("dataset").and_then(Value::as_str).unwrap_or_default();
        let offset = starts.get("goal_offset").and_then(Value::as_u64).unwrap_or_default();
        format!("{limit}, goals {offset} steps after starts of {name}")
    }
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
    /// The colour of the policy.
    pub ink: Ink,
}

impl Row<'_> {
    /// Whether this is the random-policy floor.
    pub(crate) fn is_floor(&self) -> bool {
        self.ink == Ink::Floor
    }

    /// Whether both are the same run.
    pub(crate) fn is(&self, other: &Row<'_>) -> bool {
        std::ptr::eq(self.run, other.run)
    }
}

impl<'a> Group<'a> {
    /// The groups of these results, in the order in which they first appear.
    pub(crate) fn all(results: &'a [(PathBuf, Results)]) -> Vec<Self> {
        let mut groups: Vec<Self> = vec![];
        let inks = inks(results.iter().flat_map(|(_, result)| &result.runs).map(|run| run.policy.as_str()));
        for (file, (_, result)) in results.iter().enumerate() {
            let counting = result.counting;
            let (env, protocol, task) = (&*result.env, &*result.protocol, Task::of(result));
            let is_twin = |g: &Self| (g.env, g.protocol, g.counting) == (env, protocol, counting);
            let index = groups.iter().position(|group| is_twin(group) && group.task == task).unwrap_or_else(|| {
                let twins = groups.iter_mut().filter(|group| is_twin(group));
                let has_twin = twins.map(|group| group.has_twin = true).count() > 0;
                groups.push(Self { env, protocol, counting, task, has_twin, stopped: vec![], conditions: vec![] });
                groups.len() - 1
            });
            groups[index].stopped.extend(result.stopping.map(|stopping| (stopping, result.episodes())));
            let conditions = &mut groups[index].conditions;
            for run in &result.runs {
                let at = conditions.iter().position(|c| c.name == run.condition).unwrap_or_else(|| {
                    conditions.push(Condition { name: &run.condition, rows: vec![] });
                    conditions.len() - 1
                });
                let ink = inks[run.policy.as_str()];
                let rows = &mut conditions[at].rows;
                // Evaluations of several models on the same starts contain the same floor.
                if ink == Ink::Floor && rows.iter().any(|row| row.is_floor() && row.run.episodes == run.episodes) {
                    continue;
                }
                rows.push(Row { run, file, label: run.policy.clone(), ink });
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

    /// The comparison of two runs. If the results of one file decided its number of episodes, all comparisons hold at any number.
    pub(crate) fn comparing(&self) -> Comparing {
        if self.stopped.is_empty() { Paired::of_runs } else { Paired::sequential }
    }

    /// All runs, by condition.
    pub(crate) fn rows(&self) -> impl Iterator<Item = &Row<'a>> {
        self.conditions.iter().flat_map(|condition| &condition.rows)
    }

    /// The heading of the group, escaped.
    pub(crate) fn title(&self) -> String {
        let [env, protocol] = [self.env, self.protocol].map(|words| escape(&shorten(words, limits::TEXT_CHARS)));
        let task = if self.has_twin { format!(", {}", self.task.words()) } else { String::new() };
        let task = escape(&shorten(&task, limits::TEXT_CHARS));
        format!("{env} · {protocol}, {}{task}", escape(&self.counting.to_string()))
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

    /// The run of the highest success rate, apart from the floor.
    pub(crate) fn best(&self) -> Option<&Row<'a>> {
        let rows = self.rows.iter().filter(|row| !row.is_floor() && row.run.success.n > 0);
        // `max_by` returns the last maximum; the first of equal runs is the best.
        rows.rev().max_by(|a, b| a.run.success.rate.total_cmp(&b.run.success.rate))
    }

    /// The success rate of the floor, and the verdict on a run against it: that of a comparison on the same starts, or
    /// else of the intervals of both rates. `None` without a floor.
    pub(crate) fn against_floor(
        &self,
        compared: Option<&Compared<'_, '_>>,
        row: &Row<'_>,
    ) -> Option<(Proportion, Verdict)> {
        let nearest = self.floor_of(row)?;
        for floor in [nearest, self.floor()?] {
            if let Some(verdict) = compared.and_then(|compared| compared.verdict(row, floor)) {
                return Some((floor.run.success, verdict));
            }
        }
        let (own, floor) = (row.run.success, nearest.run.success);
        let verdict = match (own.low > floor.high, own.high < floor.low) {
            (true, _) => Verdict::Higher,
            (_, true) => Verdict::Lower,
            _ => Verdict::NotToldApart,
        };
        Some((floor, verdict))
    }

    /// Compares the pairs of runs that played the same starts; `None` without pairs.
    fn compare(&self, by: Comparing, counting: Counting) -> Option<Compared<'_, 'a>> {
        let runs: Vec<&Run> = self.rows.iter().map(|row| row.run).collect();
        let is_reference = |row: &Row<'_>| row.is_floor() || self.best().is_some_and(|best| best.is(row));
        let pairs = pairs(&runs).map(|(later, earlier)| (&self.rows[later], &self.rows[earlier]));
        let mut pairs: Vec<Pair<'_, 'a>> = pairs
            .filter_map(|(a, b)| {
                let table = Comparison::by(by, a.run, b.run, counting)?.table;
                Some(Pair { a, b, table, is_first: is_reference(a) || is_reference(b) })
            })
            .collect();
        let mut tables: Vec<&mut Paired> = pairs.iter_mut().map(|pair| &mut pair.table).collect();
        let family = Family::correct(self.name, &mut tables, 0)?;
        Some(Compared { family, pairs })
    }
}

/// The compared pairs of a condition, which form a family.
pub(crate) struct Compared<'g, 'a> {
    pub family: Family,
    /// The later run first: usually a model, then the random-policy floor.
    pub pairs: Vec<Pair<'g, 'a>>,
}

/// Two runs on the same starts.
pub(crate) struct Pair<'g, 'a> {
    pub a: &'g Row<'a>,
    pub b: &'g Row<'a>,
    pub table: Paired,
    /// Whether one of the runs is the floor or the best run of the condition: what a reader looks at first.
    pub is_first: bool,
}

impl<'g, 'a> Compared<'g, 'a> {
    /// The comparisons of every condition of a group that has some.
    pub(crate) fn all(group: &'g Group<'a>) -> Vec<Self> {
        let of = |condition: &'g Condition<'a>| condition.compare(group.comparing(), group.counting);
        group.conditions.iter().filter_map(of).collect()
    }

    /// The comparisons of a condition, if it has some.
    pub(crate) fn of<'c>(all: &'c [Self], condition: &Condition<'_>) -> Option<&'c Self> {
        all.iter().find(|compared| compared.family.name == condition.name)
    }

    /// The verdict on a run, compared with another; `None` if they were not compared.
    pub(crate) fn verdict(&self, run: &Row<'_>, other: &Row<'_>) -> Option<Verdict> {
        self.pairs.iter().find_map(|Pair { a, b, table, .. }| {
            if a.is(run) && b.is(other) {
                Some(table.verdict)
            } else if a.is(other) && b.is(run) {
                Some(table.verdict.reversed())
            } else {
                None
            }
        })
    }
}
