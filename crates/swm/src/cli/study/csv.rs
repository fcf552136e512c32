//! The tables of a study as comma-separated values.

use swm_core::results::{ByDisplacement, Discrimination, Proportion, StudyResults, StudyRow, Summary};
use swm_core::text::printable;

/// The columns of every study, after those of its variables.
const COLUMNS: [&str; 16] = [
    "successes",
    "n",
    "rate",
    "low",
    "high",
    "solved_at_start",
    "floor",
    "gap",
    "gap_low",
    "gap_high",
    "p",
    "p_holm",
    "design_effect",
    "comparisons",
    "verdict",
    "trained_on_starts",
];

/// The columns of a study with prediction errors.
const ERROR_COLUMNS: [&str; 14] = [
    "error_solved",
    "error_failed",
    "auc",
    "auc_low",
    "auc_high",
    "auc_design_effect",
    "overlap",
    "error",
    "auc_played",
    "auc_played_low",
    "auc_played_high",
    "optimism",
    "optimism_low",
    "optimism_high",
];

/// A row for each cell.
pub(super) fn cells(results: &StudyResults) -> String {
    let mut variables: Vec<&str> =
        results.rows.iter().flat_map(|row| row.variables.keys().map(String::as_str)).collect();
    variables.sort_unstable();
    variables.dedup();
    let has_displacements = results.rows.iter().any(|row| !row.by_displacement.is_empty());
    let has_images = results.rows.iter().any(|row| row.image_distance.is_some());
    let has_errors = results.rows.iter().any(|row| row.prediction.is_some());
    let mut header: Vec<String> =
        ["cell", "starts", "condition", "policy", "counting", "seed"].map(str::to_owned).to_vec();
    header.extend(variables.iter().map(|name| format!("variable.{name}")));
    header.extend(COLUMNS.map(str::to_owned));
    header.extend(has_images.then(|| "image_distance".to_owned()));
    header.extend(results.until.iter().flat_map(|_| ["e", "until"].map(str::to_owned)));
    header.extend(has_errors.then_some(ERROR_COLUMNS.map(str::to_owned)).into_iter().flatten());
    header.extend(has_displacements.then(displacement_columns).into_iter().flatten());
    let row = |row: &StudyRow| {
        let mut cells = vec![row.cell.clone(), row.starts.clone(), row.condition.clone(), row.policy.clone()];
        cells.extend([row.counting.name().to_owned(), row.seed.to_string()]);
        cells.extend(variables.iter().map(|name| row.variables.get(*name).cloned().unwrap_or_default()));
        cells.extend(of_success(row));
        if has_images {
            cells.push(row.image_distance.map_or(String::new(), |distance| distance.to_string()));
        }
        if let Some(until) = results.until {
            let e = row.gap.and_then(|gap| gap.e).map(|e| e.to_string());
            cells.extend([e.unwrap_or_default(), until.to_string()]);
        }
        cells.extend(has_errors.then(|| of_errors(row)).into_iter().flatten());
        cells.extend(has_displacements.then(|| of_displacements(row)).into_iter().flatten());
        cells
    };
    std::iter::once(header).chain(results.rows.iter().map(row)).map(|cells| line(&cells)).collect()
}

/// The values of [`COLUMNS`].
fn of_success(row: &StudyRow) -> Vec<String> {
    let success = &row.success;
    // Of no episodes there is no rate.
    let of = |p: &Proportion, share: f64| if p.n == 0 { String::new() } else { share.to_string() };
    let mut cells = vec![success.successes.to_string(), success.n.to_string()];
    cells.extend([success.rate, success.low, success.high].map(|share| of(success, share)));
    cells.extend([row.solved_at_start.to_string(), of(&row.floor, row.floor.rate)]);
    cells.extend(row.gap.as_ref().map_or(Default::default(), |gap| {
        let numbers = [gap.difference, gap.low, gap.high, gap.p, gap.p_holm, gap.design_effect];
        let [difference, low, high, p, p_holm, effect] = numbers.map(|value| value.to_string());
        [difference, low, high, p, p_holm, effect, gap.comparisons.to_string(), gap.verdict.to_string()]
    }));
    cells.push(row.trained_on_starts.map_or(String::new(), |trained| trained.to_string()));
    cells
}

/// The columns of a study with displacements: those of each group, the nearest goals first.
fn displacement_columns() -> Vec<String> {
    let columns = [
        "from",
        "to",
        "solved",
        "failed",
        "auc",
        "auc_low",
        "auc_high",
        "auc_played",
        "auc_played_low",
        "auc_played_high",
    ];
    let group = |group: usize| columns.map(|column| format!("displacement_{group}_{column}"));
    (1..=ByDisplacement::GROUPS).flat_map(group).collect()
}

