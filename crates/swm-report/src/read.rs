//! Reading result files and training logs, with errors that say what is wrong with them.

use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::results::{Comparison, Paired};
use swm_core::{Error, Result, Results};

/// What to do about a result file that cannot be used.
const AGAIN: &str = "write it again with this version (`swm eval`), or read it with the version that wrote it";

/// Reads a `results.json`.
///
/// # Errors
/// When the file cannot be read, is no JSON, was written by a version with another layout, lacks a field, or
/// contradicts itself.
pub fn read_results(path: &Path) -> Result<Results> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::io(path, "reading results", source))?;
    let value: Value = serde_json::from_str(&text)
        .map_err(|error| Error::corrupt(path, format!("is no JSON document ({error})"), AGAIN))?;
    let version = value.pointer("/manifest/swm_version").and_then(Value::as_str);
    let ours = env!("CARGO_PKG_VERSION");
    match version {
        None => {
            let problem = "is no result file: it has no manifest.swm_version";
            return Err(Error::corrupt(path, problem, "give a results.json that `swm eval` wrote"));
        }
        Some(theirs) if series(theirs) != series(ours) => {
            let problem = format!("was written by stable-worldmodel {theirs}, this is {ours}");
            return Err(Error::corrupt(path, problem, AGAIN));
        }
        Some(_) => {}
    }
    let results: Results = serde_json::from_value(value).map_err(|error| {
        Error::corrupt(path, format!("has another layout than this version reads ({error})"), AGAIN)
    })?;
    let wrong = |problem: String| Err(Error::corrupt(path, format!("contradicts itself: {problem}"), AGAIN));
    for run in &results.runs {
        let (claimed, shown) = (run.success, results.counting.rate(&run.episodes));
        if (claimed.successes, claimed.n) != (shown.successes, shown.n) {
            return wrong(format!(
                "{} ({}) claims {} successes in {}, its episodes show {} in {}",
                run.policy, run.condition, claimed.successes, claimed.n, shown.successes, shown.n
            ));
        }
    }
    for told in &results.comparisons {
        let find = |name: &str| results.runs.iter().find(|run| run.condition == told.condition && run.policy == name);
        let shown = find(&told.a).zip(find(&told.b)).and_then(|(a, b)| Comparison::of(a, b, results.counting));
        let counts = |told: &Comparison| {
            let Paired { both, only_a, only_b, neither, .. } = told.table;
            [both, only_a, only_b, neither]
        };
        if shown.as_ref().map(counts) != Some(counts(told)) {
            return wrong(format!("its episodes do not show what it says of {} and {}", told.a, told.b));
        }
    }
    Ok(results)
}

/// The part of a version within which layouts stay the same: `major.minor`.
fn series(version: &str) -> Option<&str> {
    version.match_indices('.').nth(1).map(|(end, _)| &version[..end])
}

/// The numbers of a training log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metrics {
    /// What the numbers are plotted over: `step`, `epoch` or `line`.
    pub over: String,
    /// One curve a metric, by name.
    pub series: Vec<Series>,
}

/// One metric of a training log.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Its name; parts of nested objects are joined by `/`.
    pub name: String,
    /// `(step, value)`, in the order of the log.
    pub points: Vec<(f64, f64)>,
}

/// Reads a `train.jsonl`: one JSON object a line, of which every number is a metric. A torn last line, as a
/// killed training leaves, is passed over.
///
/// # Errors
/// When the file cannot be read or another line is no JSON object.
pub fn read_metrics(path: &Path) -> Result<Metrics> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::io(path, "reading metrics", source))?;
    let lines: Vec<&str> = text.lines().collect();
    let mut rows = Vec::with_capacity(lines.len());
    for (i, line) in lines.iter().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        match serde_json::from_str::<Value>(line) {
            Ok(value @ Value::Object(_)) => {
                let mut row = BTreeMap::new();
                flatten("", &value, &mut row);
                rows.push(row);
            }
            _ if i + 1 == lines.len() && !text.ends_with('\n') => {}
            _ => {
                let problem = format!("line {} is no JSON object", i + 1);
                return Err(Error::corrupt(path, problem, "give the train.jsonl that training wrote"));
            }
        }
    }
    let over = ["step", "epoch"].into_iter().find(|key| rows.iter().any(|row| row.contains_key(*key)));
    let mut series: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
    for (line, row) in rows.into_iter().enumerate() {
        #[allow(clippy::cast_precision_loss)]
        let x = match over {
            Some(key) => row.get(key).copied(),
            None => Some(line as f64),
        };
        let Some(x) = x else { continue };
        for (name, value) in row {
            if !["step", "epoch"].contains(&name.as_str()) {
                series.entry(name).or_default().push((x, value));
            }
        }
    }
    let series = series.into_iter().map(|(name, points)| Series { name, points }).collect();
    Ok(Metrics { over: over.unwrap_or("line").to_owned(), series })
}

fn flatten(prefix: &str, value: &Value, into: &mut BTreeMap<String, f64>) {
    match value {
        Value::Object(fields) => {
            for (name, field) in fields {
                let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
                flatten(&path, field, into);
            }
        }
        other => {
            if let Some(number) = other.as_f64() {
                into.insert(prefix.to_owned(), number);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layouts_are_shared_within_a_minor_version() {
        assert_eq!(
            [series("0.1.0"), series("0.1.7-rc.1"), series("1"), series("")],
            [Some("0.1"), Some("0.1"), None, None]
        );
    }
}
