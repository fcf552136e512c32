//! [`verify`]: compares the behaviour of a capsule's model with the behaviour that the capsule records.

use super::{EvaluationRecord, MODEL, RecordedEpisode, computes_alike, cpu_level};
use crate::resolver::HomeResolver;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::rc::Rc;
use swm_core::run::Control;
use swm_core::{Batch, EnvSpec, Origin, Result};
use swm_eval::RunOptions;
use swm_models::capsule::{Capsule, Evaluation, reference};
use swm_models::{Device, FAMILIES, LoadedModel, StoredCheckpoint, load_stored};

/// The result of verifying a capsule.
#[derive(Clone, Debug, Serialize)]
pub struct Verification {
    /// The hash of the capsule.
    pub hash: String,
    /// The hash of the weights.
    pub weights: String,
    /// The processor that packed the capsule.
    pub packed_on: String,
    /// This processor.
    pub verified_on: String,
    /// The largest error of the reference outputs, relative to the largest element of each output.
    pub difference: f64,
    /// The number of episodes that were played again.
    pub episodes: usize,
    /// Differences that another processor explains.
    pub remarks: Vec<String>,
    /// Differences that nothing explains.
    pub faults: Vec<String>,
}

/// Computes the reference outputs of a capsule again and plays its episodes again. Names in the capsule are chosen by the
/// file, unless the user trusts it.
///
/// # Errors
/// When the capsule is damaged, or names an environment or wrapper that cannot be made or that a file may not choose.
pub fn verify(path: &Path, trust: bool, options: &RunOptions, control: &mut Control<'_>) -> Result<Verification> {
    let capsule = Capsule::read(path)?;
    let stored = StoredCheckpoint::of(path, &capsule);
    let model: Rc<dyn LoadedModel> = Rc::from(load_stored(FAMILIES.rows, &stored, &Device::flex())?);
    let origin = Origin::file(path, trust);
    let spec =
        || -> Result<EnvSpec> { Ok(crate::env(capsule.env().unwrap_or_default(), &origin)?.env()?.spec().clone()) };
    let found = reference::outputs(&*model, &capsule.reference.inputs, spec)?;
    let difference = reference::difference(&capsule.reference.outputs, &found)?;
    let mut verification = Verification {
        hash: capsule.hash()?,
        weights: capsule.weights_hash().to_owned(),
        packed_on: capsule.description.cpu_level.clone(),
        verified_on: cpu_level(),
        difference,
        episodes: 0,
        remarks: vec![],
        faults: vec![],
    };
    if difference > reference::TOLERANCE {
        let most = reference::TOLERANCE;
        let fault =
            format!("the reference outputs differ by {difference:.1e} of their largest element, more than {most:.0e}");
        verification.faults.push(fault);
    }
    if let Some(evaluation) = &capsule.evaluation {
        let resolver = HomeResolver::new(origin).with_checkpoint(MODEL, model);
        verification.replay(evaluation, &capsule.manifest.hashes, &resolver, options, control)?;
    }
    Ok(verification)
}

impl Verification {
    /// Plays the episodes of an evaluation again. `hashes` are those of the capsule's manifest.
    fn replay(
        &mut self,
        evaluation: &Evaluation,
        hashes: &BTreeMap<String, String>,
        resolver: &HomeResolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<()> {
        let record = EvaluationRecord::read(evaluation)?;
        if !["weights", "packed"].iter().any(|name| hashes.get(*name) == Some(&record.weights)) {
            self.faults.push("its evaluation is that of other weights".to_owned());
        }
        self.faults.extend(contradictions(&record));
        let (numbers, starts) = record.numbers();
        let recorded = EvaluationRecord::recorded(evaluation, &numbers, &starts);
        let replay = record.request.replay(recorded, resolver, options, control)?;
        self.episodes = numbers.len();
        let differing = differing_columns(&evaluation.starts, &replay.starts);
        if !differing.is_empty() {
            self.report(format!("the episodes start with other values of {}", differing.join(", ")));
        }
        for (expected, result) in record.episodes.iter().zip(&replay.run.episodes) {
            let found = RecordedEpisode::of(expected.number, result);
            if found != *expected {
                let (number, was, is) = (found.number, expected.outcome(), found.outcome());
                self.report(format!("episode {number} was recorded as {was}, and is {is}"));
            }
        }
        Ok(())
    }

    /// Adds a difference: a fault on a processor that computes the same bits, a remark on another one.
    fn report(&mut self, difference: String) {
        match computes_alike(&self.packed_on, &self.verified_on) {
            true => self.faults.push(difference),
            false => {
                self.remarks.push(format!("{difference} (packed on {}, this is {})", self.packed_on, self.verified_on))
            }
        }
    }
}

/// Returns what the recorded episodes contradict in the success rate of an evaluation. Outcomes under other counting, and those of
/// weights that were rounded later, may differ.
fn contradictions(record: &EvaluationRecord) -> Vec<String> {
    let mut found = vec![];
    let numbers: BTreeSet<usize> = record.episodes.iter().map(|episode| episode.number).collect();
    if numbers.len() < record.episodes.len() {
        found.push("it records an episode twice".to_owned());
    }
    let [successes, n] = record.success;
    let count = |success: bool| {
        let counted = |episode: &&RecordedEpisode| !episode.solved_at_start && episode.success == success;
        record.episodes.iter().filter(counted).count()
    };
    let (solved, failed) = (count(true), count(false));
    if solved > successes || failed > n - successes {
        found.push(format!(
            "its evaluation states {successes} of {n} episodes solved, and its recorded episodes are {solved} solved and {failed} not"
        ));
    }
    found
}

/// Returns the names of the columns in which two batches differ.
fn differing_columns(recorded: &Batch, found: &Batch) -> Vec<String> {
    let columns = found.schema().columns().iter().enumerate();
    let equal = |index: usize, name: &str| {
        recorded.schema().find(name).is_some_and(|at| {
            let same = recorded.schema().columns()[at] == found.schema().columns()[index];
            same && recorded.bytes(at) == found.bytes(index)
        })
    };
    columns.filter(|(index, column)| !equal(*index, &column.name)).map(|(_, column)| column.name.clone()).collect()
}
