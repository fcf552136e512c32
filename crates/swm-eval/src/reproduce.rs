//! [`reproduce`]: repeats an evaluation from its results and lists all differences; [`reproduce_episodes`]: repeats some of
//! its episodes.

use crate::prediction::Predictor;
use crate::request::{EvalRequest, PolicyRequest, StartsRequest};
use crate::runner::{Episodes, PROBE_DATASET, ResolvedPolicy, Resolver, RunOptions};
use crate::seeding::{episode_key, reset_seed};
use crate::world::World;
use serde::Serialize;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;
use swm_core::results::{Counting, Run};
use swm_core::run::Control;
use swm_core::{Env, Error, Manifest, Result, Results};
use swm_data::Reader;

/// A repeated evaluation.
#[derive(Clone, Debug, Serialize)]
pub struct Reproduction {
    /// The new results.
    pub results: Results,
    /// The differences from the old results, except times and videos.
    pub differences: Vec<Difference>,
}

/// A difference between two results.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// The kind of difference.
    pub kind: Kind,
    /// The differing item, such as `episode 7 of lewm, in distribution`.
    pub what: String,
    /// The old value.
    pub was: String,
    /// The new value.
    pub is: String,
}

/// The kind of a difference.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A version or a device. It may explain other differences, and [`Reproduction::holds`] ignores it.
    Version,
    /// An input: the request, or the hash of starts, goals, data or weights.
    Input,
    /// A result.
    Finding,
}

impl Reproduction {
    /// Whether all inputs and results are the same.
    pub fn holds(&self) -> bool {
        self.differences.iter().all(|difference| difference.kind == Kind::Version)
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Texts of results may have line feeds.
        write!(f, "{}", format!("{}: was {}, is {}", self.what, self.was, self.is).replace('\n', "\\n"))
    }
}

/// Repeats the evaluation that gave `old` and lists the differences between the old and the new results.
///
/// # Errors
/// When the results contain no request that this version reads, another number of episodes than it requests, or two runs of a
/// policy under one condition, a dataset or a checkpoint has a different hash, and as [`EvalRequest::run`].
pub fn reproduce(
    old: &Results,
    resolver: &dyn Resolver,
    options: &RunOptions,
    control: &mut Control<'_>,
) -> Result<Reproduction> {
    let request = requested(old)?;
    let results = request.run(&Checked { resolver, manifest: &old.manifest }, options, control)?;
    let results = match &old.stopping {
        Some(stopping) => results.stopped(stopping.until, stopping.most),
        None => results,
    };
    Ok(Reproduction { differences: differences(old, &results), results })
}

/// Repeats the episodes with these numbers of the evaluation that gave `old`, without prediction errors, and lists the
/// differences between the old and the new results. The reset seeds and the dataset rows of all episodes, and the hashes of
/// all starts and goals, are compared too, for which nothing is played.
///
/// # Errors
/// As [`reproduce`], and when the counting is not strict or an episode does not exist.
pub fn reproduce_episodes(
    old: &Results,
    numbers: &[usize],
    resolver: &dyn Resolver,
    options: &RunOptions,
    control: &mut Control<'_>,
) -> Result<Reproduction> {
    let request = EvalRequest { prediction: None, ..requested(old)? };
    if !matches!(request.counting, Counting::Strict { .. }) {
        let problem = format!("counting is {}, for which all episodes are played", request.counting.name());
        return Err(Error::config("repeating some episodes", problem, "repeat the whole evaluation"));
    }
    let checked = Checked { resolver, manifest: &old.manifest };
    let mut found = differing_starts(old, &request, &checked)?;
    let results = request.run_episodes(Episodes::Only(numbers), &checked, options, control)?;
    let mut part = old.clone();
    if let Some(config) = part.manifest.config.as_object_mut() {
        config.remove("prediction");
    }
    for run in &mut part.runs {
        let chosen = numbers.iter().map(|&number| run.episodes[number].clone()).collect();
        *run = Run::new(&run.condition, &run.policy, old.counting, chosen, run.timing.clone());
    }
    found.extend(list(&part, &results, &|index| numbers[index]));
    Ok(Reproduction { differences: found, results })
}

