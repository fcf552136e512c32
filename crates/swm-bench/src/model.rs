//! How fast a LeWM is, beside the reference's with the same weights: a plan, the costs of one iteration, encoding a picture,
//! a training step.
//!
//! As in [`bench`](mod@crate::envs), turns of ours and of the reference's alternate, and the figure that counts is the
//! median of the ratios of neighbouring turns; here it is the share of the reference's time that ours takes. Where both
//! come to numbers, those are compared.

use crate::reference::{Reference, not_compared};
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::results::Summary;
use swm_core::{Error, Result};

/// Something a model does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Work {
    /// A whole plan: start and goal are encoded, then all iterations.
    Plan,
    /// The costs of the candidates of one iteration.
    Cost,
    /// One picture to its latent.
    Encode,
    /// One step of training with its optimizer.
    Train,
}

impl Work {
    /// What the reference's process calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Cost => "cost",
            Self::Encode => "encode",
            Self::Train => "train",
        }
    }

    /// Whether both sides come to the same numbers.
    fn is_compared(self) -> bool {
        matches!(self, Self::Cost | Self::Encode)
    }
}

/// A model of ours that is measured.
pub trait Subject {
    /// Does a work once; returns the numbers it comes to, or none where they depend on draws.
    ///
    /// # Errors
    /// When the model fails.
    fn run(&mut self, work: Work) -> Result<Vec<f32>>;
}

/// What to measure.
#[derive(Clone, Debug)]
pub struct ModelBenchConfig {
    /// Works and how often each is done in a turn.
    pub works: Vec<(Work, usize)>,
    /// Pairs of turns, ours and the reference's.
    pub pairs: usize,
    /// The sizes of the model as the reference's process reads them.
    pub sizes: serde_json::Value,
    /// A Python with the reference, if there is one.
    pub python: Option<PathBuf>,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct ModelBenchReport {
    /// The reference's version, or why it is not compared.
    pub reference: String,
    /// One entry a work.
    pub rows: Vec<ModelBenchRow>,
}

/// One work.
#[derive(Clone, Debug, Serialize)]
pub struct ModelBenchRow {
    /// Which.
    pub work: Work,
    /// Seconds in each of our turns, for the work done once.
    pub ours: Vec<f64>,
    /// The same of the reference's turns; empty without it.
    pub reference: Vec<f64>,
    /// The median of our turns.
    pub seconds: f64,
    /// The median share of neighbouring turns: what ours takes of the reference's time.
    pub share: Option<f64>,
    /// The largest difference of the numbers both come to, relative to the largest of them.
    pub difference: Option<f32>,
}

/// Measures a model; `weights` is a file with its weights and inputs, which the reference's process reads.
///
/// # Errors
/// When there is no turn, a work fails, or the reference fails after it had started. A reference that does not start is no
/// error: [`ModelBenchReport::reference`] says why.
pub fn bench_model(config: &ModelBenchConfig, weights: &Path, subject: &mut dyn Subject) -> Result<ModelBenchReport> {
    if config.pairs == 0 || config.works.iter().any(|(_, count)| *count == 0) {
        return Err(Error::config("turns of a benchmark", "0", "ask for at least 1"));
    }
    let mut report = ModelBenchReport { reference: not_compared(), rows: vec![] };
    let mut reference = None;
    if let Some(python) = &config.python {
        match Reference::start_model(python, &config.sizes, weights) {
            Ok(started) => {
                report.reference.clone_from(&started.version);
                reference = Some(started);
            }
            Err(error) => report.reference = format!("not compared: {error}"),
        }
    }
    for &(work, count) in &config.works {
        // The first time warms up and is not counted; where numbers come out, they are compared.
        let numbers = subject.run(work)?;
        let difference = match &mut reference {
            Some(reference) if work.is_compared() => Some(difference(&numbers, &reference.numbers(work.name())?)?),
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
            seconds: Summary::of(&ours).map_or(0.0, |turns| turns.median),
            share: Summary::of(&shares).map(|shares| shares.median),
            difference,
            ours,
            reference: theirs,
        });
    }
    Ok(report)
}

