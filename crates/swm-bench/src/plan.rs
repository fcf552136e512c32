//! How fast planning is: the sampling and update step of CEM beside the reference's where it is installed, and what a
//! planner takes beside its model.
//!
//! As in [`bench`](mod@crate::envs), turns of ours and of the reference's alternate, and the figure that counts is the
//! median of the ratios of neighbouring turns. The model of both is free: it answers with costs that were drawn before,
//! so that nothing but the planner is measured.

use crate::reference::{Reference, not_compared, reference_python};
use rand::Rng as _;
use serde::Serialize;
use std::fmt;
use std::path::PathBuf;
use std::time::Instant;
use swm_core::pool::threads;
use swm_core::results::Summary;
use swm_core::{Batch, Candidates, CostModel, Error, Key, PlanProblem, PlanSpace, Result, Solver};
use swm_plan::Cem;

/// What to measure.
#[derive(Clone, Debug)]
pub struct PlanBenchConfig {
    /// Environments planned in one call, one row each.
    pub envs: Vec<usize>,
    /// Candidates, iterations, elites.
    pub cem: Cem,
    /// Model steps of a plan.
    pub horizon: usize,
    /// Numbers of a model step.
    pub dim: usize,
    /// Seconds a model takes for the candidates of one environment in one iteration, beside which the planner's own time
    /// is told.
    pub model_seconds: f64,
    /// Worker threads; as many as the machine offers for 0. The reference uses as many as torch chooses.
    pub threads: usize,
    /// Pairs of turns, ours and the reference's.
    pub pairs: usize,
    /// Seconds of a turn.
    pub seconds: f64,
    /// A Python with the reference, if there is one.
    pub python: Option<PathBuf>,
}

