//! [`Entry`]: the results of one trained policy as a file that others verify.

use crate::capsule::{check_cost, cpu_level, is_hash, trained};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;
use swm_core::results::{Comparison, Counting, Run};
use swm_core::text::printable;
use swm_core::{Error, Result, Results, files, manifest};
use swm_eval::{EvalRequest, Model, PolicyKind, PolicyRequest};

/// The layout that this version writes and reads.
const VERSION: u32 = 1;
/// The largest file of an entry, in bytes.
const MAX_BYTES: u64 = 16 << 20;
/// The longest name of an author or a licence, in characters.
const MAX_TEXT: usize = 120;
/// The most episodes of a run.
const MAX_EPISODES: usize = 10_000;
/// The most conditions.
const MAX_CONDITIONS: usize = 200;
/// The hashes of an evaluation that an entry keeps, beside that of the weights.
const KEPT: [&str; 3] = ["starts", "goals", "dataset"];

/// The results of one trained policy, with the baselines that were evaluated beside it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Entry {
    /// The layout of the file.
    pub version: u32,
    /// The name of the policy in the results.
    pub policy: String,
    /// Who submits the entry.
    pub author: String,
    /// The licence of the weights and of the results.
    pub licence: String,
    /// The architecture and the level of vector instructions of the processor that the results were made on.
    pub processor: String,
    /// The results, with every episode, and the request in their manifest.
    pub results: Results,
    /// The BLAKE3 hash of all other fields, as JSON.
    pub hash: String,
}

/// The content of an entry's file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    version: u32,
    policy: String,
    author: String,
    licence: String,
    processor: String,
    results: Value,
    hash: String,
}

/// What an entry is made from.
#[derive(Clone, Debug)]
pub struct Submission {
    /// The results of an evaluation.
    pub results: Results,
    /// The name of the policy; `None` for the only one with weights.
    pub policy: Option<String>,
    /// Who submits it.
    pub author: String,
    /// The licence of the weights and of the results.
    pub licence: String,
}

impl Entry {
    /// Makes an entry from results that this machine computed. Of the policies, the entry keeps one with weights, and the
    /// baselines: the floor, experts, the simulator and others without weights. It leaves out videos, searches and prediction
    /// errors.
    ///
    /// # Errors
    /// When no policy, or several policies, with weights may be meant, counting is not strict, or a text is empty or too
    /// long.
    pub fn new(submission: Submission) -> Result<Self> {
        let Submission { mut results, policy, author, licence } = submission;
        let all = EvalRequest::of(&results.manifest)?;
        let policy = chosen(&all, policy.as_deref())?;
        let keeps = |other: &PolicyRequest| other.name == policy || baseline(&other.kind).is_some();
        let policies: Vec<PolicyRequest> = all.policies.iter().filter(|other| keeps(other)).cloned().collect();
        let request = EvalRequest { policies, prediction: None, ..all.clone() };
        let weights = results.manifest.hashes.get(&all.weights_key(&policy)).cloned();
        results.manifest.hashes.retain(|name, _| KEPT.contains(&name.as_str()));
        results.manifest.hashes.extend(weights.map(|hash| (request.weights_key(&policy), hash)));
        results.manifest.config = to_json(&request)?;
        results.runs.retain(|run| request.policies.iter().any(|policy| policy.name == run.policy));
        results.runs = results.runs.iter().map(kept).collect();
        results.comparisons = Comparison::all(&results.runs, results.counting);
        let entry =
            Self { version: VERSION, policy, author, licence, processor: cpu_level(), results, hash: String::new() };
        let entry = entry.sealed()?;
        entry.check().map_err(|problem| {
            Error::config("the results", problem, "evaluate again with this version and strict counting (`swm eval`)")
        })?;
        Ok(entry)
    }

    /// Reads and checks the entry in a file.
    ///
    /// # Errors
    /// When the file cannot be read, is too large or no entry of this version, or its parts contradict each other.
    pub fn read(path: &Path) -> Result<Self> {
        let wrong = |problem: String| {
            Error::corrupt(path, problem, "get the entry again from its source, or submit it again (`swm leaderboard`)")
        };
        let bytes = files::read(path, MAX_BYTES)?;
        let stored: Stored = serde_json::from_slice(&bytes)
            .map_err(|error| wrong(format!("is no entry of a leaderboard that this version reads ({error})")))?;
        let Stored { version, policy, author, licence, processor, results, hash } = stored;
        if version != VERSION {
            return Err(wrong(format!("is an entry of layout {version}; this version reads {VERSION}")));
        }
        let stored = results;
        let results = swm_report::parse_results(path, stored.to_string().as_bytes())?;
        let entry = Self { version, policy, author, licence, processor, results, hash };
        let found = entry.content_hash()?;
        if entry.hash != found {
            return Err(wrong(format!("was edited: it states the hash {}, and its content has {found}", entry.hash)));
        }
        if let Some(field) = uncovered("results", &stored, &to_json(&entry.results)?) {
            let field: String = printable(&field).chars().take(MAX_TEXT).collect();
            return Err(wrong(format!("has '{field}', which this version does not know and the hash does not cover")));
        }
        entry.check().map_err(|problem| wrong(format!("is inconsistent: {problem}")))?;
        Ok(entry)
    }