/// The largest difference, relative to the largest number.
fn difference(ours: &[f32], theirs: &[f32]) -> Result<f32> {
    if ours.len() != theirs.len() {
        let (given, expected) = (format!("{} numbers", ours.len()), format!("the reference's {}", theirs.len()));
        return Err(Error::mismatch("comparing with the reference", given, expected));
    }
    let largest = theirs.iter().fold(f32::MIN_POSITIVE, |most, number| number.abs().max(most));
    // `max` would pass over a number that is none.
    let apart = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs());
    Ok(apart.fold(0.0, |most, apart| if apart > most || apart.is_nan() { apart } else { most }) / largest)
}

impl fmt::Display for ModelBenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "LeWM; reference: {}", self.reference)?;
        for row in &self.rows {
            write!(f, "{:>6} {:>9.1} ms", row.work.name(), 1e3 * row.seconds)?;
            if let (Some(share), Some(theirs)) = (row.share, Summary::of(&row.reference)) {
                let turns = row.ours.len();
                write!(f, ", {share:.2} x the reference's {:.1} ms (median of {turns})", 1e3 * theirs.median)?;
            }
            if let Some(difference) = row.difference {
                write!(f, ", numbers differ by {difference:.1e}")?;
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

    /// Comes to 1 and 2.
    struct Constant;

    impl Subject for Constant {
        fn run(&mut self, _: Work) -> Result<Vec<f32>> {
            Ok(vec![1.0, 2.0])
        }
    }

    fn config(python: Option<PathBuf>) -> ModelBenchConfig {
        ModelBenchConfig {
            works: vec![(Work::Cost, 2), (Work::Train, 1)],
            pairs: 3,
            sizes: serde_json::json!({}),
            python,
        }
    }

    #[test]
    fn without_the_reference_it_says_so() {
        let report = bench_model(&config(None), Path::new("none"), &mut Constant).expect("a report");
        assert!(report.to_string().contains(REFERENCE_PYTHON));
        assert_eq!(report.rows.len(), 2);
        assert!(report.rows.iter().all(|row| row.ours.len() == 3 && row.share.is_none() && row.difference.is_none()));
        let nothing = ModelBenchConfig { pairs: 0, ..config(None) };
        assert!(bench_model(&nothing, Path::new("none"), &mut Constant).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn times_and_numbers_are_compared() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().expect("a folder");
        let python = folder.path().join("python");
        // Stands in for Python with the reference: two works in a second, and numbers of which one is off by a tenth of
        // the largest.
        let script = "#!/bin/sh\necho SWM ready 1.2.3\nwhile read what rest; do\n\
            if [ $what = run ]; then echo SWM 2 1.0; else echo SWM 1.0 2.5; fi; done\n";
        std::fs::write(&python, script).expect("a file");
        std::fs::set_permissions(&python, std::fs::Permissions::from_mode(0o755)).expect("executable");
        let report = bench_model(&config(Some(python)), Path::new("none"), &mut Constant).expect("a report");
        assert_eq!(report.reference, "1.2.3");
        assert_eq!((report.rows[0].difference, report.rows[1].difference), (Some(0.2), None));
        for row in &report.rows {
            assert_eq!(row.reference, [0.5; 3]);
            let shares: Vec<f64> = row.ours.iter().map(|seconds| seconds / 0.5).collect();
            assert_eq!(row.share, Summary::of(&shares).map(|shares| shares.median));
        }
        assert!(report.to_string().contains("numbers differ by 2.0e-1"), "{report}");
    }

    #[test]
    fn what_is_no_number_is_a_difference() {
        assert!(difference(&[f32::NAN, 1.0], &[1.0, 1.0]).expect("two").is_nan());
        assert!(difference(&[1.0], &[1.0, 1.0]).is_err());
    }
}