/// The values of [`displacement_columns`].
fn of_displacements(row: &StudyRow) -> Vec<String> {
    let of = |group: usize| {
        let Some(found) = row.by_displacement.get(group) else { return vec![String::new(); 10] };
        let area = |found: Option<Discrimination>| {
            found
                .map_or([const { String::new() }; 3], |found| [found.auc, found.low, found.high].map(|x| x.to_string()))
        };
        let counts = [found.from.to_string(), found.to.to_string(), found.solved.to_string(), found.failed.to_string()];
        counts.into_iter().chain(area(found.recorded)).chain(area(found.played)).collect()
    };
    (0..ByDisplacement::GROUPS).flat_map(of).collect()
}

/// The values of [`ERROR_COLUMNS`]: errors are medians.
fn of_errors(row: &StudyRow) -> Vec<String> {
    let text = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let (errors, played) = (row.prediction.as_ref(), row.played.as_ref());
    let median = |errors: &[f64]| Some(Summary::of(errors)?.median);
    let medians = [errors.and_then(|errors| median(&errors.solved)), errors.and_then(|errors| median(&errors.failed))];
    let found = errors.and_then(|errors| errors.discrimination);
    let area = |of: fn(&Discrimination) -> f64| found.as_ref().map(of);
    let areas =
        [area(|found| found.auc), area(|found| found.low), area(|found| found.high), area(|found| found.design_effect)];
    let mut cells: Vec<String> = medians.into_iter().chain(areas).map(text).collect();
    cells.push(text(found.and_then(|found| found.overlap)));
    cells.push(found.map_or(String::new(), |found| found.verdict.to_string()));
    let of_played = played.and_then(|played| played.errors.discrimination);
    let optimism = played.and_then(|played| played.optimism);
    cells.extend(of_played.map_or([None; 3], |auc| [auc.auc, auc.low, auc.high].map(Some)).map(text));
    cells.extend(optimism.map_or([None; 3], |all| [all.mean, all.low, all.high].map(Some)).map(text));
    cells
}

/// The rows over training seeds: each has its seeds and their rates, separated by semicolons. The condition is empty for all
/// shifted conditions together.
pub(super) fn seeds(results: &StudyResults) -> String {
    let header = [
        "starts",
        "condition",
        "policy",
        "counting",
        "seed",
        "training_seeds",
        "rates",
        "mean",
        "new_seed_low",
        "new_seed_high",
        "iqm",
        "iqm_low",
        "iqm_high",
    ];
    let mut text = header.join(",") + "\n";
    for row in &results.over_seeds {
        let list = |of: &dyn Fn(&(String, f64)) -> String| row.scores.iter().map(of).collect::<Vec<_>>().join(";");
        let mut cells = vec![row.starts.clone(), row.condition.clone().unwrap_or_default(), row.policy.clone()];
        cells.extend([row.counting.name().to_owned(), row.seed.to_string()]);
        cells.extend([list(&|(seed, _)| seed.clone()), list(&|(_, rate)| rate.to_string()), row.mean.to_string()]);
        cells.extend(row.new_seed.map(|rate| rate.to_string()));
        let iqm = row.interquartile.map(|iqm| [iqm.mean, iqm.low, iqm.high].map(|rate| rate.to_string()));
        cells.extend(iqm.unwrap_or_default());
        text += &line(&cells);
    }
    text
}

/// A line of quoted cells.
pub(super) fn line(cells: &[String]) -> String {
    cells.iter().map(|cell| quote(cell)).collect::<Vec<_>>().join(",") + "\n"
}

/// Quotes a cell of CSV.
fn quote(text: &str) -> String {
    // A spreadsheet would run a name that begins like a formula.
    let start = text.trim_start_matches(|c: char| c.is_whitespace() || c.is_control());
    let is_formula = start.starts_with(['=', '+', '-', '@']) && text.parse::<f64>().is_err();
    let text = format!("{}{}", if is_formula { "'" } else { "" }, printable(text));
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text }
}

#[cfg(test)]
mod tests {
    use super::quote;

    #[test]
    fn texts_that_a_spreadsheet_would_run_are_quoted() {
        for text in ["=1+1", "@x", "\t=1+1", "\n-a"] {
            assert!(quote(text).trim_start_matches('"').starts_with('\''), "{text:?}: {}", quote(text));
        }
        for text in ["-1.5", "+2", "a=b", " a"] {
            assert_eq!(quote(text), text);
        }
    }
}
