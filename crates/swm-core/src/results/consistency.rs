//! Checks that the statistics in [`Results`] are those of the episodes in them.
//!
//! A results file may be edited or damaged. Its rates, intervals and comparisons are therefore never shown as they
//! stand: they must equal the values that are computed again from the episodes. What the results are of must be what the
//! request in their manifest says.

use super::{Comparison, Counting, Paired, Prediction, Proportion, Results, Run, Summary};
use serde::Deserialize as _;
use std::collections::{BTreeMap, BTreeSet};

impl Results {
    /// Checks that every statistic equals the statistic of the episodes, that a policy has one run under a condition, and that the
    /// results are of what the manifest says.
    ///
    /// # Errors
    /// When a value differs; the text names the run, the stated value and the value of its episodes.
    pub fn check(&self) -> Result<(), String> {
        self.check_request()?;
        let mut seen = BTreeSet::new();
        if let Some(run) = self.runs.iter().find(|run| !seen.insert((&run.policy, &run.condition))) {
            return Err(format!("it has two runs of '{}' under '{}'", run.policy, run.condition));
        }
        self.runs.iter().try_for_each(|run| check_run(run, self.counting, self.stopping.is_some()))?;
        self.check_independence()?;
        self.check_stopping()?;
        if self.comparisons.is_empty() {
            return Ok(());
        }
        // All runs make the family of a comparison, not only those of the stated comparisons.
        let mut expected: BTreeMap<[&str; 3], &Paired> = BTreeMap::new();
        let all = Comparison::all_by(self.comparing(), &self.runs, self.counting);
        for comparison in &all {
            expected.entry(names(comparison)).or_insert(&comparison.table);
        }
        let mut seen = BTreeSet::new();
        for stated in &self.comparisons {
            let [condition, a, b] = names(stated);
            let wrong = |problem: &str| Err(format!("the comparison of {a} and {b} {problem} ({condition})"));
            if !seen.insert([condition, a, b]) {
                return wrong("is stated twice");
            }
            if !expected.get(&[condition, a, b]).is_some_and(|computed| same_table(&stated.table, computed)) {
                return wrong("does not match the episodes");
            }
        }
        match expected.keys().find(|names| !seen.contains(*names)) {
            Some([condition, a, b]) => Err(format!("the comparison of {a} and {b} is left out ({condition})")),
            None => Ok(()),
        }
    }

    /// Checks that the environment, protocol, counting and seed are those of the request in the manifest, as far as it states them.
    fn check_request(&self) -> Result<(), String> {
        let requested = |name: &str| self.manifest.config.get(name);
        let is_other = requested("env").is_some_and(|env| env != self.env.as_str())
            || requested("seed").is_some_and(|seed| *seed != self.manifest.seed)
            || requested("starts").is_some_and(|starts| (starts == "episodic") != (self.protocol == "episodic"))
            || requested("counting")
                .is_some_and(|counting| Counting::deserialize(counting).ok() != Some(self.counting));
        if is_other {
            return Err("it states another environment, protocol, counting or seed than its request".to_owned());
        }
        let budget = requested("budget").and_then(serde_json::Value::as_u64).unwrap_or(u64::MAX);
        let mut episodes = self.runs.iter().flat_map(|run| &run.episodes);
        if let Some(episode) = episodes.find(|episode| episode.steps as u64 > budget) {
            return Err(format!("it has an episode of {} steps, and its budget is {budget}", episode.steps));
        }
        // The name of the floor is the name of a policy.
        let policies = requested("policies").and_then(|policies| policies.as_array());
        let is_false_floor = |policy: &&serde_json::Value| {
            policy["name"] == "random" && !policy["acts"].is_null() && policy["acts"] != "random"
        };
        match policies.into_iter().flatten().find(is_false_floor) {
            Some(policy) => Err(format!("its policy 'random' is another one by its request: {}", policy["acts"])),
            None => Ok(()),
        }
    }

    /// Checks that no two starts come from one recorded episode, if the results decided the number of episodes.
    fn check_independence(&self) -> Result<(), String> {
        if self.stopping.is_none() && !self.sequential {
            return Ok(());
        }
        for run in &self.runs {
            let mut seen = BTreeSet::new();
            let mut episodes = run.episodes.iter().filter_map(|episode| Some(episode.start?[0]));
            if let Some(episode) = episodes.find(|episode| !seen.insert(*episode)) {
                return Err(format!(
                    "{} ({}) has several starts of the recorded episode {episode}, and its results decided how many starts \
                     there are, which takes independent ones; evaluate again with this version",
                    run.policy, run.condition
                ));
            }
        }
        Ok(())
    }

    /// Checks how the evaluation is said to have ended.
    fn check_stopping(&self) -> Result<(), String> {
        let Some(stopping) = &self.stopping else { return Ok(()) };
        let (episodes, most) = (self.episodes(), stopping.most);
        if episodes > most || self.runs.iter().any(|run| run.episodes.len() != episodes) {
            return Err(format!("it states at most {most} episodes, the same for all runs, and its runs have others"));
        }
        let met = self.meets(stopping.until);
        if met != stopping.met {
            let says = |met| if met { "met" } else { "not met" };
            let [stated, found] = [stopping.met, met].map(says);
            return Err(format!("it states that {stopping} is {stated}, but by its episodes it is {found}"));
        }
        Ok(())
    }
}

/// The condition and the policies of a comparison.
fn names(comparison: &Comparison) -> [&str; 3] {
    [&comparison.condition, &comparison.a, &comparison.b].map(String::as_str)
}

