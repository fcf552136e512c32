//! Tables of evaluation results: success, prediction errors, and comparisons of policies.

use super::table;
use swm_core::Results;
use swm_core::results::{Comparison, Paired, Proportion, Run};
use swm_report::number;

/// Returns the tables of some results.
pub fn summary(results: &Results) -> String {
    let stopping = results.stopping.map(|stopping| format!("{}\n", stopping.note(results.episodes())));
    [success(results), stopping, prediction_errors(results), gaps(results), comparisons(results)]
        .into_iter()
        .flatten()
        .collect::<Vec<_>>()
        .join("\n")
}

/// Formats a success rate with its 95 % confidence interval; of no episodes there is none.
pub fn percent(p: &Proportion) -> String {
    if p.n == 0 {
        return "–".to_owned();
    }
    format!("{:.0} % [{:.0}, {:.0}]", 100.0 * p.rate, 100.0 * p.low, 100.0 * p.high)
}

/// The success rate, time to goal and planning time of every run.
fn success(results: &Results) -> Option<String> {
    let rows = results.runs.iter().map(|run: &Run| {
        vec![
            run.condition.clone(),
            run.policy.clone(),
            percent(&run.success),
            run.success.n.to_string(),
            run.solved_at_start.to_string(),
            run.time_to_goal.map_or("–".to_owned(), |t| number(t.median)),
            run.timing
                .plan_seconds
                .map_or("–".to_owned(), |t| format!("{} ({})", duration(t.median), duration(t.p95))),
        ]
    });
    Some(table(
        &["condition", "policy", "success [95 %]", "n", "solved at start", "median steps", "plan, median (p95)"],
        rows,
    ))
}

/// The errors of the models' predictions on the recorded trajectories; `None` where they were not requested.
fn prediction_errors(results: &Results) -> Option<String> {
    let predicted = results.runs.iter().filter_map(|run| Some((run, run.prediction.as_ref()?)));
    let rows: Vec<Vec<String>> = predicted
        .flat_map(|(run, prediction)| {
            prediction.groups.iter().map(move |group| {
                let outcome = group.success.map_or("all", |success| if success { "successes" } else { "failures" });
                let last = group.steps.last().map_or(f64::NAN, |step| step.mean);
                vec![
                    run.condition.clone(),
                    run.policy.clone(),
                    outcome.to_owned(),
                    group.trajectory.n.to_string(),
                    format!("{:.3}", group.trajectory.mean),
                    format!("{last:.3}"),
                ]
            })
        })
        .collect();
    let header = ["condition", "model", "trajectories of", "n", "prediction error", "at the last step"];
    (!rows.is_empty()).then(|| table(&header, rows))
}

/// The difference with its interval, the corrected p-value, and the verdict of a comparison.
pub fn compared(paired: &Paired) -> [String; 3] {
    let [difference, low, high] = [paired.difference, paired.low, paired.high].map(|share| 100.0 * share);
    let p = paired.p_corrected();
    [
        format!("{difference:+.0} % [{low:+.0}, {high:+.0}]"),
        if p < 1e-4 { "< 0.0001".to_owned() } else { format!("{p:.4}") },
        paired.verdict.to_string(),
    ]
}

/// The gap of every condition to the first one, for the same policy on the same starts; `None` for one condition. The gaps of
/// one policy are a family.
fn gaps(results: &Results) -> Option<String> {
    let first = &results.runs.first()?.condition;
    let (gaps, families) = results.gaps();
    let notes = families.iter().map(|family| format!("{}: {family}\n", family.name)).collect::<String>();
    let rows = gaps.iter().map(|gap| {
        let [difference, p, verdict] = compared(&gap.table);
        vec![gap.condition.clone(), gap.policy.clone(), difference, p, verdict]
    });
    let title = format!("gap to '{first}' [95 %]");
    (!gaps.is_empty()).then(|| table(&["condition", "policy", &title, "p, corrected", "verdict"], rows) + &notes)
}

/// The paired comparisons of policies; `None` for fewer than two policies.
fn comparisons(results: &Results) -> Option<String> {
    let rows = results.comparisons.iter().map(|comparison| {
        let paired = &comparison.table;
        let [difference, p, verdict] = compared(paired);
        vec![
            comparison.condition.clone(),
            format!("{} – {}", comparison.a, comparison.b),
            difference,
            format!("{} : {}", paired.only_a, paired.only_b),
            p,
            verdict,
        ]
    });
    let header = ["condition", "compared", "difference [95 %]", "only one solved", "p, corrected", "verdict"];
    let families = Comparison::families(&mut results.comparisons.clone());
    let notes = families.iter().map(|family| format!("{}: {family}\n", family.name)).collect::<String>();
    (!results.comparisons.is_empty()).then(|| table(&header, rows) + &notes)
}

/// Formats a duration in seconds.
fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 0.01 => format!("{:.2} ms", 1e3 * s),
        s if s < 1.0 => format!("{:.0} ms", 1e3 * s),
        s => format!("{s:.2} s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{Counting, EpisodeResult, Timing};

    #[test]
    fn medians_are_not_rounded_to_steps() {
        let solved = |steps| EpisodeResult { success: true, steps, ..EpisodeResult::new(steps as u64) };
        let run = |steps: &[usize]| {
            let episodes = steps.iter().copied().map(solved).collect();
            Run::new("in distribution", "expert", Counting::default(), episodes, Timing::default())
        };
        for (steps, median) in [(&[25, 48][..], "36.5"), (&[25, 36, 48], "36")] {
            let text = summary(&Results { runs: vec![run(steps)], ..Results::default() });
            assert!(text.split_whitespace().any(|word| word == median), "{steps:?}: {text}");
        }
    }
}
