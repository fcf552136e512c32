//! `meta/stats.json`: minimum, maximum, mean and standard deviation of every feature, which LeRobot's policies use for
//! normalisation. Statistics of new episodes are merged with the stored statistics. Quantiles are not written.
//!
//! Values that are not finite are left out, because JSON has none. An element without finite values has `null`s.

use serde_json::{Value, json};
use swm_core::{ColumnSpec, Result};

/// Statistics of one feature.
#[derive(Clone, Debug)]
pub struct Stats {
    /// Number of rows or frames.
    count: f64,
    /// Statistics of each element of a row, or of each colour channel.
    dims: Vec<Dim>,
    camera: bool,
}

/// Statistics of one element of a row, or of one colour channel.
#[derive(Clone, Copy, Debug)]
struct Dim {
    /// Number of finite values, scaled to one value per row.
    count: f64,
    min: f64,
    max: f64,
    mean: f64,
    /// Sum of squared deviations from the mean.
    spread: f64,
}

const EMPTY: Dim = Dim { count: 0.0, min: f64::INFINITY, max: f64::NEG_INFINITY, mean: 0.0, spread: 0.0 };

impl Stats {
    pub fn new(column: &ColumnSpec) -> Self {
        let camera = column.is_image();
        Self { count: 0.0, dims: vec![EMPTY; if camera { 3 } else { column.len() }], camera }
    }

    /// Adds values, row-major `[rows, elements]`; for a camera, pixels `[rows, height, width, 3]`.
    pub fn add(&mut self, values: impl Iterator<Item = f64> + Clone, rows: usize) {
        let dim_count = self.dims.len();
        let mut added = vec![EMPTY; dim_count];
        let mut sums = vec![(0.0, 0.0, 0.0); dim_count];
        let mut missing = vec![0.0; dim_count];
        for (i, value) in values.enumerate() {
            let (dim, sum) = (&mut added[i % dim_count], &mut sums[i % dim_count]);
            if !value.is_finite() {
                missing[i % dim_count] += 1.0;
                continue;
            }
            dim.min = dim.min.min(value);
            dim.max = dim.max.max(value);
            // Welford's algorithm.
            sum.0 += 1.0;
            let delta = value - sum.1;
            sum.1 += delta / sum.0;
            sum.2 += delta * (value - sum.1);
        }
        for ((dim, (n, mean, spread)), missing) in added.iter_mut().zip(&sums).zip(&missing) {
            if *n > 0.0 {
                // Scaled to one value per row, because images have many values per channel and row.
                dim.count = n / (n + missing) * rows as f64;
                dim.mean = *mean;
                dim.spread = spread / n * dim.count;
            }
        }
        self.merge(&added, rows as f64);
    }

    fn merge(&mut self, other: &[Dim], count: f64) {
        for (dim, other) in self.dims.iter_mut().zip(other) {
            let total = dim.count + other.count;
            dim.min = dim.min.min(other.min);
            dim.max = dim.max.max(other.max);
            if total > 0.0 {
                let difference = other.mean - dim.mean;
                dim.spread += other.spread + difference * difference * dim.count * other.count / total;
                dim.mean += difference * other.count / total;
                dim.count = total;
            }
        }
        self.count += count;
    }

    /// The JSON object that LeRobot stores. Statistics of images are in `[0, 1]`, with shape `[3, 1, 1]`.
    pub fn to_json(&self) -> Value {
        let scale = if self.camera { 255.0 } else { 1.0 };
        let list = |value: &dyn Fn(&Dim) -> f64| -> Value {
            let values = self.dims.iter().map(|dim| value(dim) / scale);
            if self.camera { values.map(|v| json!([[v]])).collect() } else { values.map(|v| json!(v)).collect() }
        };
        json!({
            "min": list(&|dim| dim.min),
            "max": list(&|dim| dim.max),
            "mean": list(&|dim| if dim.count > 0.0 { dim.mean } else { f64::NAN }),
            "std": list(&|dim| if dim.count > 0.0 { (dim.spread / dim.count).sqrt() } else { f64::NAN }),
            "count": [self.count],
        })
    }

