//! Reads training logs.

use crate::limits;
use serde_json::Value;
use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;
use swm_core::{Error, Result, files};

/// The fix for an unusable training log.
const FIX: &str = "give the train.jsonl that training wrote";

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

/// The training log of a policy.
#[derive(Clone, Debug)]
pub struct Training {
    /// The name of the policy; empty for one that is not named.
    pub policy: String,
    /// The metrics, or why there are none.
    pub metrics: Result<Metrics, String>,
}

/// Reads a `train.jsonl`: one JSON object per line, of which every number is a metric. An incomplete last line, left by an
/// interrupted training, is ignored.
///
/// # Errors
/// When the file cannot be read, is not a regular file or is larger than a report reads, another line is not a JSON
/// object, or the log has more metrics or longer names than a training writes.
pub fn read_metrics(path: &Path) -> Result<Metrics> {
    let io = |error| Error::io(path, "reading the training log", error);
    let file = files::open(path)?;
    if file.metadata().map_err(io)?.len() > limits::LOG_BYTES {
        let problem = format!("is larger than {}", limits::mebibytes(limits::LOG_BYTES));
        return Err(Error::corrupt(path, problem, "report without the training curves"));
    }
    let mut reader = BufReader::new(file.take(limits::LOG_BYTES));
    let (mut columns, mut rows, mut line) = (Columns::default(), 0, vec![]);
    for number in 1.. {
        line.clear();
        if reader.read_until(b'\n', &mut line).map_err(io)? == 0 {
            break;
        }
        if line.iter().all(u8::is_ascii_whitespace) {
            continue;
        }
        match serde_json::from_slice::<Value>(&line) {
            Ok(value @ Value::Object(_)) => {
                flatten("", &value, &mut |name, value| columns.push(name, rows, value))
                    .map_err(|problem| Error::corrupt(path, format!("line {number} {problem}"), FIX))?;
                rows += 1;
            }
            _ if line.last() != Some(&b'\n') => {}
            _ => return Err(Error::corrupt(path, format!("line {number} is not a JSON object"), FIX)),
        }
    }
    Ok(columns.metrics())
}

/// The values of every metric with the index of their row.
#[derive(Default)]
struct Columns(BTreeMap<String, Vec<(usize, f64)>>);

impl Columns {
    fn push(&mut self, name: &str, row: usize, value: f64) -> Result<(), String> {
        if let Some(points) = self.0.get_mut(name) {
            points.push((row, value));
        } else if self.0.len() == limits::METRICS {
            return Err(format!("has another metric after {}", limits::METRICS));
        } else {
            self.0.insert(name.to_owned(), vec![(row, value)]);
        }
        Ok(())
    }

    /// The curves over the step, or over the epoch or the line of a log without steps.
    fn metrics(mut self) -> Metrics {
        let [step, epoch] = ["step", "epoch"].map(|key| self.0.remove(key));
        let (over, x) = match (step, epoch) {
            (Some(step), _) => ("step", Some(step)),
            (None, Some(epoch)) => ("epoch", Some(epoch)),
            (None, None) => ("line", None),
        };
        let x: Option<BTreeMap<usize, f64>> = x.map(|points| points.into_iter().collect());
        let at = |row: usize| x.as_ref().map_or(Some(row as f64), |x| x.get(&row).copied());
        let series = self.0.into_iter().map(|(name, points)| {
            let points = points.into_iter().filter_map(|(row, value)| Some((at(row)?, value))).collect();
            Series { name, points }
        });
        // A metric that no row with a step contains is left out.
        let series = series.filter(|series| !series.points.is_empty()).collect();
        Metrics { over: over.to_owned(), series }
    }
}

/// Passes every number of a row to `push`, with its path.
fn flatten(prefix: &str, value: &Value, push: &mut impl FnMut(&str, f64) -> Result<(), String>) -> Result<(), String> {
    let Value::Object(fields) = value else { return value.as_f64().map_or(Ok(()), |number| push(prefix, number)) };
    fields.iter().try_for_each(|(name, field)| {
        let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
        if path.len() > limits::METRIC_NAME_BYTES {
            return Err(format!("has a metric with a name of more than {} bytes", limits::METRIC_NAME_BYTES));
        }
        flatten(&path, field, push)
    })
}
