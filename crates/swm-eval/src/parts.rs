//! The conditions of an evaluation apart, for several machines, and their results together again.

use crate::request::{EvalRequest, StartsRequest};
use crate::runner::{Resolver, RunOptions};
use crate::starts_hash::StartsHash;
use std::collections::BTreeMap;
use swm_core::results::Comparison;
use swm_core::{Error, Result, Results};

impl EvalRequest {
    /// This evaluation under its condition with this index only.
    ///
    /// # Errors
    /// When there is no such condition.
    pub fn part(&self, index: usize) -> Result<Self> {
        let Some(condition) = self.conditions.get(index) else {
            let problem = format!("there is no condition {index} of {}", self.conditions.len());
            return Err(Error::config("the part of an evaluation", problem, "count from 0"));
        };
        Ok(Self { conditions: vec![condition.clone()], ..self.clone() })
    }

    /// Returns the results of this evaluation from those of its [parts](Self::part), in order. Nothing is played; the starts
    /// are reset once, for their hash.
    ///
    /// # Errors
    /// When a part is missing, or its results are those of another evaluation, of other data or weights, or of other libraries.
    pub fn join(&self, parts: Vec<Results>, resolver: &dyn Resolver, options: &RunOptions) -> Result<Results> {
        let other = |index: usize, problem: &str| {
            let fix = "evaluate all parts with the same command, version, data and weights";
            Error::config(format!("part {index} of the evaluation"), problem, fix)
        };
        if parts.len() != self.conditions.len() {
            let problem = format!("of {} are there", self.conditions.len());
            return Err(other(parts.len(), &problem));
        }
        // The starts of a part have hashes of their own.
        let inputs = |results: &Results| -> BTreeMap<String, String> {
            let hashes = results.manifest.hashes.clone().into_iter();
            hashes.filter(|(name, _)| !["starts", "goals"].contains(&name.as_str())).collect()
        };
        for (index, part) in parts.iter().enumerate() {
            let (manifest, first) = (&part.manifest, &parts[0].manifest);
            if !self.part(index)?.is_of(part)? || part.runs.iter().any(|run| run.episodes.len() != self.episodes) {
                return Err(other(index, "has the results of another evaluation"));
            }
            if inputs(part) != inputs(&parts[0]) {
                return Err(other(index, "was evaluated with other data or weights than part 0"));
            }
            if manifest.libraries != first.libraries || manifest.device != first.device {
                return Err(other(index, "was evaluated with other libraries, another renderer or device than part 0"));
            }
        }
        let Some(first) = parts.first() else { return Err(other(0, "is missing")) };
        let request = Self { budget: Self::of(&first.manifest)?.budget, ..self.with_floor()? };
        let mut manifest = first.manifest.clone();
        manifest.config =
            serde_json::to_value(&request).map_err(|e| Error::external("writing an evaluation's request", e))?;
        manifest.hashes = inputs(first);
        manifest.hashes.extend(request.hash_of_starts(resolver, options)?.hashes());
        let runs: Vec<_> = parts.into_iter().flat_map(|part| part.runs).collect();
        Ok(Results {
            manifest,
            env: request.env.clone(),
            protocol: request.protocol().to_owned(),
            counting: request.counting,
            comparisons: Comparison::all(&runs, request.counting),
            runs,
            sequential: false,
            stopping: None,
        })
    }

    /// The hash of the starts under all conditions.
    fn hash_of_starts(&self, resolver: &dyn Resolver, options: &RunOptions) -> Result<StartsHash> {
        let mut world = self.world(resolver, options.envs.clamp(1, self.episodes.max(1)), options)?;
        let dataset = match &self.starts {
            StartsRequest::Episodic => None,
            StartsRequest::Dataset { dataset, .. } => Some(resolver.dataset(dataset)?),
        };
        let mut hash = StartsHash::default();
        for condition in &self.conditions {
            let starts = self.starts(dataset.as_deref(), world.pool().env(0), condition.variation.clone())?;
            hash.add(&mut world, &starts)?;
        }
        Ok(hash)
    }
}
