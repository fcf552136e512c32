//! The training logs whose curves a page of results shows.

use crate::home;
use std::path::{Path, PathBuf};
use swm_core::Results;
use swm_eval::{EvalRequest, PolicyRequest};
use swm_models::StoredCheckpoint;
use swm_report::{Training, read_metrics};

/// Returns the path of a checkpoint's training log.
pub fn log_of(checkpoint: &Path) -> PathBuf {
    checkpoint.join("train.jsonl")
}

/// Reads the training log of a policy in the run folder of its checkpoint.
pub fn of_checkpoint(policy: &str, checkpoint: &Path) -> Training {
    let metrics = read_metrics(&log_of(checkpoint)).map_err(|error| error.to_string());
    Training { policy: policy.to_owned(), metrics }
}

/// Finds the training logs of the policies in results: those beside checkpoints whose weights have the hash that the
/// results state. A capsule, and a checkpoint that is not on this machine, has none: results may be those of a stranger, and
/// open no connection.
pub fn of_results(results: &[(PathBuf, Results)]) -> Vec<Training> {
    let mut found: Vec<(String, PathBuf)> = vec![];
    for (_, results) in results {
        let Ok(request) = EvalRequest::of(&results.manifest) else { continue };
        for policy in &request.policies {
            let given = checkpoint_of(policy).filter(|given| !given.contains("://"));
            let run = given.and_then(|given| home::find_checkpoint(given).ok());
            let Some(run) = run.filter(|run| log_of(run).is_file() && has_weights(run, policy, results)) else {
                continue;
            };
            let named = (policy.name.clone(), run);
            if !found.contains(&named) {
                found.push(named);
            }
        }
    }
    found.into_iter().map(|(policy, run)| of_checkpoint(&policy, &run)).collect()
}

/// The checkpoint of a policy, as the request names it.
fn checkpoint_of(policy: &PolicyRequest) -> Option<&str> {
    policy.kind.checkpoint()
}

/// Whether the checkpoint has the weights that were evaluated: it may have been trained again.
fn has_weights(run: &Path, policy: &PolicyRequest, results: &Results) -> bool {
    let hashes = &results.manifest.hashes;
    // Results of one policy do not name it beside the hash.
    let stated = hashes.get(&format!("weights of {}", policy.name)).or_else(|| hashes.get("weights"));
    let stored = StoredCheckpoint::read(run).ok();
    let stored = stored.as_ref().and_then(|stored| stored.manifest().hashes.get("weights"));
    stated.is_some() && stated == stored
}
