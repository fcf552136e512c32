//! Reads and checks result files and training logs.

use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::results::{Comparison, Paired};
use swm_core::{Error, Result, Results};

/// The fix for an unusable results file.
const FIX: &str = "write it again with this version (`swm eval`), or read it with the version that wrote it";

/// Reads a `results.json`.
///
/// # Errors
/// When the file cannot be read, is not JSON, was written by a version with another layout, lacks a field, or is
/// inconsistent.
pub fn read_results(path: &Path) -> Result<Results> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::io(path, "reading results", source))?;
    let value: Value = serde_json::from_str(&text)
        .map_err(|error| Error::corrupt(path, format!("is not a JSON document ({error})"), FIX))?;
    let version = value.pointer("/manifest/swm_version").and_then(Value::as_str);
    let ours = env!("CARGO_PKG_VERSION");
    match version {
        None => {
            let problem = "is not a results file: it has no manifest.swm_version";
            return Err(Error::corrupt(path, problem, "give a results.json that `swm eval` wrote"));
        }
        Some(theirs) if series(theirs) != series(ours) => {
            let problem = format!("was written by stable-worldmodel {theirs}; this version is {ours}");
            return Err(Error::corrupt(path, problem, FIX));
        }
        Some(_) => {}
    }
    let results: Results = serde_json::from_value(value).map_err(|error| {
        Error::corrupt(path, format!("has a layout that this version does not read ({error})"), FIX)
    })?;
    let wrong = |problem: String| Err(Error::corrupt(path, format!("is inconsistent: {problem}"), FIX));
    for run in &results.runs {
        let (stated, actual) = (run.success, results.counting.rate(&run.episodes));
        if (stated.successes, stated.n) != (actual.successes, actual.n) {
            return wrong(format!(
                "{} ({}) states {} successes in {}, its episodes have {} in {}",
                run.policy, run.condition, stated.successes, stated.n, actual.successes, actual.n
            ));
        }
    }
    for stated in &results.comparisons {
        let find = |name: &str| results.runs.iter().find(|run| run.condition == stated.condition && run.policy == name);
        let actual = find(&stated.a).zip(find(&stated.b)).and_then(|(a, b)| Comparison::of(a, b, results.counting));
        let counts = |comparison: &Comparison| {
            let Paired { both, only_a, only_b, neither, .. } = comparison.table;
            [both, only_a, only_b, neither]
        };
        if actual.as_ref().map(counts) != Some(counts(stated)) {
            return wrong(format!("the comparison of {} and {} does not match the episodes", stated.a, stated.b));
        }
    }
    Ok(results)
}

/// The part of a version that determines the layout: `major.minor`.
fn series(version: &str) -> Option<&str> {
    version.match_indices('.').nth(1).map(|(end, _)| &version[..end])
}

/// The metrics of a training log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metrics {
    /// The quantity on the horizontal axis: `step`, `epoch` or `line`.
    pub over: String,
    /// One curve for each metric, by name.
    pub series: Vec<Series>,
}

/// One metric of a training log.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// The name; parts of nested objects are joined by `/`.
    pub name: String,
    /// `(step, value)`, in the order of the log.
    pub points: Vec<(f64, f64)>,
}

/// Reads a `train.jsonl`: one JSON object per line. Every number in an object is a metric. An incomplete last line,
/// left by an interrupted training, is ignored.
///
/// # Errors
/// When the file cannot be read or a complete line is not a JSON object.
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
                let problem = format!("line {} is not a JSON object", i + 1);
                return Err(Error::corrupt(path, problem, "give the train.jsonl that training wrote"));
            }
        }
    }
    let over = ["step", "epoch"].into_iter().find(|key| rows.iter().any(|row| row.contains_key(*key)));
    let mut series: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
    for (line, row) in rows.into_iter().enumerate() {
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
    fn layout_depends_on_major_and_minor_version() {
        assert_eq!(
            [series("0.1.0"), series("0.1.7-rc.1"), series("1"), series("")],
            [Some("0.1"), Some("0.1"), None, None]
        );
    }
}
