//! What a group of runs shows, in one sentence.

use crate::gap::{Gaps, IN_DISTRIBUTION};
use crate::group::{Compared, Condition, Group, Row};
use crate::plot::Ink;
use crate::text::{percent, points, shorten};
use swm_core::results::Verdict;

/// Returns the sentence: the success rate of the best learned policy in distribution, how it compares with the
/// random-policy floor and with the other policies, and what shifts cost it. `None` without an episode that counts.
pub(crate) fn sentence(group: &Group<'_>, compared: &[Compared<'_, '_>], gaps: &[Gaps<'_, '_>]) -> Option<String> {
    let counted = |condition: &&Condition<'_>| condition.rows.iter().any(|row| row.run.success.n > 0);
    let condition = group.conditions.iter().find(|condition| condition.name == IN_DISTRIBUTION).filter(counted);
    let condition = condition.or_else(|| group.conditions.iter().find(counted))?;
    let compared = Compared::of(compared, condition);
    let learned = || condition.rows.iter().filter(|row| is_learned(row) && row.run.success.n > 0);
    let best = learned().rev().max_by(|a, b| a.run.success.rate.total_cmp(&b.run.success.rate));
    let best = best.or_else(|| condition.best()).or_else(|| condition.floor())?;
    let p = best.run.success;
    let mut words = format!(
        "{} solves {} of {} starts [{:.0}, {:.0}]",
        name(&best.label),
        percent(p.rate),
        p.n,
        100.0 * p.low,
        100.0 * p.high
    );
    if condition.name != IN_DISTRIBUTION {
        words += &format!(" under “{}”", name(condition.name));
    }
    match condition.against_floor(compared, best).filter(|(floor, _)| floor.n > 0) {
        _ if best.is_floor() => words += ": it is the random-policy floor",
        Some((floor, verdict)) => words += &format!(", {} {}", against(verdict), percent(floor.rate)),
        None => words += "; the random-policy floor was not measured",
    }
    let others: Vec<&Row<'_>> = learned().filter(|row| !row.is(best)).collect();
    if !others.is_empty() && is_learned(best) {
        let worse = |row: &&Row<'_>| compared.and_then(|c| c.verdict(best, row)) == Some(Verdict::Higher);
        let apart = others.iter().copied().filter(worse).count();
        words += &match (others.len(), apart) {
            (1, 0) => format!("; it is not told apart from {}", name(&others[0].label)),
            (1, _) => format!("; it is better than {}", name(&others[0].label)),
            (n, apart) => format!("; it is told apart from {apart} of the {n} other policies"),
        };
    }
    words += &gaps.iter().find(|gaps| gaps.reference.is(best)).map_or(String::new(), shifts);
    Some(words + ".")
}

/// How a rate compares with the floor, in words.
pub(super) fn against(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Higher => "above the random-policy floor of",
        Verdict::Lower => "below the random-policy floor of",
        Verdict::NotToldApart => "not told apart from the random-policy floor of",
        Verdict::TooFew => "too few starts differ to tell it from the random-policy floor of",
    }
}

/// What shifts cost a policy.
fn shifts(gaps: &Gaps<'_, '_>) -> String {
    let lower = gaps.gaps.iter().filter(|gap| gap.table.verdict == Verdict::Lower).count();
    let worst = gaps.gaps.iter().min_by(|a, b| a.table.difference.total_cmp(&b.table.difference));
    let n = gaps.gaps.len();
    match worst {
        Some(worst) if lower > 0 => {
            let [loss, low, high] = [-worst.table.difference, -worst.table.high, -worst.table.low].map(points);
            let [loss, low, high] = [loss, low, high].map(|points| points.trim_start_matches('+').to_owned());
            let count = if n > 1 { format!("; {lower} of {n} shifts cost it success") } else { String::new() };
            format!(", and loses {loss} points [{low}, {high}] under “{}”{count}", name(worst.condition))
        }
        Some(worst) if n == 1 => format!("; its gap under “{}” is not told apart from zero", name(worst.condition)),
        Some(_) => format!("; none of its {n} gaps under shifts is told apart from zero"),
        None => String::new(),
    }
}

/// Policies that a trained policy is measured against, beside the floor and the expert.
const BASELINES: [&str; 4] = ["simulator", "no-op", "replay", "nearest"];

/// Whether a run is of a policy that was trained.
fn is_learned(row: &Row<'_>) -> bool {
    matches!(row.ink, Ink::Policy(_)) && !BASELINES.contains(&row.run.policy.as_str())
}

fn name(name: &str) -> String {
    shorten(name, 120)
}