impl Default for PlanBenchConfig {
    /// The paper's setting: 300 candidates, 30 iterations, 5 model steps of 5 actions of 2 numbers; for one environment
    /// and for 16. The model takes as long as the fastest LeWM we aim at, on two cores.
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

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct PlanBenchReport {
    /// Candidates an iteration.
    pub samples: usize,
    /// Iterations of a plan.
    pub iterations: usize,
    /// Model steps of a plan.
    pub horizon: usize,
    /// Numbers of a model step.
    pub dim: usize,
    /// Worker threads of ours.
    pub threads: usize,
    /// The reference's version, or why it is not compared.
    pub reference: String,
    /// One entry a number of environments.
    pub rows: Vec<PlanBenchRow>,
}

/// Planning for some environments in one call.
#[derive(Clone, Debug, Serialize)]
pub struct PlanBenchRow {
    /// Environments planned in one call.
    pub envs: usize,
    /// Iterations a second in each of our turns.
    pub ours: Vec<f64>,
    /// Iterations a second in each of the reference's turns; empty without it.
    pub reference: Vec<f64>,
    /// The median of our turns.
    pub iterations_per_second: f64,
    /// The median ratio of neighbouring turns: how many times faster ours is.
    pub ratio: Option<f64>,
    /// The planner's own time as a share of the model's, with a model of [`PlanBenchConfig::model_seconds`].
    pub overhead: f64,
}

/// Measures CEM with a model that costs nothing.
///
/// # Errors
/// When a number makes no sense, or the reference fails after it had started. A reference that does not start is no
/// error: [`PlanBenchReport::reference`] says why.
pub fn bench_plan(config: &PlanBenchConfig) -> Result<PlanBenchReport> {
    let positive = |seconds: f64| seconds > 0.0 && seconds.is_finite();
    if config.pairs == 0 || !positive(config.seconds) || !positive(config.model_seconds) {
        let given = format!(
            "{} pairs of turns of {} seconds, a model that takes {} seconds",
            config.pairs, config.seconds, config.model_seconds
        );
        return Err(Error::config("benchmark", given, "ask for at least 1 pair, and for times above 0"));
    }
    if config.envs.contains(&0) {
        return Err(Error::config("environments to plan for", "0", "ask for at least 1"));
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
        // The first turn of each warms up and is not counted.
        workers.install(|| planning.solve(config.seconds / 4.0))?;
        reference.as_mut().map(|reference| reference.solve(config.seconds / 4.0)).transpose()?;
        let (mut ours, mut theirs) = (vec![], vec![]);
        for _ in 0..config.pairs {
            ours.push(workers.install(|| planning.solve(config.seconds))?);
            if let Some(reference) = &mut reference {
                theirs.push(reference.solve(config.seconds)?);
            }
        }
        let ratios: Vec<f64> = ours.iter().zip(&theirs).map(|(ours, theirs)| ours / theirs).collect();
        let iterations_per_second = Summary::of(&ours).map_or(0.0, |turns| turns.median);
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

/// CEM and a free model.
struct Planning<'a> {
    config: &'a PlanBenchConfig,
    cem: Cem,
    model: Free,
    keys: Vec<Key>,
    low: Vec<f32>,
    high: Vec<f32>,
    /// Plans made so far.
    plans: u64,
}

impl<'a> Planning<'a> {
    fn new(config: &'a PlanBenchConfig, envs: usize) -> Self {
        let mut rng = Key::new(0).with("costs").rng();
        let costs = (0..config.cem.iterations)
            .map(|_| (0..envs * config.cem.samples).map(|_| rng.random()).collect())
            .collect();
        // The reference clips nothing; ours is given bounds, as every environment gives them.
        let (low, high) = (vec![-1.0; config.dim], vec![1.0; config.dim]);
        let keys = (0..envs).map(|env| Key::new(env as u64)).collect();
        Self { config, cem: config.cem.clone(), model: Free { costs, asked: 0 }, keys, low, high, plans: 0 }
    }

    /// Plans for about so long: iterations a second.
    fn solve(&mut self, seconds: f64) -> Result<f64> {
        self.model.asked = 0;
        let begun = Instant::now();
        let elapsed = loop {
            let keys: Vec<Key> = self.keys.iter().map(|key| key.at(self.plans)).collect();
            self.plans += 1;
            let space = PlanSpace::Continuous { low: &self.low, high: &self.high };
            let horizon = self.config.horizon;
            let problem = PlanProblem { horizon, space, keys: &keys, init: None, deadline: None };
            self.cem.solve(&mut self.model, problem)?;
            let elapsed = begun.elapsed().as_secs_f64();
            if elapsed >= seconds {
                break elapsed;
            }
        };
        Ok(self.model.asked as f64 / elapsed)
    }
}

/// A model whose costs are drawn once; asking for them takes no time.
struct Free {
    /// The costs of each iteration.
    costs: Vec<Vec<f32>>,
    asked: usize,
}

impl CostModel for Free {
    fn observe(&mut self, _: &Batch, _: &[usize]) -> Result<()> {
        Ok(())
    }

    fn cost(&mut self, _: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        costs.copy_from_slice(&self.costs[self.asked % self.costs.len()]);
        self.asked += 1;
        Ok(())
    }
}

impl fmt::Display for PlanBenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "CEM, {} candidates x {} iterations x {} steps of {} numbers, {} threads; reference: {}",
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
    fn without_the_reference_it_says_so() {
        let report = bench_plan(&config()).expect("a report");
        assert!(report.reference.contains(REFERENCE_PYTHON));
        assert_eq!(report.rows.iter().map(|row| row.envs).collect::<Vec<_>>(), [1, 3]);
        for row in &report.rows {
            assert_eq!((row.ours.len(), row.reference.len(), row.ratio), (3, 0, None));
            assert!(row.iterations_per_second > 0.0 && row.overhead > 0.0);
        }
        let missing = PlanBenchConfig { python: Some("/no/such/python".into()), ..config() };
        let report = bench_plan(&missing).expect("a report");
        assert!(report.reference.contains("/no/such/python"), "{}", report.reference);
    }

    #[cfg(unix)]
    #[test]
    fn ratios_are_those_of_neighbouring_turns() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().expect("a folder");
        let python = folder.path().join("python");
        // Stands in for Python with the reference: chats, then answers 10 iterations in 2 seconds to everything.
        let script = "#!/bin/sh\necho hello\necho SWM ready 1.2.3\nwhile read line; do echo SWM 10 2.0; done\n";
        std::fs::write(&python, script).expect("a file");
        std::fs::set_permissions(&python, std::fs::Permissions::from_mode(0o755)).expect("executable");
        let report = bench_plan(&PlanBenchConfig { python: Some(python), ..config() }).expect("a report");
        assert_eq!(report.reference, "1.2.3");
        for row in &report.rows {
            assert_eq!(row.reference, [5.0; 3]);
            assert_eq!(row.ratio, Some(row.iterations_per_second / 5.0));
        }
        assert!(report.to_string().contains("x the reference (median of 3)"), "{report}");
    }

    #[test]
    fn a_benchmark_of_nothing_is_refused() {
        assert!(bench_plan(&PlanBenchConfig { pairs: 0, ..config() }).is_err());
        assert!(bench_plan(&PlanBenchConfig { seconds: f64::NAN, ..config() }).is_err());
        assert!(bench_plan(&PlanBenchConfig { model_seconds: 0.0, ..config() }).is_err());
        assert!(bench_plan(&PlanBenchConfig { envs: vec![0], ..config() }).is_err());
    }
}
