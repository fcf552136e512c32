//! Column statistics, for normalising.

use crate::dataset::reader::{Reader, StepRange};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// Statistics of a column, for each number of a row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColumnStats {
    /// How many rows had a number there, NaN not counted.
    pub count: Vec<u64>,
    /// The mean.
    pub mean: Vec<f64>,
    /// The standard deviation of the population.
    pub std: Vec<f64>,
    /// The smallest.
    pub min: Vec<f64>,
    /// The largest.
    pub max: Vec<f64>,
}

/// Rows read at once.
const ROWS: usize = 16 << 10;

/// The statistics of a column over some episodes (all of them for `None`), NaN left out: the missing action
/// of a last row does not count. For integer actions that is the caller's business, as -1 is a number.
///
/// # Errors
/// When there is no such column, it holds pictures, an episode does not exist, or the data are damaged.
pub fn column_stats(reader: &dyn Reader, column: &str, episodes: Option<&[usize]>) -> Result<ColumnStats> {
    let n = reader.schema().column(column)?.len();
    // Welford's update, which stays exact for columns far from zero.
    let mut stats = ColumnStats {
        count: vec![0; n],
        mean: vec![0.0; n],
        std: vec![0.0; n],
        min: vec![f64::INFINITY; n],
        max: vec![f64::NEG_INFINITY; n],
    };
    for_each_row(reader, column, episodes, |row| {
        for (k, &value) in row.iter().enumerate().filter(|(_, value)| !value.is_nan()) {
            stats.count[k] += 1;
            let delta = value - stats.mean[k];
            #[allow(clippy::cast_precision_loss)]
            let count = stats.count[k] as f64;
            stats.mean[k] += delta / count;
            stats.std[k] += delta * (value - stats.mean[k]);
            stats.min[k] = stats.min[k].min(value);
            stats.max[k] = stats.max[k].max(value);
        }
    })?;
    for k in 0..n {
        #[allow(clippy::cast_precision_loss)]
        let count = stats.count[k] as f64;
        if count == 0.0 {
            return Err(Error::mismatch("column statistics", format!("no number in '{column}'"), "at least one row"));
        }
        stats.std[k] = (stats.std[k] / count).sqrt();
    }
    Ok(stats)
}

/// Calls `each` with every row of a column of numbers, over some episodes (all of them for `None`).
fn for_each_row(
    reader: &dyn Reader,
    column: &str,
    episodes: Option<&[usize]>,
    mut each: impl FnMut(&[f64]),
) -> Result<()> {
    if reader.schema().column(column)?.is_image() {
        return Err(Error::mismatch("column statistics", format!("'{column}', which holds pictures"), "numbers"));
    }
    let all: Vec<usize>;
    let positions = match episodes {
        Some(positions) => positions,
        None => {
            all = (0..reader.episodes().len()).collect();
            &all
        }
    };
    let mut pending: Vec<StepRange> = vec![];
    let mut rows = 0;
    for (i, &position) in positions.iter().enumerate() {
        let Some(episode) = reader.episodes().get(position) else {
            let known = format!("positions below {}", reader.episodes().len());
            return Err(Error::mismatch("choosing episodes", format!("position {position}"), known));
        };
        pending.push(StepRange::new(position, 0, episode.length));
        rows += episode.length;
        if rows >= ROWS || i + 1 == positions.len() {
            let batch = reader.read(&[column], &pending)?;
            for row in 0..batch.rows() {
                each(&batch.row(row).to_f64(column)?);
            }
            pending.clear();
            rows = 0;
        }
    }
    Ok(())
}

/// Quantiles of a column, for each number of a row, over some episodes (all of them for `None`), NaN left out: bounds that
/// a few outliers do not move, such as those at 0.01 and 0.99 that the reference scales percentiles to -1 .. 1 by. Between
/// two values of the column a quantile is interpolated linearly. The result has one list of numbers a share.
///
/// Holds the column in memory.
///
/// # Errors
/// As [`column_stats`], and when a share is not within 0 ..= 1.
pub fn column_quantiles(
    reader: &dyn Reader,
    column: &str,
    episodes: Option<&[usize]>,
    shares: &[f64],
) -> Result<Vec<Vec<f64>>> {
    if let Some(share) = shares.iter().find(|share| !(0.0..=1.0).contains(*share)) {
        return Err(Error::OutOfSpace {
            what: "quantile".to_owned(),
            given: share.to_string(),
            expected: "a number in 0 ..= 1".to_owned(),
        });
    }
    let mut values: Vec<Vec<f64>> = vec![];
    for_each_row(reader, column, episodes, |row| {
        values.resize(row.len(), vec![]);
        values.iter_mut().zip(row).filter(|(_, value)| !value.is_nan()).for_each(|(values, &value)| values.push(value));
    })?;
    if values.is_empty() || values.iter().any(Vec::is_empty) {
        return Err(Error::mismatch("column quantiles", format!("no number in '{column}'"), "at least one row"));
    }
    values.iter_mut().for_each(|values| values.sort_by(f64::total_cmp));
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let quantile = |values: &Vec<f64>, share: f64| {
        let place = share * (values.len() - 1) as f64;
        let (below, above) = (values[place.floor() as usize], values[place.ceil() as usize]);
        below + (above - below) * place.fract()
    };
    Ok(shares.iter().map(|&share| values.iter().map(|values| quantile(values, share)).collect()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Constants, ReplayBuffer};
    use swm_core::{Batch, ColumnSpec, DType, Schema};

    #[test]
    fn quantiles_lie_between_the_values() {
        let schema = Schema::new([ColumnSpec::new("state", DType::Float32, [2])]).expect("schema");
        let buffer = ReplayBuffer::new(&schema, 1000).expect("a buffer");
        let mut episode = Batch::zeros(&schema, 6);
        // Numbers in no order, one of them missing.
        let values = [[4.0, 0.5], [1.0, f32::NAN], [3.0, 0.1], [0.0, 0.4], [2.0, 0.2], [5.0, 0.3]];
        episode.get_mut::<f32>("state").expect("states").copy_from_slice(values.as_flattened());
        buffer.add(&episode, &Constants::new()).expect("adds");
        let reader = buffer.snapshot();
        let found = column_quantiles(&*reader, "state", None, &[0.0, 0.01, 0.5, 1.0]).expect("quantiles");
        let expected = [[0.0, 0.1], [0.05, 0.104], [2.5, 0.3], [5.0, 0.5]];
        for (found, expected) in found.iter().flatten().zip(expected.as_flattened()) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
        assert!(
            column_quantiles(&*reader, "state", None, &[1.5]).expect_err("no share").to_string().contains("0 ..= 1")
        );
        assert!(column_quantiles(&*reader, "state", Some(&[3]), &[0.5]).is_err(), "no such episode");
    }
}
