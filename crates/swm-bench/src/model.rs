//! `bench plan`, `bench encode` and `bench train`: the time of a LeWM for planning, evaluating candidates, encoding, and a training
//! step; `bench online`: the training step of SAC and TD-MPC2.
//!
//! The reference runs with the same weights. The reported ratio is the time of this implementation divided by the time
//! of the reference. Deterministic outputs of this implementation and of the reference are compared.

use crate::reference::{Reference, not_compared};
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{Error, Result};

/// A workload of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Work {
    /// A plan: encoding start and goal, then all iterations.
    Plan,
    /// The costs of the candidates of one iteration.
    Cost,
    /// Encoding one frame.
    Encode,
    /// Encoding many frames at once.
    Frames,
    /// One training step, including the optimizer.
    Train,
}

impl Work {
    /// The name in the protocol of the reference's process.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Cost => "cost",
            Self::Encode => "encode",
            Self::Frames => "frames",
            Self::Train => "train",
        }
    }

    /// Whether the outputs of this implementation and of the reference are compared.
    fn is_compared(self) -> bool {
        matches!(self, Self::Cost | Self::Encode)
    }
}

/// A model to measure.
pub trait Subject {
    /// Executes a workload once; returns the outputs of the workload, or an empty list if the outputs are random.
    ///
    /// # Errors
    /// When the model fails.
    fn run(&mut self, work: Work) -> Result<Vec<f32>>;
}

/// Settings of the benchmark.
#[derive(Clone, Debug)]
pub struct ModelBenchConfig {
    /// The name of the model.
    pub model: String,
    /// The workloads, each with the number of repetitions in a measurement.
    pub works: Vec<(Work, usize)>,
    /// The number of measurement pairs. A pair is one measurement of this implementation and one of the reference.
    pub pairs: usize,
    /// The sizes of the model: the first argument of the script `reference/model.py`, or of `reference/online.py`.
    pub sizes: serde_json::Value,
    /// The Python interpreter of the reference implementation, if any.
    pub python: Option<PathBuf>,
}

/// The result of the benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct ModelBenchReport {
    /// The name of the model.
    pub model: String,
    /// The version of the reference, or the reason why it is not compared.
    pub reference: String,
    /// One entry for each workload.
    pub rows: Vec<ModelBenchRow>,
}

/// The measurements of one workload.
#[derive(Clone, Debug, Serialize)]
pub struct ModelBenchRow {
    /// The workload.
    pub work: Work,
    /// Seconds per repetition in each measurement of this implementation.
    pub ours: Vec<f64>,
    /// Seconds per repetition in each measurement of the reference; empty without a reference.
    pub reference: Vec<f64>,
    /// The median of `ours`.
    pub seconds: f64,
    /// The median over measurement pairs of the time of this implementation divided by the reference's time.
    pub share: Option<f64>,
    /// The largest difference between the outputs of this implementation and of the reference, relative to the largest
    /// output of the reference.
    pub difference: Option<f32>,
}

/// Measures a model; `weights` is the file from which the reference reads the weights and the inputs of a LeWM, `None` for a family that is
/// trained online.
///
/// # Errors
/// When there are no measurements, a workload fails, `control` stops the run, or the reference fails after its start. A reference that does not
/// start is not an error: [`ModelBenchReport::reference`] contains the reason.
pub fn bench_model(
    config: &ModelBenchConfig,
    weights: Option<&Path>,
    subject: &mut dyn Subject,
    control: &mut Control<'_>,
) -> Result<ModelBenchReport> {
    if config.pairs == 0 || config.works.iter().any(|(_, count)| *count == 0) {
        return Err(Error::config("measurements of a benchmark", "0", "choose at least 1"));
    }
    let model = config.model.clone();
    let mut report = ModelBenchReport { model, reference: not_compared(), rows: vec![] };
    let mut reference = None;
    if let Some(python) = &config.python {
        let started = match weights {
            Some(weights) => Reference::start_model(python, &config.sizes, weights),
            None => Reference::start_online(python, &config.sizes),
        };
        match started {
            Ok(started) => {
                report.reference.clone_from(&started.version);
                reference = Some(started);
            }
            Err(error) => report.reference = format!("not compared: {error}"),
        }
    }
    for &(work, count) in &config.works {
        control.check()?;
        // The first repetition is a warm-up and is not counted.
        let outputs = subject.run(work)?;
        let difference = match &mut reference {
            Some(reference) if work.is_compared() => Some(difference(&outputs, &reference.outputs(work.name())?)?),
            Some(reference) => {
                reference.run(work.name(), 1)?;
                None
            }
            None => None,
        };
        let (mut ours, mut theirs) = (vec![], vec![]);
        for _ in 0..config.pairs {
            let begun = Instant::now();
            for _ in 0..count {
                control.check()?;
                subject.run(work)?;
            }
            ours.push(begun.elapsed().as_secs_f64() / count as f64);
            if let Some(reference) = &mut reference {
                theirs.push(1.0 / reference.run(work.name(), count)?);
            }
        }
        let shares: Vec<f64> = ours.iter().zip(&theirs).map(|(ours, theirs)| ours / theirs).collect();
        report.rows.push(ModelBenchRow {
            work,
            seconds: Summary::of(&ours).map_or(0.0, |summary| summary.median),
            share: Summary::of(&shares).map(|shares| shares.median),
            difference,
            ours,
            reference: theirs,
        });
    }
    Ok(report)
}

