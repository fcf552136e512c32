//! Column statistics, for normalisation.

use crate::dataset::reader::{Reader, StepRange};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// Statistics of a column, per element of a row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColumnStats {
    /// Number of rows whose value of this element is not NaN.
    pub count: Vec<u64>,
    /// Number of rows before the last of their episode that have a NaN in any element: one number for the column.
    #[serde(default)]
    pub incomplete: u64,
    /// Mean.
    pub mean: Vec<f64>,
    /// Population standard deviation.
    pub std: Vec<f64>,
    /// Minimum.
    pub min: Vec<f64>,
    /// Maximum.
    pub max: Vec<f64>,
}

/// Number of rows after which a read starts.
const ROWS_PER_READ: usize = 16 << 10;

/// Computes the statistics of a column over some episodes (all for `None`). NaN, such as the missing action of a last
/// row, is ignored; -1, the missing action of an integer column, is counted as a value.
///
/// # Errors
/// If the column does not exist or holds images, an episode does not exist, or the data is damaged.
pub fn column_stats(reader: &dyn Reader, column: &str, episodes: Option<&[usize]>) -> Result<ColumnStats> {
    let n = reader.schema().column(column)?.len();
    // Welford's algorithm, which stays accurate if the mean is much larger than the standard deviation.
    let mut stats = ColumnStats {
        count: vec![0; n],
        incomplete: 0,
        mean: vec![0.0; n],
        std: vec![0.0; n],
        min: vec![f64::INFINITY; n],
        max: vec![f64::NEG_INFINITY; n],
    };
    for_each_row(reader, column, episodes, |row, is_last| {
        stats.incomplete += u64::from(!is_last && row.iter().any(|value| value.is_nan()));
        for (k, &value) in row.iter().enumerate().filter(|(_, value)| !value.is_nan()) {
            stats.count[k] += 1;
            let delta = value - stats.mean[k];
            let count = stats.count[k] as f64;
            stats.mean[k] += delta / count;
            stats.std[k] += delta * (value - stats.mean[k]);
            stats.min[k] = stats.min[k].min(value);
            stats.max[k] = stats.max[k].max(value);
        }
    })?;
    for k in 0..n {
        let count = stats.count[k] as f64;
        if count == 0.0 {
            return Err(Error::mismatch("column statistics", format!("no value in '{column}'"), "at least one row"));
        }
        stats.std[k] = (stats.std[k] / count).sqrt();
    }
    Ok(stats)
}

/// Calls `each` with every row of a column, and whether it is the last of its episode, over some episodes (all for `None`).
fn for_each_row(
    reader: &dyn Reader,
    column: &str,
    episodes: Option<&[usize]>,
    mut each: impl FnMut(&[f64], bool),
) -> Result<()> {
    if reader.schema().column(column)?.is_image() {
        return Err(Error::mismatch(
            "column statistics",
            format!("'{column}', which holds images"),
            "a column of numeric values",
        ));
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
            let expected = format!("positions below {}", reader.episodes().len());
            return Err(Error::mismatch("choosing episodes", format!("position {position}"), expected));
        };
        pending.push(StepRange::new(position, 0, episode.length));
        rows += episode.length;
        if rows >= ROWS_PER_READ || i + 1 == positions.len() {
            let batch = reader.read(&[column], &pending)?;
            if batch.rows() != rows {
                let given = format!("{} rows of '{column}'", batch.rows());
                return Err(Error::mismatch("reading a dataset", given, format!("{rows} rows")));
            }
            let is_last = pending.iter().flat_map(|range| (1..=range.length).map(|step| step == range.length));
            for (row, is_last) in is_last.enumerate() {
                each(&batch.row(row).to_f64(column)?, is_last);
            }
            pending.clear();
            rows = 0;
        }
    }
    Ok(())
}

/// Quantiles of a column, per element of a row, over some episodes (all for `None`), ignoring NaN. Quantiles between
/// two values are interpolated linearly. Unlike minimum and maximum, quantiles are robust to outliers: the reference
/// implementation scales the range between the 0.01 and 0.99 quantiles to `[-1, 1]`.
///
/// The whole column is held in memory. `quantiles` are fractions in `0 ..= 1`.
///
/// # Shapes
/// The result is `[quantiles, elements of a row]`.
///
/// # Errors
/// As [`column_stats`], and if a quantile is not within `0 ..= 1`.
pub fn column_quantiles(
    reader: &dyn Reader,
    column: &str,
    episodes: Option<&[usize]>,
    quantiles: &[f64],
) -> Result<Vec<Vec<f64>>> {
    if let Some(quantile) = quantiles.iter().find(|quantile| !(0.0..=1.0).contains(*quantile)) {
        return Err(Error::OutOfSpace {
            what: "quantile".to_owned(),
            given: quantile.to_string(),
            expected: "a value in 0 ..= 1".to_owned(),
        });
    }
    let mut values: Vec<Vec<f64>> = vec![];
    for_each_row(reader, column, episodes, |row, _| {
        values.resize(row.len(), vec![]);
        values.iter_mut().zip(row).filter(|(_, value)| !value.is_nan()).for_each(|(values, &value)| values.push(value));
    })?;
    if values.is_empty() || values.iter().any(Vec::is_empty) {
        return Err(Error::mismatch("column quantiles", format!("no value in '{column}'"), "at least one row"));
    }
    values.iter_mut().for_each(|values| values.sort_by(f64::total_cmp));
    let interpolate = |values: &Vec<f64>, quantile: f64| {
        let position = quantile * (values.len() - 1) as f64;
        let (below, above) = (values[position.floor() as usize], values[position.ceil() as usize]);
        below + (above - below) * position.fract()
    };
    Ok(quantiles.iter().map(|&quantile| values.iter().map(|values| interpolate(values, quantile)).collect()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Constants, ReplayBuffer};
    use swm_core::{Batch, ColumnSpec, DType, Schema};

    #[test]
    fn quantiles_interpolate_and_ignore_missing_values() {
        let schema = Schema::new([ColumnSpec::new("state", DType::Float32, [2])]).expect("creating the schema");
        let buffer = ReplayBuffer::new(&schema, 1000).expect("creating the replay buffer");
        let mut episode = Batch::zeros(&schema, 6);
        // The values are unsorted, and one value is missing (NaN).
        let values = [[4.0, 0.5], [1.0, f32::NAN], [3.0, 0.1], [0.0, 0.4], [2.0, 0.2], [5.0, 0.3]];
        episode.get_mut::<f32>("state").expect("accessing the states").copy_from_slice(values.as_flattened());
        buffer.add(&episode, &Constants::new()).expect("adding an episode");
        let reader = buffer.snapshot();
        let found = column_quantiles(&*reader, "state", None, &[0.0, 0.01, 0.5, 1.0]).expect("computing the quantiles");
        let expected = [[0.0, 0.1], [0.05, 0.104], [2.5, 0.3], [5.0, 0.5]];
        for (found, expected) in found.iter().flatten().zip(expected.as_flattened()) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
        assert!(
            column_quantiles(&*reader, "state", None, &[1.5])
                .expect_err("a quantile above 1")
                .to_string()
                .contains("0 ..= 1")
        );
        assert!(column_quantiles(&*reader, "state", Some(&[3]), &[0.5]).is_err(), "episode 3 does not exist");
    }
}