/// Returns the request of results whose runs have as many episodes as it says.
fn requested(old: &Results) -> Result<EvalRequest> {
    let request = EvalRequest::of(&old.manifest)?;
    if let Some(run) = old.runs.iter().find(|run| run.episodes.len() != request.episodes) {
        let [found, requested] = [run.episodes.len(), request.episodes];
        let problem = format!("its request has {requested} episodes, its run '{}' has {found}", run.policy);
        return Err(Error::config("the results' manifest", problem, "evaluate again (`swm eval`)"));
    }
    let mut seen = BTreeSet::new();
    if let Some(run) = old.runs.iter().find(|run| !seen.insert(key(run))) {
        let problem = format!("they have two runs of '{}' under '{}'", run.policy, run.condition);
        return Err(Error::config("the results", problem, "evaluate again (`swm eval`)"));
    }
    Ok(request)
}

/// Lists the episodes whose reset seed or dataset row is not that of the request.
fn differing_starts(old: &Results, request: &EvalRequest, resolver: &dyn Resolver) -> Result<Vec<Difference>> {
    request.check()?;
    let picks = match &request.starts {
        StartsRequest::Episodic => vec![],
        StartsRequest::Dataset { dataset, .. } => request.picks(&*resolver.dataset(dataset)?)?,
    };
    let mut found = vec![];
    for run in &old.runs {
        for (i, episode) in run.episodes.iter().enumerate() {
            let expected = (reset_seed(episode_key(request.seed, i)), picks.get(i).copied());
            let given = (episode.seed, episode.start);
            if given != expected {
                let what = format!("seed and row of the start of episode {i} of {}", name(run));
                found.push(Difference { kind: Kind::Input, what, was: json(&given), is: json(&expected) });
            }
        }
    }
    Ok(found)
}

/// A resolver that rejects data and weights whose hashes differ from the hashes in the old results.
pub(crate) struct Checked<'a> {
    pub(crate) resolver: &'a dyn Resolver,
    pub(crate) manifest: &'a Manifest,
}

impl Checked<'_> {
    fn check(&self, hash: &str, what: String, keys: &[&str]) -> Result<()> {
        match keys.iter().find_map(|&key| self.manifest.hashes.get(key)) {
            Some(first) if first != hash => Err(Error::config(
                what,
                format!("its hash is {hash}, but the results were made with {first}"),
                "restore the data or weights that the results were made with",
            )),
            _ => Ok(()),
        }
    }
}

impl Resolver for Checked<'_> {
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>> {
        self.resolver.env(request)
    }

    fn dataset(&self, name: &str) -> Result<Arc<dyn Reader>> {
        let reader = self.resolver.dataset(name)?;
        self.check(&reader.content_hash()?, format!("dataset {name}"), &["dataset"])?;
        Ok(reader)
    }

    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<ResolvedPolicy> {
        let policy = self.resolver.policy(request, world)?;
        if let Some(weights) = &policy.weights {
            let key = format!("weights of {}", request.name);
            self.check(weights, key.clone(), &[&key, "weights"])?;
        }
        if let Some(dataset) = &policy.probe_dataset {
            self.check(dataset, PROBE_DATASET.to_owned(), &[PROBE_DATASET])?;
        }
        Ok(policy)
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        self.resolver.predictor(request)
    }
}

/// Lists the differences between two results, except times and videos.
pub fn differences(old: &Results, new: &Results) -> Vec<Difference> {
    list(old, new, &|index| index)
}