/// The largest difference, relative to the largest output of the reference.
fn difference(ours: &[f32], theirs: &[f32]) -> Result<f32> {
    if ours.len() != theirs.len() {
        let (given, expected) =
            (format!("{} values", ours.len()), format!("{}, the number of values of the reference", theirs.len()));
        return Err(Error::mismatch("comparing with the reference", given, expected));
    }
    let largest = theirs.iter().fold(f32::MIN_POSITIVE, |most, value| value.abs().max(most));
    // `f32::max` would discard NaN.
    let differences = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs());
    Ok(differences.fold(0.0, |most, one| if one > most || one.is_nan() { one } else { most }) / largest)
}

impl fmt::Display for ModelBenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}; reference: {}", self.model, self.reference)?;
        for row in &self.rows {
            write!(f, "{:>6} {:>9.1} ms", row.work.name(), 1e3 * row.seconds)?;
            if let (Some(share), Some(theirs)) = (row.share, Summary::of(&row.reference)) {
                let pairs = row.ours.len();
                write!(f, ", {share:.2} x the reference's {:.1} ms (median of {pairs})", 1e3 * theirs.median)?;
            }
            if let Some(difference) = row.difference {
                write!(f, ", outputs differ by {difference:.1e}")?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::REFERENCE_PYTHON;

    /// A subject with the outputs 1 and 2.
    struct Constant;

    impl Subject for Constant {
        fn run(&mut self, _: Work) -> Result<Vec<f32>> {
            Ok(vec![1.0, 2.0])
        }
    }

    fn config(python: Option<PathBuf>) -> ModelBenchConfig {
        ModelBenchConfig {
            model: "LeWM".to_owned(),
            works: vec![(Work::Cost, 2), (Work::Train, 1)],
            pairs: 3,
            sizes: serde_json::json!({}),
            python,
        }
    }

    #[test]
    fn report_states_that_the_reference_is_missing() {
        let report = bench_model(&config(None), Some(Path::new("none")), &mut Constant, &mut Control::new())
            .expect("the benchmark succeeds");
        assert!(report.to_string().contains(REFERENCE_PYTHON));
        assert_eq!(report.rows.len(), 2);
        assert!(report.rows.iter().all(|row| row.ours.len() == 3 && row.share.is_none() && row.difference.is_none()));
        let no_pairs = ModelBenchConfig { pairs: 0, ..config(None) };
        assert!(bench_model(&no_pairs, Some(Path::new("none")), &mut Constant, &mut Control::new()).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn times_and_outputs_are_compared_with_the_reference() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let python = folder.path().join("python");
        // A fake reference: two repetitions per second, and an output that differs by a fifth of the largest output.
        let script = "#!/bin/sh\necho SWM ready 1.2.3\nwhile read what rest; do\n\
            if [ $what = run ]; then echo SWM 2 1.0; else echo SWM 1.0 2.5; fi; done\n";
        std::fs::write(&python, script).expect("the file is written");
        std::fs::set_permissions(&python, std::fs::Permissions::from_mode(0o755)).expect("the file is made executable");
        let report = bench_model(&config(Some(python)), Some(Path::new("none")), &mut Constant, &mut Control::new())
            .expect("the benchmark succeeds");
        assert_eq!(report.reference, "1.2.3");
        assert_eq!((report.rows[0].difference, report.rows[1].difference), (Some(0.2), None));
        for row in &report.rows {
            assert_eq!(row.reference, [0.5; 3]);
            let shares: Vec<f64> = row.ours.iter().map(|seconds| seconds / 0.5).collect();
            assert_eq!(row.share, Summary::of(&shares).map(|shares| shares.median));
        }
        assert!(report.to_string().contains("outputs differ by 2.0e-1"), "{report}");
    }

    #[test]
    fn nan_output_gives_a_nan_difference() {
        assert!(difference(&[f32::NAN, 1.0], &[1.0, 1.0]).expect("two outputs of equal length").is_nan());
        assert!(difference(&[1.0], &[1.0, 1.0]).is_err());
    }
}
