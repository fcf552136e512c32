//! How the values of a column are distributed over a dataset: a histogram of every element, and a map of two of them, which
//! shows what states or actions a dataset covers.

use crate::datasets::MOST_ELEMENTS;
use serde::Serialize;
use swm_core::{Error, Result};
use swm_data::{Reader, StepRange};

/// The largest number of rows that are read: whole episodes, evenly over the dataset.
const MOST_ROWS: usize = 100_000;
/// Bars of a histogram, and cells of a side of the map.
const BINS: usize = 40;

/// The values of a column.
#[derive(Debug, Serialize)]
pub struct Distribution {
    /// The rows that were read.
    pub rows: usize,
    /// All rows of the dataset.
    pub of: usize,
    /// The elements of a value.
    pub elements: Vec<Element>,
    /// The two elements of the map, `[x, y]`; equal for a column of one element.
    pub axes: [usize; 2],
    /// The number of rows in every cell, `[y, x]`, y upwards.
    pub map: Vec<Vec<u32>>,
}

/// The values of an element.
#[derive(Debug, Serialize)]
pub struct Element {
    /// The smallest value; 0 without values.
    pub low: f64,
    /// The largest value; 0 without values.
    pub high: f64,
    /// The mean.
    pub mean: f64,
    /// The number of values in bars of equal width.
    pub bins: Vec<u32>,
    /// Values that are not finite: the action of a last row, and missing ones.
    pub missing: usize,
}

/// Reads the distribution of a column, with a map of the elements `axes`.
///
/// # Errors
/// When there is no such column, it holds images or too many elements, or the dataset is damaged.
pub fn distribution(reader: &dyn Reader, column: &str, axes: [usize; 2]) -> Result<Distribution> {
    let spec = reader.schema().column(column)?;
    let (count, is_image) = (spec.len(), spec.is_image());
    if is_image || count == 0 || count > MOST_ELEMENTS {
        let problem = format!("it has {count} elements, or holds images");
        let fix = format!("choose a column of 1 to {MOST_ELEMENTS} elements");
        return Err(Error::config(format!("column '{column}'"), problem, fix));
    }
    let axes = if count == 1 { [0, 0] } else { axes };
    if axes.iter().any(|&axis| axis >= count) {
        let fix = format!("choose elements below {count}");
        return Err(Error::config(format!("column '{column}'"), format!("there is no element of {axes:?}"), fix));
    }
    let (ranges, of) = sampled(reader);
    let values = reader.read(&[column], &ranges)?.to_f32(column)?;
    let elements: Vec<Element> = (0..count).map(|i| element(values.iter().skip(i).step_by(count))).collect();
    let mut map = vec![vec![0; BINS]; BINS];
    for value in values.chunks_exact(count) {
        let [x, y] = axes.map(|axis| elements[axis].bin(value[axis]));
        if let (Some(x), Some(y)) = (x, y) {
            map[y][x] += 1;
        }
    }
    Ok(Distribution { rows: values.len() / count, of, elements, axes, map })
}

/// Whole episodes, evenly over the dataset, until there are enough rows; and the number of all rows.
fn sampled(reader: &dyn Reader) -> (Vec<StepRange>, usize) {
    let all = reader.episodes();
    let rows: usize = all.iter().map(|episode| episode.length).sum();
    let every = rows.div_ceil(MOST_ROWS).max(1);
    let mut left = MOST_ROWS;
    let chosen = all.iter().enumerate().step_by(every).map_while(|(i, episode)| {
        let length = episode.length.min(left);
        left -= length;
        (length > 0).then(|| StepRange::new(i, 0, length))
    });
    (chosen.collect(), rows)
}

fn element<'a>(values: impl Iterator<Item = &'a f32> + Clone) -> Element {
    let finite = || values.clone().filter(|value| value.is_finite()).map(|&value| f64::from(value));
    let (low, high) = (finite().reduce(f64::min).unwrap_or_default(), finite().reduce(f64::max).unwrap_or_default());
    let count = finite().count();
    let mean = if count > 0 { finite().sum::<f64>() / count as f64 } else { 0.0 };
    let mut element = Element { low, high, mean, bins: vec![0; BINS], missing: values.clone().count() - count };
    for value in values {
        if let Some(bin) = element.bin(*value) {
            element.bins[bin] += 1;
        }
    }
    element
}

impl Element {
    /// The bar of a value; `None` for one that is not finite.
    fn bin(&self, value: f32) -> Option<usize> {
        let width = self.high - self.low;
        let part = if width > 0.0 { (f64::from(value) - self.low) / width } else { 0.0 };
        value.is_finite().then(|| ((part * BINS as f64) as usize).min(BINS - 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_counted_and_missing_ones_are_not() {
        let values = [0.0, 1.0, f32::NAN, 4.0, 4.0];
        let found = element(values.iter());
        assert_eq!((found.low, found.high, found.mean, found.missing), (0.0, 4.0, 2.25, 1));
        assert_eq!((found.bins[0], found.bins[10], found.bins[39], found.bins.iter().sum::<u32>()), (1, 1, 2, 4));
        let none = element([f32::NAN].iter());
        assert_eq!((none.low, none.missing, none.bins.iter().sum::<u32>()), (0.0, 1, 0));
        assert_eq!(element([3.0_f32, 3.0].iter()).bins[0], 2, "equal values are in one bar");
    }
}