/// Lists the differences; `number` is the number of the episode at an index.
fn list(old: &Results, new: &Results, number: &dyn Fn(usize) -> usize) -> Vec<Difference> {
    let mut found = vec![];
    let (then, now) = (&old.manifest, &new.manifest);
    let mut compare = |kind, what: &str, was: &str, is: &str| {
        if was != is {
            found.push(Difference { kind, what: what.to_owned(), was: was.to_owned(), is: is.to_owned() });
        }
    };
    compare(Kind::Version, "stable-worldmodel", &then.swm_version, &now.swm_version);
    compare(Kind::Version, "device", &then.device, &now.device);
    compare(Kind::Input, "environment", &old.env, &new.env);
    compare(Kind::Input, "protocol", &old.protocol, &new.protocol);
    compare(Kind::Input, "counting", &json(&old.counting), &json(&new.counting));
    compare(Kind::Input, "seed", &then.seed.to_string(), &now.seed.to_string());
    for (what, was, is) in pair_values(&then.libraries, &now.libraries) {
        compare(Kind::Version, what, was, is);
    }
    for (what, was, is) in pair_values(&then.hashes, &now.hashes) {
        compare(Kind::Input, &format!("hash of {what}"), was, is);
    }
    let [was, is] = [then, now].map(|manifest| {
        let mut leaves = BTreeMap::new();
        flatten("", &manifest.config, &mut leaves);
        leaves
    });
    for (what, was, is) in pair_values(&was, &is) {
        compare(Kind::Input, &format!("request, {what}"), was, is);
    }
    for (((policy, condition), episode), was, is) in pair_values(&outcomes(old), &outcomes(new)) {
        compare(Kind::Finding, &format!("episode {} of {policy}, {condition}", number(*episode)), was, is);
    }
    for ((policy, condition), was, is) in pair_values(&summaries(old), &summaries(new)) {
        compare(Kind::Finding, &format!("{policy}, {condition}"), was, is);
    }
    found
}

/// The values of both maps for every key; a missing value is `nothing`.
fn pair_values<'a, K: Ord>(
    was: &'a BTreeMap<K, String>,
    is: &'a BTreeMap<K, String>,
) -> impl Iterator<Item = (&'a K, &'a str, &'a str)> {
    let keys: BTreeSet<&K> = was.keys().chain(is.keys()).collect();
    let side = |map: &'a BTreeMap<K, String>, key| map.get(key).map_or("nothing", String::as_str);
    keys.into_iter().map(move |key| (key, side(was, key), side(is, key)))
}

/// The name of a run for readers. Another run may have the same one, because names of policies and conditions are free.
fn name(run: &Run) -> String {
    format!("{}, {}", run.policy, run.condition)
}

/// What identifies a run: its policy and its condition.
type RunKey<'a> = (&'a str, &'a str);

fn key(run: &Run) -> RunKey<'_> {
    (&run.policy, &run.condition)
}

/// Every episode as JSON, by its run and its index.
fn outcomes(results: &Results) -> BTreeMap<(RunKey<'_>, usize), String> {
    let episodes = results.runs.iter().flat_map(|run| run.episodes.iter().enumerate().map(move |(i, e)| (run, i, e)));
    episodes.map(|(run, i, episode)| ((key(run), i), json(episode))).collect()
}

/// The success rates and the prediction errors of every run, as JSON. Searches are omitted, because tracing them is
/// optional.
fn summaries(results: &Results) -> BTreeMap<RunKey<'_>, String> {
    results.runs.iter().map(|run| (key(run), json(&(run.success, run.strict, &run.prediction)))).collect()
}

fn json(value: &impl Serialize) -> String {
    // The serialisation of these types cannot fail.
    serde_json::to_string(value).unwrap_or_default()
}

/// Collects the leaves of a JSON value by their path.
fn flatten(path: &str, value: &Value, leaves: &mut BTreeMap<String, String>) {
    let below = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
    match value {
        Value::Object(fields) if !fields.is_empty() => {
            fields.iter().for_each(|(key, value)| flatten(&below(key), value, leaves));
        }
        Value::Array(items) if !items.is_empty() => {
            items.iter().enumerate().for_each(|(i, value)| flatten(&below(&i.to_string()), value, leaves));
        }
        leaf => drop(leaves.insert(path.to_owned(), leaf.to_string())),
    }
}