    /// This entry with the hash of its content.
    ///
    /// # Errors
    /// When the content is no JSON, which is a bug.
    pub fn sealed(self) -> Result<Self> {
        Ok(Self { hash: self.content_hash()?, ..self })
    }

    /// Writes the entry to a file.
    ///
    /// # Errors
    /// When writing fails.
    pub fn write(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).map_err(|error| Error::external("writing an entry", error))?;
        files::write(path, (text + "\n").as_bytes())
    }

    /// The request of the results.
    ///
    /// # Errors
    /// When the manifest holds none.
    pub fn request(&self) -> Result<EvalRequest> {
        EvalRequest::of(&self.results.manifest)
    }

    /// The hash of the policy's weights.
    ///
    /// # Errors
    /// As [`Entry::request`], and when the manifest states no hash.
    pub fn weights(&self) -> Result<&str> {
        let key = self.request()?.weights_key(&self.policy);
        let found = self.results.manifest.hashes.get(&key).map(String::as_str);
        found.ok_or_else(|| Error::config("the entry", format!("its manifest has no hash '{key}'"), "submit it again"))
    }

    /// The checkpoint that the request names.
    ///
    /// # Errors
    /// As [`Entry::request`], and when the policy has no checkpoint.
    pub fn checkpoint(&self) -> Result<String> {
        let request = self.request()?;
        let policy = request.policies.iter().find(|policy| policy.name == self.policy);
        let name = policy.and_then(|policy| trained(&policy.kind)).map(str::to_owned);
        name.ok_or_else(|| {
            Error::config("the entry", format!("its policy '{}' has no weights", self.policy), "submit it again")
        })
    }

    fn content_hash(&self) -> Result<String> {
        let content = to_json(&Self { hash: String::new(), ..self.clone() })?;
        Ok(manifest::hash(content.to_string().as_bytes()))
    }

    /// Checks everything that can be checked without playing.
    fn check(&self) -> std::result::Result<(), String> {
        let Self { policy, author, licence, processor, results, .. } = self;
        let device = &results.manifest.device;
        for (what, text) in [("author", author), ("licence", licence), ("processor", processor), ("device", device)] {
            let is_plain = printable(text) == text.as_str() && !text.contains(['\n', '\t']);
            if text.trim().is_empty() || text.chars().count() > MAX_TEXT || !is_plain {
                return Err(format!(
                    "its {what} is empty, longer than {MAX_TEXT} characters, or has control characters"
                ));
            }
        }
        let request = self.request().map_err(|error| error.to_string())?;
        check_request(&request)?;
        if results.sequential || results.stopping.is_some() {
            return Err("its results decided the number of episodes, so that the intervals do not hold".to_owned());
        }
        if request.prediction.is_some() {
            return Err("its request has prediction errors, which its results lack".to_owned());
        }
        check_runs(&request, &results.runs)?;
        check_policies(&request, policy)?;
        let hashes = &results.manifest.hashes;
        if !hashes.get(&request.weights_key(policy)).is_some_and(|hash| is_hash(hash)) {
            return Err(format!("its policy '{policy}' has no weights with a hash"));
        }
        match ["starts", "goals"].into_iter().find(|name| !hashes.contains_key(*name)) {
            Some(missing) => Err(format!("its manifest has no hash of the {missing}")),
            None => results.check(),
        }
    }
}

/// Returns the path of a field or an element of `stored` that `covered`, from which the hash is computed, lacks; `path` is that of
/// both.
fn uncovered(path: &str, stored: &Value, covered: &Value) -> Option<String> {
    match (stored, covered) {
        (Value::Object(stored), Value::Object(covered)) => stored.iter().find_map(|(name, value)| {
            let path = format!("{path}.{name}");
            match covered.get(name) {
                Some(covered) => uncovered(&path, value, covered),
                None => Some(path),
            }
        }),
        (Value::Array(stored), Value::Array(covered)) => stored.iter().enumerate().find_map(|(index, value)| {
            let path = format!("{path}[{index}]");
            match covered.get(index) {
                Some(covered) => uncovered(&path, value, covered),
                None => Some(path),
            }
        }),
        (Value::Object(_) | Value::Array(_), _) => Some(path.to_owned()),
        _ => None,
    }
}

