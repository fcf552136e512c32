//! `bench plan`: iterations of CEM per second, without the time of a model.
//!
//! The models of this implementation and of the reference return precomputed random costs, so that only sampling and
//! updates are measured.

use crate::reference::{Reference, not_compared, reference_python};
use rand::Rng as _;
use serde::Serialize;
use std::fmt;
use std::path::PathBuf;
use std::time::Instant;
use swm_core::pool::threads;
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{Batch, Candidates, CostModel, Error, Key, PlanProblem, PlanSpace, Result, Solver};
use swm_plan::Cem;

/// Settings of the benchmark.
#[derive(Clone, Debug)]
pub struct PlanBenchConfig {
    /// The numbers of environments that one call plans for; the report has a row for each number.
    pub envs: Vec<usize>,
    /// The settings of CEM (the cross-entropy method): candidates, iterations, elites.
    pub cem: Cem,
    /// The number of model steps of a plan.
    pub horizon: usize,
    /// The dimension of a model step.
    pub dim: usize,
    /// The time in seconds that a model takes for the candidates of one environment in one iteration. The planner's
    /// time is reported relative to this time.
    pub model_seconds: f64,
    /// The number of worker threads; 0 for the number of cores. The reference uses torch's default.
    pub threads: usize,
    /// The number of measurement pairs. A pair is one measurement of this implementation and one of the reference.
    pub pairs: usize,
    /// The duration of a measurement, in seconds.
    pub seconds: f64,
    /// The Python interpreter of the reference implementation, if any.
    pub python: Option<PathBuf>,
}

impl Default for PlanBenchConfig {
    /// The settings of the stable-worldmodel paper: 300 candidates, 30 iterations, 5 model steps of 5 actions of
    /// dimension 2; for 1 and for 16 environments. `model_seconds` is the target for a LeWM on two cores.
    fn default() -> Self {
        Self {
            envs: vec![1, 16],
            cem: Cem::default(),
            horizon: 5,
            dim: 10,
            model_seconds: 0.4,
            threads: 0,
            pairs: 5,
            seconds: 1.0,
            python: reference_python(),
        }
    }
}

/// The result of the benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct PlanBenchReport {
    /// The number of candidates per iteration.
    pub samples: usize,
    /// The number of iterations of a plan.
    pub iterations: usize,
    /// The number of model steps of a plan.
    pub horizon: usize,
    /// The dimension of a model step.
    pub dim: usize,
    /// The number of worker threads of this implementation.
    pub threads: usize,
    /// The version of the reference, or the reason why it is not compared.
    pub reference: String,
    /// One entry for each number of environments.
    pub rows: Vec<PlanBenchRow>,
}

/// The rate of planning for a number of environments in one call.
#[derive(Clone, Debug, Serialize)]
pub struct PlanBenchRow {
    /// The number of environments planned in one call.
    pub envs: usize,
    /// Iterations per second in each measurement of this implementation.
    pub ours: Vec<f64>,
    /// Iterations per second in each measurement of the reference; empty without a reference.
    pub reference: Vec<f64>,
    /// The median of `ours`.
    pub iterations_per_second: f64,
    /// The median over measurement pairs of the rate of this implementation divided by the reference's rate.
    pub ratio: Option<f64>,
    /// The planner's time divided by [`PlanBenchConfig::model_seconds`].
    pub overhead: f64,
}

