//! Running an evaluation again from its results, and saying exactly what differs.

use crate::World;
use crate::prediction::Predictor;
use crate::request::{EvalRequest, PolicyRequest};
use crate::runner::{Actor, Means, Moment, Resolver};
use serde::Serialize;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;
use swm_core::results::Run;
use swm_core::{Env, Error, Manifest, Result, Results};
use swm_data::Reader;

/// An evaluation that was run again.
#[derive(Clone, Debug, Serialize)]
pub struct Reproduction {
    /// What it found this time.
    pub results: Results,
    /// What differs from the first time, times and videos aside.
    pub differences: Vec<Difference>,
}

/// One thing that differs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// What kind of thing it is.
    pub kind: Kind,
    /// What it is, such as `episode 7 of lewm, in distribution`.
    pub what: String,
    /// How it was.
    pub was: String,
    /// How it is now.
    pub is: String,
}

/// What kind of thing differs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A version or a device: it explains differences, and alone is none.
    Version,
    /// What went in: the request, the hash of starts, goals, data or weights.
    Input,
    /// What came out.
    Finding,
}

impl Reproduction {
    /// Whether the same went in and the same came out.
    pub fn holds(&self) -> bool {
        self.differences.iter().all(|difference| difference.kind == Kind::Version)
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: was {}, is {}", self.what, self.was, self.is)
    }
}

/// Runs the evaluation behind some results again and compares.
///
/// # Errors
/// When the results hold no request that this version reads, a dataset or a checkpoint has another hash than the first
/// time, and as [`EvalRequest::run`].
pub fn reproduce(
    old: &Results,
    resolver: &dyn Resolver,
    means: &Means,
    watch: &mut (dyn FnMut(Moment<'_>) + Send),
) -> Result<Reproduction> {
    let request = EvalRequest::of(&old.manifest)?;
    let results = request.run(&Checked { resolver, manifest: &old.manifest }, means, watch)?;
    Ok(Reproduction { differences: differences(old, &results), results })
}

/// A resolver that refuses other data and weights than the first time, before anything is played.
struct Checked<'a> {
    resolver: &'a dyn Resolver,
    manifest: &'a Manifest,
}

impl Checked<'_> {
    fn check(&self, hash: &str, what: String, keys: &[&str]) -> Result<()> {
        match keys.iter().find_map(|&key| self.manifest.hashes.get(key)) {
            Some(first) if first != hash => Err(Error::config(
                what,
                format!("its hash is {hash}, the results were made with {first}"),
                "give what the results were made with under the same name",
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

    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<Actor> {
        let actor = self.resolver.policy(request, world)?;
        if let Some(weights) = &actor.weights {
            let own = format!("weights of {}", request.name);
            self.check(weights, own.clone(), &[&own, "weights"])?;
        }
        Ok(actor)
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        self.resolver.predictor(request)
    }
}

/// What differs between two results, times and videos aside.
pub fn differences(old: &Results, new: &Results) -> Vec<Difference> {
    let mut found = vec![];
    let (then, now) = (&old.manifest, &new.manifest);
    let mut note = |kind, what: &str, was: &str, is: &str| {
        if was != is {
            found.push(Difference { kind, what: what.to_owned(), was: was.to_owned(), is: is.to_owned() });
        }
    };
    note(Kind::Version, "stable-worldmodel", &then.swm_version, &now.swm_version);
    note(Kind::Version, "device", &then.device, &now.device);
    for (what, was, is) in both(&then.libraries, &now.libraries) {
        note(Kind::Version, what, was, is);
    }
    for (what, was, is) in both(&then.hashes, &now.hashes) {
        note(Kind::Input, &format!("hash of {what}"), was, is);
    }
    let [was, is] = [then, now].map(|manifest| {
        let mut leaves = BTreeMap::new();
        flatten("", &manifest.config, &mut leaves);
        leaves
    });
    for (what, was, is) in both(&was, &is) {
        note(Kind::Input, &format!("request, {what}"), was, is);
    }
    for ((run, episode), was, is) in both(&outcomes(old), &outcomes(new)) {
        note(Kind::Finding, &format!("episode {episode} of {run}"), was, is);
    }
    for (run, was, is) in both(&rest(old), &rest(new)) {
        note(Kind::Finding, run, was, is);
    }
    found
}

/// What is on either side, under the same key; what is missing is `nothing`.
fn both<'a, K: Ord>(
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

/// Every episode, by its run and its place.
fn outcomes(results: &Results) -> BTreeMap<(String, usize), String> {
    let episodes = results.runs.iter().flat_map(|run| run.episodes.iter().enumerate().map(move |(i, e)| (run, i, e)));
    episodes.map(|(run, i, episode)| ((name(run), i), json(episode))).collect()
}

/// What a run says beyond its episodes and what follows from them. How searches went is told only where it was traced.
fn rest(results: &Results) -> BTreeMap<String, String> {
    results.runs.iter().map(|run| (name(run), json(&(run.success, run.strict, &run.prediction)))).collect()
}

fn json(value: &impl Serialize) -> String {
    // Numbers, words and lists can always be written.
    serde_json::to_string(value).unwrap_or_default()
}

/// The leaves of a JSON value, by their path.
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