fn same_table(stated: &Paired, computed: &Paired) -> bool {
    let counts = |table: &Paired| [table.both, table.only_a, table.only_b, table.neither, table.comparisons];
    let values = |table: &Paired| [table.p, table.p_holm, table.design_effect, table.difference, table.low, table.high];
    let e = |table: &Paired| [table.e.unwrap_or(f64::NAN)];
    counts(stated) == counts(computed)
        && stated.e.is_some() == computed.e.is_some()
        && (stated.e.is_none() || close(&e(stated), &e(computed)))
        && stated.verdict == computed.verdict
        && close(&values(stated), &values(computed))
}

/// Checks the statistics of one run.
fn check_run(run: &Run, counting: Counting, sequential: bool) -> Result<(), String> {
    let interval = if sequential { Proportion::sequential } else { Proportion::wilson };
    let wrong = |problem: String| Err(format!("{} ({}) {problem}", run.policy, run.condition));
    let rates = |p: &Proportion| [p.rate, p.low, p.high, p.design_effect];
    let (solved_at_start, computed, time_to_goal) = Run::statistics(counting, &run.episodes);
    let independent = interval(computed.successes, computed.n);
    let (stated, computed) = (&run.success, if sequential { independent } else { computed });
    if (stated.successes, stated.n) != (computed.successes, computed.n) {
        return wrong(format!(
            "states {} successes in {}, but its episodes have {} in {}",
            stated.successes, stated.n, computed.successes, computed.n
        ));
    }
    // Older versions took starts from one recorded episode as independent.
    if !close(&rates(stated), &rates(&computed)) && !close(&rates(stated), &rates(&independent)) {
        let percent = |p: &Proportion| [p.rate, p.low, p.high].map(|rate| format!("{:.1} %", 100.0 * rate));
        let ([rate, low, high], [new_rate, new_low, new_high]) = (percent(stated), percent(&computed));
        return wrong(format!(
            "states a success rate of {rate} ({low} to {high}), but its episodes have {new_rate} ({new_low} to {new_high})"
        ));
    }
    if run.solved_at_start != solved_at_start {
        let stated = run.solved_at_start;
        return wrong(format!("states {stated} episodes solved at start, but its episodes have {solved_at_start}"));
    }
    if let Some(strict) = &run.strict {
        // The episodes do not determine the strict successes of an evaluation with another counting.
        let n = run.episodes.len() - solved_at_start;
        if strict.n != n || strict.successes > n {
            return wrong(format!(
                "states {} strict successes in {} episodes, but {n} of its episodes were not solved at start",
                strict.successes, strict.n
            ));
        }
        if !close(&rates(strict), &rates(&interval(strict.successes, n))) {
            return wrong("states a strict success rate that its strict successes do not have".to_owned());
        }
    }
    if !same_summary(run.time_to_goal.as_ref(), time_to_goal.as_ref()) {
        return wrong("states a time to goal that its episodes do not have".to_owned());
    }
    if run.prediction.as_ref().is_some_and(|prediction| !is_consistent(prediction)) {
        return wrong("states prediction errors that its trajectories do not have".to_owned());
    }
    Ok(())
}

/// Whether the groups of a prediction are those of its trajectories.
fn is_consistent(stated: &Prediction) -> bool {
    let mut lengths = stated.trajectories.iter().map(|trajectory| trajectory.errors.len());
    let horizon = lengths.next().unwrap_or(1);
    if horizon == 0 || lengths.any(|length| length != horizon) {
        return false;
    }
    let computed = Prediction::new(stated.frameskip, stated.variance, stated.trajectories.clone());
    stated.groups.len() == computed.groups.len()
        && stated.groups.iter().zip(&computed.groups).all(|(a, b)| {
            a.success == b.success
                && a.steps.len() == b.steps.len()
                && same_summary(Some(&a.trajectory), Some(&b.trajectory))
                && a.steps.iter().zip(&b.steps).all(|(a, b)| same_summary(Some(a), Some(b)))
        })
}

fn same_summary(a: Option<&Summary>, b: Option<&Summary>) -> bool {
    match (a, b) {
        (None, None) => true,
        (Some(a), Some(b)) => a.n == b.n && close(&[a.mean, a.median, a.p95], &[b.mean, b.median, b.p95]),
        _ => false,
    }
}

/// Whether values are equal up to the rounding of another order of operations.
fn close(stated: &[f64], computed: &[f64]) -> bool {
    stated.iter().zip(computed).all(|(a, b)| a == b || (a - b).abs() <= 1e-9 * a.abs().max(b.abs()).max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{EpisodeResult, Timing};
    use serde_json::json;

    #[test]
    fn another_policy_is_not_the_floor() {
        let of = |acts: serde_json::Value| {
            let mut results = Results::default();
            results.manifest.config = json!({ "policies": [{ "name": "random", "acts": acts }] });
            results.check()
        };
        of(json!("random")).expect("the floor");
        let error = of(json!("no-op")).expect_err("another policy");
        assert!(error.contains("'random' is another one by its request: \"no-op\""), "{error}");
    }

    #[test]
    fn episodes_are_no_longer_than_their_budget() {
        let episodes = [3, 7].map(|steps| EpisodeResult { steps, ..EpisodeResult::default() });
        let mut results = Results::default();
        let run = Run::new("in distribution", "expert", results.counting, episodes.into(), Timing::default());
        results.runs.push(run);
        for (budget, is_right) in [(json!(7), true), (json!(null), true), (json!(6), false)] {
            results.manifest.config = json!({ "budget": budget });
            let checked = results.check();
            assert_eq!(checked.is_ok(), is_right, "{budget}: {checked:?}");
        }
        let error = results.check().expect_err("a longer episode");
        assert!(error.contains("an episode of 7 steps, and its budget is 6"), "{error}");
    }
}