/// Measures CEM with a model that takes no time.
///
/// # Errors
/// When a setting is invalid, `control` stops the run, or the reference fails after its start. A reference that does not start is not an error:
/// [`PlanBenchReport::reference`] contains the reason.
pub fn bench_plan(config: &PlanBenchConfig, control: &mut Control<'_>) -> Result<PlanBenchReport> {
    let positive = |seconds: f64| seconds > 0.0 && seconds.is_finite();
    if config.pairs == 0 || !positive(config.seconds) || !positive(config.model_seconds) {
        let given = format!(
            "{} pairs of measurements of {} seconds, a model that takes {} seconds",
            config.pairs, config.seconds, config.model_seconds
        );
        return Err(Error::config("benchmark", given, "choose at least 1 pair and times above 0"));
    }
    if config.envs.contains(&0) {
        return Err(Error::config("environments to plan for", "0", "choose at least 1"));
    }
    let workers = threads(config.threads)?;
    let Cem { samples, iterations, elites, .. } = config.cem;
    let (horizon, dim) = (config.horizon, config.dim);
    let mut report = PlanBenchReport {
        samples,
        iterations,
        horizon,
        dim,
        threads: workers.current_num_threads(),
        reference: not_compared(),
        rows: vec![],
    };
    for &envs in &config.envs {
        let mut reference = None;
        if let Some(python) = &config.python {
            match Reference::start_solver(python, [envs, samples, iterations, elites, horizon, dim]) {
                Ok(started) => {
                    report.reference.clone_from(&started.version);
                    reference = Some(started);
                }
                Err(error) => report.reference = format!("not compared: {error}"),
            }
        }
        let mut planning = Planning::new(config, envs);
        // The first measurements of this implementation and of the reference are warm-ups and are not counted.
        workers.install(|| planning.solve(config.seconds / 4.0, control))?;
        reference.as_mut().map(|reference| reference.solve(config.seconds / 4.0)).transpose()?;
        let (mut ours, mut theirs) = (vec![], vec![]);
        for _ in 0..config.pairs {
            ours.push(workers.install(|| planning.solve(config.seconds, control))?);
            if let Some(reference) = &mut reference {
                theirs.push(reference.solve(config.seconds)?);
            }
        }
        let ratios: Vec<f64> = ours.iter().zip(&theirs).map(|(ours, theirs)| ours / theirs).collect();
        let iterations_per_second = Summary::of(&ours).map_or(0.0, |summary| summary.median);
        report.rows.push(PlanBenchRow {
            envs,
            overhead: 1.0 / iterations_per_second / (config.model_seconds * envs as f64),
            iterations_per_second,
            ratio: Summary::of(&ratios).map(|ratios| ratios.median),
            ours,
            reference: theirs,
        });
    }
    Ok(report)
}

/// CEM with a model of precomputed costs.
struct Planning<'a> {
    config: &'a PlanBenchConfig,
    cem: Cem,
    model: PrecomputedCosts,
    keys: Vec<Key>,
    low: Vec<f32>,
    high: Vec<f32>,
    /// The number of plans made so far.
    plans: u64,
}

impl<'a> Planning<'a> {
    fn new(config: &'a PlanBenchConfig, envs: usize) -> Self {
        let mut rng = Key::new(0).with("costs").rng();
        let costs = (0..config.cem.iterations)
            .map(|_| (0..envs * config.cem.samples).map(|_| rng.random()).collect())
            .collect();
        // This implementation clips to bounds, because every environment has bounds; the reference does not clip.
        let (low, high) = (vec![-1.0; config.dim], vec![1.0; config.dim]);
        let keys = (0..envs).map(|env| Key::new(env as u64)).collect();
        Self { config, cem: config.cem.clone(), model: PrecomputedCosts { costs, calls: 0 }, keys, low, high, plans: 0 }
    }

    /// Plans for about `seconds`; returns iterations per second.
    fn solve(&mut self, seconds: f64, control: &mut Control<'_>) -> Result<f64> {
        self.model.calls = 0;
        let begun = Instant::now();
        let elapsed = loop {
            control.check()?;
            let keys: Vec<Key> = self.keys.iter().map(|key| key.at(self.plans)).collect();
            self.plans += 1;
            let space = PlanSpace::Continuous { low: &self.low, high: &self.high };
            let horizon = self.config.horizon;
            let problem = PlanProblem { horizon, space, keys: &keys, init: None, deadline: None, observer: None };
            self.cem.solve(&mut self.model, problem)?;
            let elapsed = begun.elapsed().as_secs_f64();
            if elapsed >= seconds {
                break elapsed;
            }
        };
        Ok(self.model.calls as f64 / elapsed)
    }
}

