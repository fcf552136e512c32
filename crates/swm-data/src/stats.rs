//! Column statistics, for normalising, and the split of episodes into training and validation.

use crate::format::{Reader, StepRange};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};

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
    let spec = reader.schema().column(column)?;
    if spec.is_image() {
        return Err(Error::mismatch("column statistics", format!("'{column}', which holds pictures"), "numbers"));
    }
    let n = spec.len();
    let all: Vec<usize>;
    let positions = match episodes {
        Some(positions) => positions,
        None => {
            all = (0..reader.episodes().len()).collect();
            &all
        }
    };
    // Welford's update, which stays exact for columns far from zero.
    let mut stats = ColumnStats {
        count: vec![0; n],
        mean: vec![0.0; n],
        std: vec![0.0; n],
        min: vec![f64::INFINITY; n],
        max: vec![f64::NEG_INFINITY; n],
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
                for (k, &value) in
                    batch.row(row).to_f64(column)?.iter().enumerate().filter(|(_, value)| !value.is_nan())
                {
                    stats.count[k] += 1;
                    let delta = value - stats.mean[k];
                    #[allow(clippy::cast_precision_loss)]
                    let count = stats.count[k] as f64;
                    stats.mean[k] += delta / count;
                    stats.std[k] += delta * (value - stats.mean[k]);
                    stats.min[k] = stats.min[k].min(value);
                    stats.max[k] = stats.max[k].max(value);
                }
            }
            pending.clear();
            rows = 0;
        }
    }
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

/// Splits the positions of `episodes` episodes into training and validation, `fraction` of them (at least one
/// if it is above 0 and there are two episodes) for validation. Both halves come sorted.
///
/// # Errors
/// When the fraction is not within 0 ..= 1.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn split(episodes: usize, fraction: f64, seed: u64) -> Result<(Vec<usize>, Vec<usize>)> {
    if !(0.0..=1.0).contains(&fraction) {
        return Err(Error::OutOfSpace {
            what: "validation fraction".to_owned(),
            given: fraction.to_string(),
            expected: "a number in 0 ..= 1".to_owned(),
        });
    }
    let mut held = (episodes as f64 * fraction).round() as usize;
    if fraction > 0.0 && held == 0 && episodes > 1 {
        held = 1;
    }
    let mut order: Vec<usize> = (0..episodes).collect();
    crate::loader::shuffle(&mut order, Key::new(seed).with("split"));
    let mut validation: Vec<usize> = order.drain(..held).collect();
    order.sort_unstable();
    validation.sort_unstable();
    Ok((order, validation))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_split_is_a_partition_that_the_seed_decides() {
        let (train, validation) = split(50, 0.1, 3).expect("splits");
        assert_eq!((train.len(), validation.len()), (45, 5));
        let mut all = [train.clone(), validation.clone()].concat();
        all.sort_unstable();
        assert_eq!(all, (0..50).collect::<Vec<_>>());
        assert_eq!(split(50, 0.1, 3).expect("splits"), (train, validation.clone()));
        assert_ne!(split(50, 0.1, 4).expect("splits").1, validation);
        assert_eq!(split(2, 0.01, 0).expect("splits").1.len(), 1);
        assert_eq!(split(1, 0.1, 0).expect("splits").1.len(), 0);
        assert!(split(9, 1.5, 0).expect_err("too much").to_string().contains("0 ..= 1"));
    }
}