    /// Merges stored statistics. Returns `None` if the number of elements differs.
    ///
    /// Stored is the number of rows, not that of the finite values of each element. An element with a stored mean counts
    /// as finite in all of these rows, and another one as finite in none.
    pub fn continue_from(&mut self, stored: &Value) -> Option<()> {
        let number = |v: &Value| if v.is_null() { Some(f64::NAN) } else { v.as_f64() };
        let list = |name: &str| -> Option<Vec<f64>> {
            let values = stored[name].as_array()?.iter();
            values.map(|v| if self.camera { Some(v[0][0].as_f64()? * 255.0) } else { number(v) }).collect()
        };
        let count = stored["count"][0].as_f64()?;
        let (min, max, mean, std) = (list("min")?, list("max")?, list("mean")?, list("std")?);
        if [&min, &max, &mean, &std].iter().any(|list| list.len() != self.dims.len()) {
            return None;
        }
        let dims = (0..min.len())
            .map(|i| {
                // The minimum of a number and NaN is the number.
                let bounds = Dim { min: EMPTY.min.min(min[i]), max: EMPTY.max.max(max[i]), ..EMPTY };
                let is_known = mean[i].is_finite() && std[i].is_finite();
                if is_known { Dim { count, mean: mean[i], spread: std[i] * std[i] * count, ..bounds } } else { bounds }
            })
            .collect::<Vec<_>>();
        self.merge(&dims, count);
        Some(())
    }
}

/// The content of `meta/stats.json`.
///
/// # Errors
/// If serialising the statistics fails.
pub fn file<'a>(features: impl Iterator<Item = (&'a str, &'a Stats)>) -> Result<Vec<u8>> {
    let all: serde_json::Map<String, Value> =
        features.map(|(name, stats)| (name.to_owned(), stats.to_json())).collect();
    serde_json::to_vec_pretty(&all).map_err(|e| swm_core::Error::external("describing the dataset", e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::DType;

    #[test]
    fn merged_statistics_equal_statistics_of_all_rows() {
        let column = ColumnSpec::new("state", DType::Float64, [2]);
        let values: Vec<f64> = (0..40).map(|i| f64::from(i * i % 17) + if i % 2 == 0 { 100.0 } else { -3.0 }).collect();
        let mut all_rows = Stats::new(&column);
        all_rows.add(values.iter().copied(), 20);
        let mut first = Stats::new(&column);
        first.add(values[..14].iter().copied(), 7);
        let mut second = Stats::new(&column);
        second.continue_from(&first.to_json()).expect("merging the stored statistics");
        second.add(values[14..].iter().copied(), 13);
        let (a, b) = (all_rows.to_json(), second.to_json());
        for name in ["min", "max", "mean", "std", "count"] {
            for i in 0..a[name].as_array().expect("a JSON array").len() {
                let (a, b) = (a[name][i].as_f64().expect("a JSON number"), b[name][i].as_f64().expect("a JSON number"));
                assert!((a - b).abs() < 1e-9, "{name}: {a} {b}");
            }
        }
        let even: Vec<f64> = values.iter().step_by(2).copied().collect();
        let mean = even.iter().sum::<f64>() / 20.0;
        assert!((a["mean"][0].as_f64().expect("a JSON number") - mean).abs() < 1e-9);
        assert!(Stats::new(&ColumnSpec::image("pixels", 4, 4)).continue_from(&a).is_none());
    }

    #[test]
    fn values_that_are_not_finite_are_left_out() {
        let column = ColumnSpec::new("state", DType::Float64, [3]);
        let (nan, infinity) = (f64::NAN, f64::INFINITY);
        // Of the columns, the first is finite in all rows, the second in two, and the third in none.
        let values = [1.0, nan, nan, 1.0, 4.0, infinity, 7.0, 8.0, nan, 7.0, -infinity, nan];
        let mut stats = Stats::new(&column);
        stats.add(values.iter().copied(), 4);
        let text = file([("state", &stats)].into_iter()).expect("writing statistics");
        let stored: Value = serde_json::from_slice(&text).expect("reading statistics");
        let expected = json!({
            "min": [1.0, 4.0, null], "max": [7.0, 8.0, null], "mean": [4.0, 6.0, null], "std": [3.0, 2.0, null],
            "count": [4.0],
        });
        assert_eq!(stored["state"], expected);
        let mut continued = Stats::new(&column);
        continued.continue_from(&stored["state"]).expect("merging the stored statistics");
        continued.add([4.0, 6.0, 3.0, 4.0, 6.0, 5.0].into_iter(), 2);
        let all = continued.to_json();
        assert_eq!(all["min"], json!([1.0, 4.0, 3.0]));
        assert_eq!(all["max"], json!([7.0, 8.0, 5.0]));
        assert_eq!(all["mean"], json!([4.0, 6.0, 4.0]));
        assert_eq!(all["std"][2], json!(1.0));
        assert_eq!(all["count"], json!([6.0]));
        // What was written before: the extremes of finite values, and no mean.
        let old = json!({"min": [0.0], "max": [9.0], "mean": [null], "std": [null], "count": [3.0]});
        let mut continued = Stats::new(&ColumnSpec::new("state", DType::Float64, [1]));
        continued.continue_from(&old).expect("merging statistics without a mean");
        continued.add([5.0].into_iter(), 1);
        let expected = json!({"min": [0.0], "max": [9.0], "mean": [5.0], "std": [0.0], "count": [4.0]});
        assert_eq!(continued.to_json(), expected);
    }
}
