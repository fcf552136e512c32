//! [`reproduce`]: repeats an evaluation from its results and lists all differences.

use crate::prediction::Predictor;
use crate::request::{EvalRequest, PolicyRequest};
use crate::runner::{ResolvedPolicy, Resolver, RunOptions};
use crate::world::World;
use serde::Serialize;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;
use swm_core::results::Run;
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
        write!(f, "{}: was {}, is {}", self.what, self.was, self.is)
    }
}

/// Repeats the evaluation that gave `old` and lists the differences between the old and the new results.
///
/// # Errors
/// When the results contain no request that this version reads or another number of episodes than it requests, a dataset or a checkpoint has a different hash, and as
/// [`EvalRequest::run`].
pub fn reproduce(
    old: &Results,
    resolver: &dyn Resolver,
    options: &RunOptions,
    control: &mut Control<'_>,
) -> Result<Reproduction> {
    let request = EvalRequest::of(&old.manifest)?;
    if let Some(run) = old.runs.iter().find(|run| run.episodes.len() != request.episodes) {
        let [found, requested] = [run.episodes.len(), request.episodes];
        let problem = format!("its request has {requested} episodes, its run '{}' has {found}", run.policy);
        return Err(Error::config("the results' manifest", problem, "evaluate again (`swm eval`)"));
    }
    let results = request.run(&Checked { resolver, manifest: &old.manifest }, options, control)?;
    Ok(Reproduction { differences: differences(old, &results), results })
}

/// A resolver that rejects data and weights whose hashes differ from the hashes in the old results.
struct Checked<'a> {
    resolver: &'a dyn Resolver,
    manifest: &'a Manifest,
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
        Ok(policy)
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        self.resolver.predictor(request)
    }
}

/// Lists the differences between two results, except times and videos.
pub fn differences(old: &Results, new: &Results) -> Vec<Difference> {
    let mut found = vec![];
    let (then, now) = (&old.manifest, &new.manifest);
    let mut compare = |kind, what: &str, was: &str, is: &str| {
        if was != is {
            found.push(Difference { kind, what: what.to_owned(), was: was.to_owned(), is: is.to_owned() });
        }
    };
    compare(Kind::Version, "stable-worldmodel", &then.swm_version, &now.swm_version);
    compare(Kind::Version, "device", &then.device, &now.device);
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
    for ((run, episode), was, is) in pair_values(&outcomes(old), &outcomes(new)) {
        compare(Kind::Finding, &format!("episode {episode} of {run}"), was, is);
    }
    for (run, was, is) in pair_values(&summaries(old), &summaries(new)) {
        compare(Kind::Finding, run, was, is);
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

fn name(run: &Run) -> String {
    format!("{}, {}", run.policy, run.condition)
}

/// Every episode as JSON, by the name of its run and its index.
fn outcomes(results: &Results) -> BTreeMap<(String, usize), String> {
    let episodes = results.runs.iter().flat_map(|run| run.episodes.iter().enumerate().map(move |(i, e)| (run, i, e)));
    episodes.map(|(run, i, episode)| ((name(run), i), json(episode))).collect()
}

/// The success rates and the prediction errors of every run, as JSON. Searches are omitted, because tracing them is
/// optional.
fn summaries(results: &Results) -> BTreeMap<String, String> {
    results.runs.iter().map(|run| (name(run), json(&(run.success, run.strict, &run.prediction)))).collect()
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
