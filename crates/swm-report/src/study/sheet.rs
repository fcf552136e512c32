//! [`Sheet`]: the rows of a study from one source of starts with one seed, by condition, policy and counting.

use crate::plot::{Ink, inks};
use std::collections::{BTreeMap, BTreeSet};
use swm_core::results::{Counting, StudyResults, StudyRow};

/// The rows that belong into one table.
pub(super) struct Sheet<'a> {
    /// What distinguishes this sheet from the others of the study; empty if there is one.
    pub label: String,
    pub countings: Vec<Counting>,
    /// The conditions, in the order of the study.
    pub conditions: Vec<&'a str>,
    pub policies: Vec<Policy<'a>>,
    rows: BTreeMap<[usize; 3], &'a StudyRow>,
    /// The condition that is not shifted.
    pub unshifted: Option<usize>,
    /// Whether the results decided the numbers of episodes, so that statistics of a fixed number do not hold.
    pub sequential: bool,
}

/// A policy with its colour, which is the same in all sheets.
#[derive(Clone, Copy)]
pub(super) struct Policy<'a> {
    pub name: &'a str,
    pub ink: Ink,
}

impl<'a> Sheet<'a> {
    /// The sheets of a study, in the order of its rows.
    pub(super) fn all(results: &'a StudyResults) -> Vec<Self> {
        let mut groups: Vec<Vec<&StudyRow>> = vec![];
        let mut known: BTreeMap<(&str, u64, usize), usize> = BTreeMap::new();
        let mut seen: BTreeMap<(&str, u64, &str, &str, String), usize> = BTreeMap::new();
        for row in &results.rows {
            // Cells that differ in another option only, such as the budget, belong to different sheets.
            let counting = row.counting.to_string();
            let twice = seen.entry((&row.starts, row.seed, &row.condition, &row.policy, counting)).or_default();
            let sheet = *known.entry((&row.starts, row.seed, *twice)).or_insert_with(|| {
                groups.push(vec![]);
                groups.len() - 1
            });
            *twice += 1;
            groups[sheet].push(row);
        }
        let inks = inks(results.rows.iter().map(|row| row.policy.as_str()));
        let unshifted = results.rows.first().filter(|row| row.gap.is_none()).map(|row| row.condition.as_str());
        let labels = labels(&groups);
        let sheets = groups.into_iter().zip(labels).map(|(rows, label)| Self {
            sequential: results.until.is_some(),
            ..Self::of(&rows, label, unshifted, &inks)
        });
        sheets.collect()
    }

    fn of(rows: &[&'a StudyRow], label: String, unshifted: Option<&str>, inks: &BTreeMap<&'a str, Ink>) -> Self {
        let (mut conditions, mut policies) = (Index::default(), Index::default());
        let mut countings: Vec<Counting> = vec![];
        let mut cells = BTreeMap::new();
        for row in rows {
            let counting = countings.iter().position(|counting| *counting == row.counting).unwrap_or_else(|| {
                countings.push(row.counting);
                countings.len() - 1
            });
            cells.insert([conditions.of(&row.condition), policies.of(&row.policy), counting], *row);
        }
        let unshifted = conditions.names.iter().position(|name| Some(*name) == unshifted);
        let policies = policies.names.iter().map(|name| Policy { name, ink: inks[name] }).collect();
        Self { label, countings, conditions: conditions.names, policies, rows: cells, unshifted, sequential: false }
    }

    /// The row of a condition and a policy, by their indices.
    pub(super) fn row(&self, condition: usize, policy: usize, counting: usize) -> Option<&'a StudyRow> {
        self.rows.get(&[condition, policy, counting]).copied()
    }

    /// The rows of a condition, by the indices of policy and counting.
    pub(super) fn rows_of(&self, condition: usize) -> impl Iterator<Item = ([usize; 2], &'a StudyRow)> + '_ {
        let rows = self.rows.range([condition, 0, 0]..[condition + 1, 0, 0]);
        rows.map(|([_, policy, counting], row)| ([*policy, *counting], *row))
    }

    /// The indices of the policies that have a row of a condition.
    pub(super) fn policies_of(&self, condition: usize) -> Vec<usize> {
        let mut policies: Vec<usize> = self.rows_of(condition).map(|([policy, _], _)| policy).collect();
        policies.dedup();
        policies
    }

    /// The name of the source of starts.
    pub(super) fn starts(&self) -> Option<&'a String> {
        self.rows.values().next().map(|row| &row.starts)
    }

