//! `meta/stats.json`: minimum, maximum, mean and standard deviation of every feature, which LeRobot's policies use for
//! normalisation. Statistics of new episodes are merged with the stored statistics. Quantiles are not written.

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
    min: f64,
    max: f64,
    mean: f64,
    /// Sum of squared deviations from the mean.
    spread: f64,
}

const EMPTY: Dim = Dim { min: f64::INFINITY, max: f64::NEG_INFINITY, mean: 0.0, spread: 0.0 };

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
        for (i, value) in values.enumerate() {
            let (dim, sum) = (&mut added[i % dim_count], &mut sums[i % dim_count]);
            dim.min = dim.min.min(value);
            dim.max = dim.max.max(value);
            // Welford's algorithm.
            sum.0 += 1.0;
            let delta = value - sum.1;
            sum.1 += delta / sum.0;
            sum.2 += delta * (value - sum.1);
        }
        for (dim, (n, mean, spread)) in added.iter_mut().zip(&sums) {
            dim.mean = *mean;
            // Scaled to one value per row, because images have many values per channel and row.
            dim.spread = if *n > 0.0 { spread / n * rows as f64 } else { 0.0 };
        }
        self.merge(&added, rows as f64);
    }

    fn merge(&mut self, other: &[Dim], count: f64) {
        let total = self.count + count;
        if total == 0.0 {
            return;
        }
        for (dim, other) in self.dims.iter_mut().zip(other) {
            let difference = other.mean - dim.mean;
            dim.min = dim.min.min(other.min);
            dim.max = dim.max.max(other.max);
            dim.spread += other.spread + difference * difference * self.count * count / total;
            dim.mean += difference * count / total;
        }
        self.count = total;
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
            "mean": list(&|dim| dim.mean),
            "std": list(&|dim| (dim.spread / self.count.max(1.0)).sqrt()),
            "count": [self.count],
        })
    }

    /// Merges stored statistics. Returns `None` if the number of elements differs.
    pub fn continue_from(&mut self, stored: &Value) -> Option<()> {
        let scale = if self.camera { 255.0 } else { 1.0 };
        let list = |name: &str| -> Option<Vec<f64>> {
            let values = stored[name].as_array()?.iter();
            values.map(|v| Some(if self.camera { v[0][0].as_f64()? } else { v.as_f64()? } * scale)).collect()
        };
        let count = stored["count"][0].as_f64()?;
        let (min, max, mean, std) = (list("min")?, list("max")?, list("mean")?, list("std")?);
        if [&min, &max, &mean, &std].iter().any(|list| list.len() != self.dims.len()) {
            return None;
        }
        let dims = (0..min.len())
            .map(|i| Dim { min: min[i], max: max[i], mean: mean[i], spread: std[i] * std[i] * count })
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
}
