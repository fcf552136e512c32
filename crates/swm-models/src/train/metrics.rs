//! Metrics of training steps and their means between two lines of the log.

use serde::{Deserialize, Deserializer, Serialize};

/// Named values of one step; the first is the total loss.
pub(crate) type Metrics = Vec<(&'static str, f64)>;

/// Running means of the metrics and the gradient norm since the last line of the log. They are stored with the progress of a
/// run, so that the next line of a continued run has the means of an uninterrupted one.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct MetricWindow {
    /// The names of the metrics, known since the last step that this process added.
    #[serde(skip)]
    names: Vec<&'static str>,
    /// The sums of the metrics, then that of the gradient norm.
    #[serde(deserialize_with = "null_is_nan")]
    sums: Vec<f64>,
    count: usize,
}

impl MetricWindow {
    /// Adds the metrics and the gradient norm of one step.
    pub fn add(&mut self, metrics: &[(&'static str, f64)], norm: f64) {
        // Another version of the program may have stored other metrics, which have no means with these.
        if self.sums.len() != metrics.len() + 1 {
            *self = Self { sums: vec![0.0; metrics.len() + 1], ..Self::default() };
        }
        self.names.clear();
        self.names.extend(metrics.iter().map(|&(name, _)| name));
        for (sum, value) in self.sums.iter_mut().zip(metrics.iter().map(|&(_, value)| value).chain([norm])) {
            *sum += value;
        }
        self.count = self.count.saturating_add(1);
    }

    /// Returns whether no step was added since the last [`MetricWindow::take`].
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Returns the means of the metrics and of the gradient norm, and clears the window.
    pub fn take(&mut self) -> (Metrics, f64) {
        let Self { names, sums, count } = std::mem::take(self);
        let mut means = sums.into_iter().map(|sum| sum / count.max(1) as f64);
        let metrics = names.into_iter().zip(&mut means).collect();
        (metrics, means.next().unwrap_or_default())
    }
}

/// Reads values, which JSON stores as null if they are not finite.
pub(crate) fn null_is_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
    let values = Vec::<Option<f64>>::deserialize(deserializer)?;
    Ok(values.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_window_continues_with_equal_means() {
        let steps =
            [[("loss", 0.1), ("rate", f64::NAN)], [("loss", 0.7), ("rate", 0.25)], [("loss", 0.3), ("rate", 0.5)]];
        let (mut uninterrupted, mut stored) = (MetricWindow::default(), MetricWindow::default());
        for (index, step) in steps.iter().enumerate() {
            let norm = 0.1 * index as f64;
            uninterrupted.add(step, norm);
            stored.add(step, norm);
            let text = serde_json::to_string(&stored).expect("JSON");
            stored = serde_json::from_str(&text).expect("a window");
        }
        stored.names.extend(["loss", "rate"]);
        assert_eq!(format!("{:?}", stored.take()), format!("{:?}", uninterrupted.take()));
        assert!(stored.is_empty());
    }

    #[test]
    fn window_of_other_metrics_begins_again() {
        let mut window: MetricWindow =
            serde_json::from_str("{\"sums\": [9, 9, 9, 9], \"count\": 3}").expect("a window");
        window.add(&[("loss", 0.5)], 2.0);
        assert_eq!(window.take(), (vec![("loss", 0.5)], 2.0));
    }
}