    /// The values of the variables of a condition.
    pub(super) fn variables(&self, condition: usize) -> Option<&'a BTreeMap<String, String>> {
        self.rows_of(condition).next().map(|(_, row)| &row.variables)
    }

    /// The indices of the conditions that are shifted.
    pub(super) fn shifted(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.conditions.len()).filter(|condition| Some(*condition) != self.unshifted)
    }
}

/// Names in the order in which they first appear.
#[derive(Default)]
struct Index<'a> {
    names: Vec<&'a str>,
    known: BTreeMap<&'a str, usize>,
}

impl<'a> Index<'a> {
    fn of(&mut self, name: &'a str) -> usize {
        *self.known.entry(name).or_insert_with(|| {
            self.names.push(name);
            self.names.len() - 1
        })
    }
}

/// What distinguishes the groups of rows: their starts, seeds, and variables with one value in a group.
fn labels(groups: &[Vec<&StudyRow>]) -> Vec<String> {
    type Part = (String, String);
    let parts = |rows: &Vec<&StudyRow>| -> BTreeSet<Part> {
        let Some(first) = rows.first() else { return BTreeSet::new() };
        let fixed = first.variables.iter().filter(|(name, value)| {
            // `protocol` is the counting, a column of the table.
            *name != "protocol" && *name != "seed" && rows.iter().all(|row| row.variables.get(*name) == Some(value))
        });
        let fixed = fixed.map(|(name, value)| (name.clone(), value.clone()));
        let starts = [(String::new(), first.starts.clone()), ("seed".to_owned(), first.seed.to_string())];
        starts.into_iter().chain(fixed).collect()
    };
    let all: Vec<BTreeSet<Part>> = groups.iter().map(parts).collect();
    let Some(first) = all.first() else { return vec![] };
    let shared: BTreeSet<Part> =
        first.iter().filter(|part| all.iter().all(|parts| parts.contains(part))).cloned().collect();
    let label = |parts: &BTreeSet<Part>| {
        let differ = parts.difference(&shared).map(|(name, value)| format!("{name} {value}").trim().to_owned());
        differ.collect::<Vec<_>>().join(", ")
    };
    all.iter().map(label).collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{row, study};
    use super::*;

    #[test]
    fn countings_share_a_sheet_and_seeds_do_not() {
        let mut rows = vec![row("plain", "a", &[], 9), row("red", "a", &[], 4), row("red", "random", &[], 1)];
        rows.extend(rows.clone().into_iter().map(|row| StudyRow { counting: Counting::Compat { envs: 4 }, ..row }));
        rows.extend(rows.clone().into_iter().map(|row| StudyRow { seed: 1, ..row }));
        let results = study(rows);
        let sheets = Sheet::all(&results);
        assert_eq!(sheets.iter().map(|sheet| sheet.label.as_str()).collect::<Vec<_>>(), ["seed 0", "seed 1"]);
        assert_eq!((sheets[0].countings.len(), sheets[0].conditions.len(), sheets[0].unshifted), (2, 2, Some(0)));
        assert!(sheets[0].row(1, 1, 1).is_some() && sheets[0].row(0, 1, 0).is_none());
        assert!(sheets[0].policies[1].ink == Ink::Floor);
    }

    #[test]
    fn cells_that_differ_in_another_option_have_their_own_sheets() {
        let rows = ["50", "100"].map(|budget| row("plain", "a", &[("budget", budget)], 5));
        let results = study(rows.to_vec());
        let labels: Vec<String> = Sheet::all(&results).into_iter().map(|sheet| sheet.label).collect();
        assert_eq!(labels, ["budget 50", "budget 100"]);
    }
}
