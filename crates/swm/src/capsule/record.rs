//! [`EvaluationRecord`]: an evaluation of the model in a capsule, and the outcomes of some of its episodes.

use super::MODEL;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::results::{Counting, EpisodeResult, Proportion, Run};
use swm_core::{Error, Result, Results, limits};
use swm_eval::{EvalRequest, Model, PolicyKind, PolicyRequest, Recorded, StartsRequest};
use swm_models::capsule::Evaluation;

/// The number of recorded episodes that are chosen from the results of an evaluation.
const EPISODES: usize = 3;
/// The most recorded episodes of a capsule.
const MAX_EPISODES: usize = 16;
/// The largest budget of a recorded episode, in steps.
const MAX_BUDGET: usize = 10_000;
/// The most model steps of a plan. The paper's plans have 45,000.
const MAX_PLAN: usize = 10_000_000;

/// An evaluation of the model in a capsule.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct EvaluationRecord {
    /// The request, with one policy and one condition. The name of the model is `capsule`.
    pub request: EvalRequest,
    /// The hash of the evaluated weights: those of the capsule, or those that were rounded to pack it.
    pub weights: String,
    /// The hashes of the starts, the goals and the dataset.
    pub hashes: BTreeMap<String, String>,
    /// The successes of the model, and the episodes that count.
    pub success: [usize; 2],
    /// The same for the random-policy floor.
    pub floor: Option<[usize; 2]>,
    /// The returns of the model and of the floor in episodes that were played to their end, if they were measured.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub returns: Vec<Returns>,
    /// The recorded episodes.
    pub episodes: Vec<RecordedEpisode>,
}

/// The returns of the episodes of a policy, each the sum of the rewards of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Returns {
    /// The mean.
    pub mean: f64,
    /// The standard deviation, over the number of episodes.
    pub std: f64,
}

impl Returns {
    fn of(run: &Run) -> Self {
        let returns: Vec<f64> = run.episodes.iter().map(|episode| episode.total_reward).collect();
        let n = returns.len().max(1) as f64;
        let mean = returns.iter().sum::<f64>() / n;
        Self { mean, std: (returns.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / n).sqrt() }
    }
}

/// The outcome of an episode.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedEpisode {
    /// The number of the episode in the evaluation.
    pub number: usize,
    /// Whether the episode succeeded.
    pub success: bool,
    /// Whether the episode was solved at start.
    pub solved_at_start: bool,
    /// The number of steps played.
    pub steps: usize,
    /// The dataset's `[episode, step]` of the start, if the starts come from a dataset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<[usize; 2]>,
}

impl RecordedEpisode {
    /// Returns the outcome of the episode with this number.
    pub(super) fn of(number: usize, result: &EpisodeResult) -> Self {
        let EpisodeResult { success, solved_at_start, steps, start, .. } = *result;
        Self { number, success, solved_at_start, steps, start }
    }

    /// Describes the outcome.
    pub(super) fn outcome(&self) -> String {
        let outcome = match (self.solved_at_start, self.success) {
            (true, _) => "solved at start",
            (_, true) => "solved",
            _ => "not solved",
        };
        format!("{outcome} after {} steps", self.steps)
    }
}

impl EvaluationRecord {
    /// Finds the evaluation of the model with one of these hashes in results. Returns the record, without episodes, and
    /// the numbers of the episodes to record: two that the model solved and one that it did not, if there are such.
    ///
    /// # Errors
    /// When the results hold no run, or several runs, of the model, or were not counted strictly.
    pub(super) fn find(file: &Path, results: &Results, hashes: &[&str]) -> Result<(Self, Vec<usize>)> {
        let (manifest, request) = (&results.manifest, EvalRequest::of(&results.manifest)?);
        let Counting::Strict { .. } = request.counting else {
            return Err(unfit(file, format!("its counting is {}", request.counting.name())));
        };
        let Evaluated { policy, weights, run, floor } = Evaluated::find(file, results, &request, hashes)?;
        let (Some(condition), Some(kind)) = (request.conditions.first(), with_model(&policy.kind, MODEL)) else {
            return Err(unfit(file, "its request has no condition".to_owned()));
        };
        let counts = |run: &Run| [run.success.successes, run.success.n];
        let kept = ["starts", "goals", "dataset"];
        let record = Self {
            weights,
            hashes: manifest.hashes.clone().into_iter().filter(|(name, _)| kept.contains(&name.as_str())).collect(),
            success: counts(run),
            floor: floor.map(counts),
            returns: vec![],
            episodes: vec![],
            request: EvalRequest {
                policies: vec![PolicyRequest { name: MODEL.to_owned(), kind }],
                conditions: vec![condition.clone()],
                prediction: None,
                ..request.clone()
            },
        };
        Ok((record, choose(run)))
    }

