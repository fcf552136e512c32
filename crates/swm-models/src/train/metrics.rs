//! Metrics of training steps and their means between two lines of the log.

/// Named values of one step; the first is the total loss.
pub(crate) type Metrics = Vec<(&'static str, f64)>;

/// Running means of the metrics and the gradient norm since the last line of the log.
#[derive(Default)]
pub(crate) struct MetricWindow {
    metrics: Metrics,
    norm: f64,
    count: usize,
}

impl MetricWindow {
    /// Adds the metrics and the gradient norm of one step.
    pub fn add(&mut self, metrics: &[(&'static str, f64)], norm: f64) {
        if self.count == 0 {
            self.metrics = metrics.iter().map(|&(name, _)| (name, 0.0)).collect();
        }
        for (sum, (_, value)) in self.metrics.iter_mut().zip(metrics) {
            sum.1 += value;
        }
        self.norm += norm;
        self.count += 1;
    }

    /// Returns whether no step was added since the last [`MetricWindow::take`].
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Returns the means of the metrics and of the gradient norm, and clears the window.
    pub fn take(&mut self) -> (Metrics, f64) {
        let Self { metrics, norm, count } = std::mem::take(self);
        let count = count.max(1) as f64;
        (metrics.into_iter().map(|(name, sum)| (name, sum / count)).collect(), norm / count)
    }
}