/// A model with precomputed random costs.
struct PrecomputedCosts {
    /// The costs of each iteration, `[iterations][envs * samples]`.
    costs: Vec<Vec<f32>>,
    calls: usize,
}

impl CostModel for PrecomputedCosts {
    fn observe(&mut self, _: &Batch, _: &[usize]) -> Result<()> {
        Ok(())
    }

    fn cost(&mut self, _: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        costs.copy_from_slice(&self.costs[self.calls % self.costs.len()]);
        self.calls += 1;
        Ok(())
    }
}

impl fmt::Display for PlanBenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "CEM, {} candidates x {} iterations x {} steps of dimension {}, {} threads; reference: {}",
            self.samples, self.iterations, self.horizon, self.dim, self.threads, self.reference
        )?;
        for row in &self.rows {
            write!(f, "{:>3} environments {:>9.0} iterations/s", row.envs, row.iterations_per_second)?;
            write!(f, ", {:.2} % of the model's time", 100.0 * row.overhead)?;
            match row.ratio {
                Some(ratio) => writeln!(f, " {ratio:>8.1} x the reference (median of {})", row.ours.len())?,
                None => writeln!(f)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::REFERENCE_PYTHON;

    fn config() -> PlanBenchConfig {
        PlanBenchConfig {
            envs: vec![1, 3],
            cem: Cem { samples: 8, iterations: 4, elites: 2, ..Cem::default() },
            threads: 1,
            pairs: 3,
            seconds: 0.01,
            python: None,
            ..PlanBenchConfig::default()
        }
    }

    #[test]
    fn report_states_that_the_reference_is_missing() {
        let report = bench_plan(&config(), &mut Control::new()).expect("the benchmark succeeds");
        assert!(report.reference.contains(REFERENCE_PYTHON));
        assert_eq!(report.rows.iter().map(|row| row.envs).collect::<Vec<_>>(), [1, 3]);
        for row in &report.rows {
            assert_eq!((row.ours.len(), row.reference.len(), row.ratio), (3, 0, None));
            assert!(row.iterations_per_second > 0.0 && row.overhead > 0.0);
        }
        let missing = PlanBenchConfig { python: Some("/no/such/python".into()), ..config() };
        let report = bench_plan(&missing, &mut Control::new()).expect("the benchmark succeeds");
        assert!(report.reference.contains("/no/such/python"), "{}", report.reference);
    }

    #[cfg(unix)]
    #[test]
    fn ratio_is_the_median_over_measurement_pairs() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let python = folder.path().join("python");
        // A fake reference: prints other text, then answers every request with 10 iterations in 2 seconds.
        let script = "#!/bin/sh\necho hello\necho SWM ready 1.2.3\nwhile read line; do echo SWM 10 2.0; done\n";
        std::fs::write(&python, script).expect("the file is written");
        std::fs::set_permissions(&python, std::fs::Permissions::from_mode(0o755)).expect("the file is made executable");
        let config = PlanBenchConfig { python: Some(python), ..config() };
        let report = bench_plan(&config, &mut Control::new()).expect("the benchmark succeeds");
        assert_eq!(report.reference, "1.2.3");
        for row in &report.rows {
            assert_eq!(row.reference, [5.0; 3]);
            assert_eq!(row.ratio, Some(row.iterations_per_second / 5.0));
        }
        assert!(report.to_string().contains("x the reference (median of 3)"), "{report}");
    }

    #[test]
    fn invalid_settings_are_errors() {
        for config in [
            PlanBenchConfig { pairs: 0, ..config() },
            PlanBenchConfig { seconds: f64::NAN, ..config() },
            PlanBenchConfig { model_seconds: 0.0, ..config() },
            PlanBenchConfig { envs: vec![0], ..config() },
        ] {
            assert!(bench_plan(&config, &mut Control::new()).is_err());
        }
    }
}