    /// Returns the returns of the model with one of these hashes, and of the floor, in results.
    ///
    /// # Errors
    /// As [`Self::find`], and when episodes end with a success: such a return lacks the rewards of the steps after it.
    pub(super) fn returns_in(file: &Path, results: &Results, hashes: &[&str]) -> Result<Vec<Returns>> {
        let request = EvalRequest::of(&results.manifest)?;
        if matches!(request.counting, Counting::Strict { .. }) {
            let problem = "its episodes end with a success, and their returns lack the rewards after it";
            let fix = "evaluate with --protocol compat, which plays episodes to their end";
            return Err(Error::config(file.display().to_string(), problem, fix));
        }
        let Evaluated { run, floor, .. } = Evaluated::find(file, results, &request, hashes)?;
        Ok([Some(run), floor].into_iter().flatten().map(Returns::of).collect())
    }

    /// Reads and checks the record of a capsule.
    ///
    /// # Errors
    /// When the record is damaged, its request names another model, or its episodes do not fit the tensors.
    pub fn read(evaluation: &Evaluation) -> Result<Self> {
        let again = "copy the capsule again from its source, or pack it again";
        let wrong = |problem: String| Error::config("the evaluation in the capsule", problem, again);
        let record = Self::deserialize(&evaluation.record).map_err(|error| wrong(error.to_string()))?;
        let Self { request, episodes, .. } = &record;
        if request.version != EvalRequest::VERSION {
            return Err(wrong(format!("its request has layout {}", request.version)));
        }
        request.check()?;
        let ([PolicyRequest { kind, .. }], [_]) = (&request.policies[..], &request.conditions[..]) else {
            let given = format!("{} policies and {} conditions", request.policies.len(), request.conditions.len());
            return Err(wrong(format!("it has {given} instead of one of each")));
        };
        if trained(kind) != Some(MODEL) {
            return Err(wrong("its policy is not the model of the capsule".to_owned()));
        }
        if episodes.len() > MAX_EPISODES {
            return Err(wrong(format!("it has {} episodes, more than {MAX_EPISODES}", episodes.len())));
        }
        check_cost(request).map_err(wrong)?;
        let rows = evaluation.rows.as_ref().map_or(0, swm_core::Batch::rows);
        let expected = if request.starts == StartsRequest::Episodic { 0 } else { 2 * episodes.len() };
        if evaluation.starts.rows() != episodes.len() || rows != expected {
            let given = format!("{} starts and {rows} rows", evaluation.starts.rows());
            return Err(wrong(format!("it has {given} for {} episodes", episodes.len())));
        }
        if [Some(record.success), record.floor].into_iter().flatten().any(|[successes, n]| successes > n) {
            return Err(wrong("it has more successes than episodes".to_owned()));
        }
        if [Some(record.success), record.floor].into_iter().flatten().any(|[_, n]| n > request.episodes) {
            return Err(wrong(format!("it counts more than the {} episodes of its request", request.episodes)));
        }
        if record.returns.len() > 2 || record.returns.iter().any(|returns| !(returns.mean + returns.std).is_finite()) {
            return Err(wrong(format!("it has the returns {:?}", record.returns)));
        }
        if let Some(text) = record.hashes.values().chain([&record.weights]).find(|text| !is_hash(text)) {
            return Err(wrong(format!("'{}' is no hash", text.escape_debug())));
        }
        Ok(record)
    }

    /// Returns the policy of the evaluation, with the checkpoint `name`.
    pub fn policy(&self, name: &str) -> Option<PolicyKind> {
        self.request.policies.first().and_then(|policy| with_model(&policy.kind, name))
    }

    /// Returns the success rate of the model.
    pub fn success(&self) -> Proportion {
        let [successes, n] = self.success;
        Proportion::wilson(successes, n)
    }

    /// Returns the success rate of the random-policy floor.
    pub fn floor(&self) -> Option<Proportion> {
        self.floor.map(|[successes, n]| Proportion::wilson(successes, n))
    }

    /// Returns the numbers of the recorded episodes, and the dataset's `[episode, step]` of their starts.
    pub(super) fn numbers(&self) -> (Vec<usize>, Vec<[usize; 2]>) {
        let numbers = self.episodes.iter().map(|episode| episode.number).collect();
        (numbers, self.episodes.iter().filter_map(|episode| episode.start).collect())
    }

    /// Returns the recorded episodes, to be played again.
    pub(super) fn recorded<'a>(
        evaluation: &'a Evaluation,
        numbers: &'a [usize],
        starts: &'a [[usize; 2]],
    ) -> Recorded<'a> {
        Recorded { numbers, rows: evaluation.rows.as_ref().map(|rows| (rows, starts)) }
    }
}

/// The run of a model in results.
struct Evaluated<'r> {
    policy: &'r PolicyRequest,
    weights: String,
    run: &'r Run,
    /// The run of the random-policy floor.
    floor: Option<&'r Run>,
}

