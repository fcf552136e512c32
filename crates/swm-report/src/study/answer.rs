//! What a study shows, in one sentence.

use super::told_apart;
use crate::limits;
use crate::text::shorten;
use swm_core::results::{Counting, Paired, Predicts, StudyResults, StudyRow};

/// The largest number of policies that the sentence counts gaps for.
const POLICIES: usize = 4;

/// Returns the answer: the largest drop, and how many gaps are told apart from zero.
pub(super) fn sentence(results: &StudyResults) -> String {
    let counting =
        results.rows.iter().map(|row| row.counting).find(|counting| matches!(counting, Counting::Strict { .. }));
    let Some(counting) = counting.or(results.rows.first().map(|row| row.counting)) else {
        return format!("None of the {} cells is done.", results.cells);
    };
    let several = results.rows.iter().any(|row| row.counting != counting);
    // The floor depends on no observation, so its gaps are of interest only where there are no others.
    let only_floor = results.rows.iter().all(|row| row.policy == "random");
    let rows = results.rows.iter().filter(|row| row.counting == counting && (only_floor || row.policy != "random"));
    let gaps: Vec<(&StudyRow, &Paired)> =
        rows.filter_map(|row| Some((row, row.gap.as_ref()?))).filter(|(_, gap)| gap.difference.is_finite()).collect();
    let of_counting = results.rows.iter().filter(|row| row.counting == counting);
    let predictions: Vec<Predicts> =
        of_counting.filter_map(|row| Some(row.prediction.as_ref()?.discrimination?.verdict)).collect();
    let mut words = if results.done < results.cells {
        format!("With {} of {} cells done, ", results.done, results.cells)
    } else {
        String::new()
    };
    let largest = gaps.iter().min_by(|(_, a), (_, b)| a.difference.total_cmp(&b.difference));
    words += &match largest {
        None if !predictions.is_empty() => {
            let count = |of: Predicts| predictions.iter().filter(|verdict| **verdict == of).count();
            format!(
                "the prediction error predicts success in {} of {} comparisons, does not predict it in {}, and leaves {} undecided",
                count(Predicts::Yes),
                predictions.len(),
                count(Predicts::No),
                count(Predicts::Undecided)
            )
        }
        None => "no condition is compared with another yet".to_owned(),
        Some((_, gap)) if gap.difference >= 0.0 => "success falls under none of the conditions".to_owned(),
        Some((row, gap)) => {
            let points = |share: f64| format!("{:.1}", 100.0 * share).replace('-', "\u{2212}");
            let [drop, low, high] = [-gap.difference, -gap.high, -gap.low].map(points);
            format!(
                "success falls most for {} under “{}”, by {drop} points [{low}, {high}]",
                name(&row.policy),
                name(&row.condition)
            )
        }
    };
    if several {
        words += &format!(" with {} counting", counting.name());
    }
    if !gaps.is_empty() {
        words += &counts(&gaps);
    }
    let mut letters = words.chars();
    let first: String = letters.next().into_iter().flat_map(char::to_uppercase).collect();
    format!("{first}{}.", letters.as_str())
}

/// How many gaps are told apart from zero, in all and for each policy.
fn counts(gaps: &[(&StudyRow, &Paired)]) -> String {
    let mut policies: Vec<&str> = vec![];
    for (row, _) in gaps {
        if !policies.contains(&row.policy.as_str()) && policies.len() <= POLICIES {
            policies.push(&row.policy);
        }
    }
    let count = |of: &dyn Fn(&StudyRow) -> bool| {
        let of: Vec<_> = gaps.iter().filter(|(row, _)| of(row)).collect();
        format!("{} of {}", of.iter().filter(|(_, gap)| told_apart(gap)).count(), of.len())
    };
    let each = if (2..=POLICIES).contains(&policies.len()) {
        let each = policies.iter().map(|policy| format!("{} {}", name(policy), count(&|row| row.policy == *policy)));
        format!(" ({})", each.collect::<Vec<_>>().join(", "))
    } else {
        String::new()
    };
    format!("; {} gaps are told apart from zero{each}", count(&|_| true))
}

fn name(name: &str) -> String {
    shorten(name, limits::STUDY_NAME_CHARS)
}

#[cfg(test)]
mod tests {
    use super::super::tests::{row, study};
    use super::*;

    #[test]
    fn answer_names_the_largest_drop_and_counts_verdicts() {
        let results = study(vec![
            row("plain", "a", &[], 9),
            row("plain", "b", &[], 9),
            row("red", "a", &[], 1),
            row("red", "b", &[], 8),
        ]);
        let given = sentence(&results);
        assert!(given.starts_with("Success falls most for a under “red”, by 80.0 points ["), "{given}");
        assert!(given.ends_with("; 1 of 2 gaps are told apart from zero (a 1 of 1, b 0 of 1)."), "{given}");
    }

    #[test]
    fn answer_of_an_unfinished_study_says_so() {
        let mut results = study(vec![row("plain", "a", &[], 9)]);
        results.cells = 7;
        assert_eq!(sentence(&results), "With 1 of 7 cells done, no condition is compared with another yet.");
        results.rows.clear();
        assert_eq!(sentence(&results), "None of the 7 cells is done.");
        let same = study(vec![row("plain", "a", &[], 9), row("red", "a", &[], 9)]);
        let given = sentence(&same);
        assert_eq!(given, "Success falls under none of the conditions; 0 of 1 gaps are told apart from zero.");
    }
}