/// Checks the counting of a request, and what it costs.
fn check_request(request: &EvalRequest) -> std::result::Result<(), String> {
    request.check().map_err(|error| error.to_string())?;
    check_cost(request)?;
    let Counting::Strict { .. } = request.counting else {
        return Err(format!("counting is {}, not strict", request.counting.name()));
    };
    if request.episodes > MAX_EPISODES || request.conditions.len() > MAX_CONDITIONS {
        let given = format!("{} episodes under {} conditions", request.episodes, request.conditions.len());
        return Err(format!("it has {given}, more than {MAX_EPISODES} under {MAX_CONDITIONS}"));
    }
    Ok(())
}

/// Checks that one policy has weights, that the others are baselines, and that names which pages give a meaning have that
/// meaning.
fn check_policies(request: &EvalRequest, policy: &str) -> std::result::Result<(), String> {
    for PolicyRequest { name, kind } in &request.policies {
        let is_other = match name.as_str() {
            "random" => *kind != PolicyKind::Random,
            "expert" => !matches!(kind, PolicyKind::Expert { .. }),
            _ => false,
        };
        if is_other {
            return Err(format!("its policy '{name}' is no such policy, for which the name is reserved"));
        }
        match (name == policy, trained(kind)) {
            (true, None) => return Err(format!("its policy '{name}' has no weights with a hash")),
            (false, Some(_)) => return Err(format!("it has a second policy with weights, '{name}'")),
            (false, None) if baseline(kind).is_none() => {
                return Err(format!(
                    "its policy '{name}' is no baseline: it plans in a trained model, with the dynamics of the environment or \
                     by a probe"
                ));
            }
            _ => {}
        }
    }
    match request.policies.iter().any(|found| found.name == policy) {
        true => Ok(()),
        false => Err(format!("its results have no policy '{policy}'")),
    }
}

/// What an entry keeps of a run: not what verification does not compute again, and no videos, which are other files.
fn kept(run: &Run) -> Run {
    Run { strict: None, searches: None, prediction: None, played: None, videos: vec![], ..run.clone() }
}

/// Checks that there is one run for each condition and policy of a request, in order, with all episodes and nothing that entries
/// leave out.
fn check_runs(request: &EvalRequest, runs: &[Run]) -> std::result::Result<(), String> {
    let expected = request.conditions.iter().flat_map(|condition| {
        request.policies.iter().map(move |policy| (condition.name.as_str(), policy.name.as_str()))
    });
    if !runs.iter().map(|run| (run.condition.as_str(), run.policy.as_str())).eq(expected) {
        return Err("its runs are not those of its request".to_owned());
    }
    if let Some(run) = runs.iter().find(|run| kept(run) != **run) {
        return Err(format!(
            "its run '{}' has videos, searches, prediction errors or a rate of strict counting, which entries leave out",
            run.policy
        ));
    }
    match runs.iter().find(|run| run.episodes.len() != request.episodes) {
        Some(run) => Err(format!(
            "its run '{}' has {} episodes, its request {}",
            run.policy,
            run.episodes.len(),
            request.episodes
        )),
        None => Ok(()),
    }
}

/// Returns the name of the policy with weights.
fn chosen(request: &EvalRequest, given: Option<&str>) -> Result<String> {
    let with_weights: Vec<&str> = request
        .policies
        .iter()
        .filter(|policy| trained(&policy.kind).is_some())
        .map(|policy| policy.name.as_str())
        .collect();
    match (given, &with_weights[..]) {
        (None, [only]) => Ok((*only).to_owned()),
        (Some(given), all) if all.contains(&given) => Ok(given.to_owned()),
        (Some(given), all) => {
            Err(Error::unknown("policy", given, all.iter().copied(), "name a policy of the results that has weights"))
        }
        (None, all) => {
            let problem = match all.len() {
                0 => "none of their policies has weights".to_owned(),
                _ => format!("several of their policies have weights: {}", all.join(", ")),
            };
            Err(Error::config("the results", problem, "name one policy with --policy, and submit each alone"))
        }
    }
}

/// The kinds of policies without weights that an entry may hold, by their names for readers.
pub(super) fn baseline(kind: &PolicyKind) -> Option<&'static str> {
    match kind {
        PolicyKind::Random => Some("random-policy floor"),
        PolicyKind::NoOp => Some("does nothing"),
        PolicyKind::Replay => Some("repeats what was recorded"),
        PolicyKind::Nearest => Some("nearest recorded actions"),
        PolicyKind::Expert { .. } => Some("expert"),
        PolicyKind::Plan { model: Model::Simulator { .. }, .. } => Some("plans in the simulator"),
        PolicyKind::Plan { .. } | PolicyKind::Direct { .. } => None,
    }
}

fn to_json(value: &impl Serialize) -> Result<Value> {
    serde_json::to_value(value).map_err(|error| Error::external("writing an entry", error))
}