impl<'r> Evaluated<'r> {
    /// Finds the run of the model with one of these hashes under the first condition.
    ///
    /// # Errors
    /// When the results hold no run, or several runs, of the model, or decided the number of episodes.
    fn find(file: &Path, results: &'r Results, request: &'r EvalRequest, hashes: &[&str]) -> Result<Self> {
        if results.sequential || results.stopping.is_some() {
            return Err(unfit(file, "its results decided the number of episodes".to_owned()));
        }
        let stored = &results.manifest.hashes;
        let weights = |policy: &PolicyRequest| {
            let hash = stored.get(&format!("weights of {}", policy.name)).or(stored.get("weights"))?;
            (trained(&policy.kind).is_some() && hashes.contains(&hash.as_str())).then(|| hash.clone())
        };
        let found: Vec<(&PolicyRequest, String)> =
            request.policies.iter().filter_map(|policy| Some((policy, weights(policy)?))).collect();
        let [(policy, weights)] = &found[..] else {
            return Err(unfit(file, format!("{} of its policies have the weights of this checkpoint", found.len())));
        };
        let condition = request.conditions.first().map(|condition| condition.name.as_str()).unwrap_or_default();
        let run_of = |policy: &PolicyRequest| {
            results.runs.iter().find(|run| run.policy == policy.name && run.condition == condition)
        };
        let run = run_of(policy).ok_or_else(|| unfit(file, format!("it has no run of '{}'", policy.name)))?;
        let floor = request.policies.iter().find(|policy| policy.kind == PolicyKind::Random);
        Ok(Self { policy, weights: weights.clone(), run, floor: floor.and_then(run_of) })
    }
}

fn unfit(file: &Path, problem: String) -> Error {
    let fix = "evaluate this checkpoint alone with strict counting (`swm eval`), and give its results.json";
    Error::config(file.display().to_string(), problem, fix)
}

/// Chooses the numbers of the episodes to record.
fn choose(run: &Run) -> Vec<usize> {
    let played = |success: bool| {
        let episodes = run.episodes.iter().enumerate();
        episodes.filter(move |(_, episode)| !episode.solved_at_start && episode.success == success).map(|(i, _)| i)
    };
    let (solved, failed): (Vec<usize>, Vec<usize>) = (played(true).collect(), played(false).collect());
    let failures = failed.len().min(if solved.len() < EPISODES - 1 { EPISODES - solved.len() } else { 1 });
    let mut numbers: Vec<usize> = solved.into_iter().take(EPISODES - failures).collect();
    numbers.extend(failed.into_iter().take(failures));
    numbers.sort_unstable();
    numbers
}

/// Whether a text has the form of a BLAKE3 hash.
pub fn is_hash(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Checks what an episode of a request from a file costs.
///
/// # Errors
/// When its time limit or a plan of a policy is too large; the text says which.
pub fn check_cost(request: &EvalRequest) -> std::result::Result<(), String> {
    let budget = request.budget.unwrap_or_default();
    if budget > MAX_BUDGET {
        return Err(format!("its episodes have {budget} steps, more than {MAX_BUDGET}"));
    }
    match request.policies.iter().map(|policy| plan(&policy.kind)).find(|steps| *steps > MAX_PLAN) {
        Some(steps) => Err(format!("a plan of its policy has {steps} model steps, more than {MAX_PLAN}")),
        None => Ok(()),
    }
}

/// Returns the name of the checkpoint that a policy uses.
pub fn trained(kind: &PolicyKind) -> Option<&str> {
    match kind {
        PolicyKind::Plan { model: Model::TrueDynamics { .. } | Model::Probe { .. }, .. } => None,
        kind => kind.checkpoint(),
    }
}

/// Returns the number of model steps of a plan, as far as the settings state its factors; 1 for other policies.
fn plan(kind: &PolicyKind) -> usize {
    let PolicyKind::Plan { solver, mpc, .. } = kind else { return 1 };
    let count = |settings: &serde_json::Value, name: &str| {
        settings
            .get(name)
            .and_then(serde_json::Value::as_u64)
            .map_or(1, |count| usize::try_from(count).unwrap_or(usize::MAX))
    };
    let of_solver =
        ["samples", "iterations", "outer_iterations", "sync_iterations"].map(|name| count(&solver.settings, name));
    limits::product(of_solver.into_iter().chain([count(mpc, "horizon")]))
}

/// Returns the policy with another checkpoint; `None` if it uses no checkpoint.
fn with_model(kind: &PolicyKind, name: &str) -> Option<PolicyKind> {
    match kind.clone() {
        PolicyKind::Plan { model: Model::Checkpoint(_), solver, mpc, objective } => {
            Some(PolicyKind::Plan { model: Model::Checkpoint(name.to_owned()), solver, mpc, objective })
        }
        PolicyKind::Direct { settings, .. } => Some(PolicyKind::Direct { checkpoint: name.to_owned(), settings }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;
    use swm_eval::Choice;

    #[test]
    fn model_steps_of_a_plan_are_counted_without_overflow() {
        let kind = |settings: serde_json::Value, horizon: u64| PolicyKind::Plan {
            model: Model::Checkpoint(MODEL.to_owned()),
            solver: Choice { id: "cem".to_owned(), settings },
            mpc: json!({"horizon": horizon}),
            objective: serde_json::Value::Null,
        };
        assert_eq!(plan(&kind(json!({"samples": 300, "iterations": 30}), 5)), 45_000);
        assert_eq!(plan(&kind(json!({"samples": 1000}), 5)), 5000);
        assert!(plan(&kind(json!({"samples": u64::MAX, "iterations": u64::MAX}), 10_000)) > MAX_PLAN);
    }
}
