//! [`Gaps`]: the generalisation gap of a policy, its success under every shift minus that in distribution.

use crate::group::{Group, Row};
use serde_json::Value;
use std::path::PathBuf;
use swm_core::Results;
use swm_core::results::{Family, Paired};

/// The name of the condition without a shift.
pub(crate) const IN_DISTRIBUTION: &str = "in distribution";

/// The gaps of one policy, which form a family.
pub(crate) struct Gaps<'g, 'a> {
    /// The run in distribution.
    pub reference: &'g Row<'a>,
    pub family: Family,
    pub gaps: Vec<Gap<'a>>,
}

/// The success under a condition minus that in distribution, on the same starts.
pub(crate) struct Gap<'a> {
    pub condition: &'a str,
    pub table: Paired,
}

impl<'g, 'a> Gaps<'g, 'a> {
    /// The gaps of every policy of a group that played the same starts in distribution and under a shift. The
    /// random-policy floor is left out unless there is no other policy: it does not depend on observations.
    pub(crate) fn all(group: &'g Group<'a>, results: &[(PathBuf, Results)]) -> Vec<Self> {
        let is_reference = |name: &str| name == IN_DISTRIBUTION;
        let Some(plain) = group.conditions.iter().find(|condition| is_reference(condition.name)) else {
            return vec![];
        };
        let shifted = || group.conditions.iter().filter(|condition| !is_reference(condition.name));
        let only_floor = group.rows().all(Row::is_floor);
        let references = plain.rows.iter().filter(|row| only_floor || !row.is_floor());
        let of = |reference: &'g Row<'a>| {
            let gaps = shifted().filter_map(|condition| {
                let same = |row: &&Row<'a>| is_same_policy(results, reference, row);
                let paired = |row: &Row<'a>| group.comparing()(row.run, reference.run, group.counting);
                let table = condition.rows.iter().filter(same).find_map(paired)?;
                Some(Gap { condition: condition.name, table })
            });
            let mut gaps: Vec<Gap<'a>> = gaps.collect();
            let mut tables: Vec<&mut Paired> = gaps.iter_mut().map(|gap| &mut gap.table).collect();
            let family = Family::correct(&reference.label, &mut tables, 0)?;
            Some(Self { reference, family, gaps })
        };
        references.filter_map(of).collect()
    }
}

/// Whether two runs, perhaps of different files, are of one policy: its name, its settings and its weights are equal, and
/// so are the time limit and the origin of the starts.
fn is_same_policy(results: &[(PathBuf, Results)], a: &Row<'_>, b: &Row<'_>) -> bool {
    a.run.policy == b.run.policy && (a.file == b.file || identity(results, a) == identity(results, b))
}

/// What determines the actions of a policy, as far as its results file says so: its settings, those of the evaluation, and the hash of its
/// weights.
fn identity<'r>(results: &'r [(PathBuf, Results)], row: &Row<'_>) -> ([Option<&'r Value>; 4], Option<&'r String>) {
    let manifest = &results[row.file].1.manifest;
    let config = &manifest.config;
    let policies = config.get("policies").and_then(Value::as_array);
    let is_this = |policy: &&Value| policy.get("name").and_then(Value::as_str) == Some(&row.run.policy);
    let policy = policies.and_then(|policies| policies.iter().find(is_this));
    // A file of one policy does not name it beside the hash.
    let weights = manifest.hashes.get(&format!("weights of {}", row.run.policy));
    let settings = [policy, config.get("budget"), config.get("starts"), config.get("image")];
    (settings, weights.or_else(|| manifest.hashes.get("weights")))
}
