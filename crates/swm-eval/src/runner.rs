//! Runs an [`EvalRequest`]: condition by condition, every policy on the same starts, the random-policy floor first.

use crate::baselines::Baselines;
use crate::evaluate::EvalConfig;
use crate::played::PlayedRecording;
use crate::prediction::{self, Predictor, predict_run};
use crate::request::{Condition, EvalRequest, HeldOut, PolicyKind, PolicyRequest, StartsRequest};
use crate::starts::Starts;
use crate::starts_hash::StartsHash;
use crate::video_recording::Videos;
use crate::world::{World, WorldConfig};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::results::{Comparison, Counting, Played, Proportion, Run, Searches, Timing};
use swm_core::run::{Control, Event, Stage};
use swm_core::{Env, Error, Manifest, PlanTrace, Policy, Result, Results, VariationRequest};
use swm_data::Reader;

/// The name of the random-policy floor in results.
const FLOOR: &str = "random";

/// The name of the stage that evaluates one policy under one condition.
const STAGE: &str = "evaluate";

/// Loads the environments, datasets and policies that a request names.
pub trait Resolver {
    /// Makes an environment of the request, with its wrappers.
    ///
    /// # Errors
    /// When there is no such environment or wrapper.
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>>;

    /// Opens a dataset by its name or path.
    ///
    /// # Errors
    /// When the dataset does not exist or is damaged.
    fn dataset(&self, name: &str) -> Result<Arc<dyn Reader>>;

    /// Makes a policy for all environments of a world. The runner makes the random-policy floor and the
    /// [baselines](crate::baselines) itself.
    ///
    /// # Errors
    /// When a checkpoint, an expert or a solver does not exist or does not fit the world.
    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<ResolvedPolicy>;

    /// Returns the model of a policy for prediction errors; `None` if the policy has no model or the model offers no
    /// predictions.
    ///
    /// # Errors
    /// As [`Resolver::policy`].
    fn predictor(&self, _request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        Ok(None)
    }
}

/// The name under which a manifest and a cell of a study have the hash of the dataset that a probe is fitted on.
pub const PROBE_DATASET: &str = "probe dataset";

/// A policy with its provenance.
pub struct ResolvedPolicy {
    /// The policy.
    pub policy: Box<dyn Policy>,
    /// The hash of the policy's weights; `None` without weights.
    pub weights: Option<String>,
    /// The hash of the content of the dataset that a probe of the policy was fitted on; `None` without a probe.
    pub probe_dataset: Option<String>,
    /// The versions of the libraries that determine the policy's actions.
    pub libraries: BTreeMap<String, String>,
    /// The device that computes the actions, such as `cpu (flex)`; `None` for the default device.
    pub device: Option<String>,
    /// Returns the searches of all plans since the last call; `None` if searches are not traced.
    pub searches: Option<TakeSearches>,
}

/// Returns the searches of all plans since the last call.
pub type TakeSearches = Box<dyn FnMut() -> Vec<PlanTrace>>;

impl From<Box<dyn Policy>> for ResolvedPolicy {
    fn from(policy: Box<dyn Policy>) -> Self {
        Self { policy, weights: None, probe_dataset: None, libraries: BTreeMap::new(), device: None, searches: None }
    }
}

/// The episodes that a run plays.
#[derive(Clone, Copy)]
pub(crate) enum Episodes<'a> {
    /// All episodes of the request.
    All,
    /// Those that these results of the same request with fewer episodes lack.
    After(&'a Results),
    /// Those with these numbers.
    Only(&'a [usize]),
}

impl Episodes<'_> {
    /// The numbers among `n` episodes; `None` for all.
    fn numbers(self, n: usize) -> Option<Vec<usize>> {
        match self {
            Self::All => None,
            Self::Only(numbers) => Some(numbers.to_vec()),
            Self::After(earlier) => {
                let played = earlier.runs.first().map_or(0, |run| run.episodes.len());
                (played > 0).then(|| (played..n).collect())
            }
        }
    }
}

/// Options of a run that do not change its results.
#[derive(Clone, Debug, Default)]
pub struct RunOptions {
    /// Environments played and planned for at the same time. Compat counting of episodic starts overrides
    /// this number.
    pub envs: usize,
    /// Worker threads; 0 for the number of cores.
    pub threads: usize,
    /// Videos of the first episodes of every run: the folder of the results file, and the number of episodes.
    pub videos: Option<(PathBuf, usize)>,
    /// Frame strips of this many frames instead of videos ([`frame_strip`](crate::frame_strip())).
    pub frame_strip: Option<usize>,
    /// Videos wait for [`publish`](crate::publish) before they replace those of older results.
    pub staged: bool,
}

impl EvalRequest {
    /// Evaluates every policy, and the random-policy floor, from the same starts under every condition.
    ///
    /// Each policy and condition is a stage `evaluate` with the subject `[policy, condition]`; its metrics are
    /// `success_rate` with its interval, `success_low` and `success_high`, `successes` and `episodes` (the number of episodes that count).
    ///
    /// # Errors
    /// When the request is invalid or names an unknown environment, dataset, policy or factor, a policy or an
    /// environment fails, or the run is stopped.
    pub fn run(&self, resolver: &dyn Resolver, options: &RunOptions, control: &mut Control<'_>) -> Result<Results> {
        self.run_episodes(Episodes::All, resolver, options, control)
    }

    /// Evaluates as [`EvalRequest::run`], but plays only these episodes. Everything but times is as if all were played at
    /// once.
    #[allow(clippy::too_many_lines, reason = "one loop over conditions and policies, which share all state")]
    pub(crate) fn run_episodes(
        &self,
        episodes: Episodes<'_>,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<Results> {
        self.check()?;
        let request = self.with_floor()?;
        let mut world = request.world(resolver, request.parallel_envs(options), options)?;
        let request = Self { budget: Some(world.pool().max_episode_steps()), ..request };
        let dataset = match &request.starts {
            StartsRequest::Episodic => None,
            StartsRequest::Dataset { dataset, .. } => Some(resolver.dataset(dataset)?),
        };
        let mut manifest = request.manifest()?;
        manifest.libraries = world.libraries();
        if let Some(reader) = &dataset {
            manifest.hashes.insert("dataset".to_owned(), reader.content_hash()?);
        }
        // Checks every factor and makes every policy once, so that what does not exist or does not fit fails before the first
        // episode.
        for condition in &request.conditions {
            world.spec().variation_space.check(&condition.variation)?;
        }
        let mut baselines = Baselines::new(dataset.as_deref(), request.held_out());
        for policy in &request.policies {
            if !baselines.check(&policy.kind, &world)? {
                drop(resolver.policy(policy, &world)?);
            }
        }
        let (mut starts_hash, mut runs) = (StartsHash::default(), vec![]);
        let earlier = if let Episodes::After(earlier) = episodes { Some(earlier) } else { None };
        for condition in &request.conditions {
            let starts = request.starts(dataset.as_deref(), world.pool().env(0), condition.variation.clone())?;
            if let Some((horizon, reader)) = request.prediction.zip(dataset.as_deref()) {
                let picks: Vec<[usize; 2]> = (0..starts.len()).filter_map(|i| starts.pick(i)).collect();
                for policy in &request.policies {
                    let Some(predictor) = resolver.predictor(policy)? else { continue };
                    prediction::check(&*predictor, reader, &picks, horizon)?;
                }
            }
            starts_hash.add(&mut world, &starts)?;
            let starts = match episodes.numbers(starts.len()) {
                Some(numbers) => starts.only(&numbers)?,
                None => starts,
            };
            for policy in &request.policies {
                let mut resolved = match baselines.policy(&policy.kind, &world, &starts)? {
                    Some(baseline) => ResolvedPolicy::from(baseline),
                    None => resolver.policy(policy, &world)?,
                };
                request.record_provenance(&mut manifest, policy, &resolved);
                control.emit(Event::Started(Stage {
                    name: STAGE,
                    subject: &[&policy.name, &condition.name],
                    total: starts.len(),
                    unit: "episodes",
                }));
                let config = request.config(policy, condition, options);
                let predicted = match request.prediction.zip(dataset.as_deref()) {
                    Some(of) => resolver.predictor(policy)?.map(|predictor| (of, predictor)),
                    None => None,
                };
                let recording = |((horizon, _), predictor): &((usize, _), Box<dyn Predictor>)| {
                    PlayedRecording::new(&**predictor, *horizon, world.pool().infos().schema())
                };
                let mut played = predicted.as_ref().map(recording).transpose()?;
                let policy = &mut *resolved.policy;
                let mut run = world.evaluate_recorded(policy, &starts, &config, played.as_mut(), control)?;
                let before = earlier.and_then(|earlier| earlier.runs.get(runs.len()));
                let later = run.clone();
                if let Some(before) = before {
                    run = joined(before, run, request.counting);
                }
                if let Some((((horizon, reader), mut predictor), played)) = predicted.zip(played) {
                    let threads = world.pool().threads();
                    run.prediction = Some(threads.install(|| predict_run(&mut *predictor, reader, &run, horizon))?);
                    let new = threads.install(|| played.predict(&mut *predictor, &later))?;
                    let old = before.and_then(|before| before.played.clone());
                    let known = old.into_iter().flat_map(|old| old.trajectories);
                    run.played = Some(Played { trajectories: known.chain(new.trajectories).collect() });
                }
                run.searches = resolved.searches.as_mut().and_then(|take| Searches::of(&take()));
                control.emit(Event::Finished { stage: STAGE, metrics: &metrics(&run) });
                runs.push(run);
            }
        }
        manifest.hashes.extend(starts_hash.hashes());
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

    /// The world of this evaluation, with `envs` environments.
    pub(crate) fn world(&self, resolver: &dyn Resolver, envs: usize, options: &RunOptions) -> Result<World> {
        let config = WorldConfig {
            envs,
            image: self.image.map(|[height, width]| (height, width)),
            views: vec![],
            max_episode_steps: self.budget,
            threads: options.threads,
        };
        World::of(|| resolver.env(self), config)
    }

    /// The settings of one evaluation.
    pub(crate) fn config(&self, policy: &PolicyRequest, condition: &Condition, options: &RunOptions) -> EvalConfig {
        EvalConfig {
            policy: policy.name.clone(),
            condition: condition.name.clone(),
            budget: self.budget,
            counting: self.counting,
            planning_seed: self.planning_seed,
            videos: options.videos.as_ref().map(|(root, count)| Videos {
                root: root.clone(),
                prefix: format!("videos/{}", file_name(&policy.name, &condition.name)),
                count: *count,
                fps: 15,
                frame_strip: options.frame_strip,
                staged: options.staged,
            }),
        }
    }

    /// This request with the random-policy floor first.
    pub(crate) fn with_floor(&self) -> Result<Self> {
        let mut request = self.clone();
        match self.policies.iter().position(|policy| policy.kind == PolicyKind::Random) {
            Some(index) => {
                let floor = request.policies.remove(index);
                request.policies.insert(0, floor);
            }
            None if self.policies.iter().any(|policy| policy.name == FLOOR) => {
                return Err(Error::config(
                    format!("policy '{FLOOR}'"),
                    "it is not the random policy, for which this name is reserved",
                    "choose another name",
                ));
            }
            None => request.policies.insert(0, PolicyRequest { name: FLOOR.to_owned(), kind: PolicyKind::Random }),
        }
        Ok(request)
    }

    /// The number of environments of the world.
    fn parallel_envs(&self, options: &RunOptions) -> usize {
        match (self.counting, &self.starts) {
            (Counting::Compat { envs }, StartsRequest::Episodic) => envs,
            _ => options.envs.min(self.episodes).max(1),
        }
    }

    /// The starts under a condition.
    pub(crate) fn starts(
        &self,
        dataset: Option<&dyn Reader>,
        env: &dyn Env,
        variation: VariationRequest,
    ) -> Result<Starts> {
        let Some((reader, StartsRequest::Dataset { goal_offset, .. })) = dataset.zip(Some(&self.starts)) else {
            return match self.counting {
                Counting::Strict { .. } => Starts::episodic(self.episodes, self.seed, variation),
                Counting::Compat { .. } => Starts::sequential(self.episodes, self.seed, variation),
            };
        };
        Starts::from_dataset(reader, env, self.picks(reader)?, *goal_offset, self.seed, variation, &[])
    }

    /// The rows of a dataset that are the starts; none if the environment draws them. Those of a request with fewer episodes
    /// are the first of them.
    pub(crate) fn picks(&self, reader: &dyn Reader) -> Result<Vec<[usize; 2]>> {
        let StartsRequest::Dataset { goal_offset, held_out, one_per_episode, .. } = &self.starts else {
            return Ok(vec![]);
        };
        let episodes = match held_out {
            None => (0..reader.episodes().len()).collect(),
            Some(HeldOut { part, split }) => split.episodes(reader, *part)?,
        };
        let choose = if *one_per_episode { Starts::choose_one_per_episode } else { Starts::choose_among };
        choose(reader, &episodes, self.episodes, *goal_offset, self.seed)
    }

    /// The part of a dataset that the starts come from, if there is one.
    fn held_out(&self) -> Option<HeldOut> {
        match self.starts {
            StartsRequest::Dataset { held_out, .. } => held_out,
            StartsRequest::Episodic => None,
        }
    }

    /// Whether results are those of this request, with any number of episodes.
    ///
    /// # Errors
    /// When the results contain no request that this version reads, or this request is invalid.
    pub(crate) fn is_of(&self, results: &Results) -> Result<bool> {
        let (found, requested) = (Self::of(&results.manifest)?, self.with_floor()?);
        // The runner writes the time limit that it used.
        let budget = requested.budget.or(found.budget);
        Ok(found == Self { budget, episodes: found.episodes, ..requested })
    }

    fn manifest(&self) -> Result<Manifest> {
        let config = serde_json::to_value(self).map_err(|e| Error::external("writing an evaluation's request", e))?;
        Ok(Manifest::new("evaluate", self.seed, config))
    }

    /// The name under which the manifest of results has the hash of a policy's weights. The request is that of the
    /// manifest, which lists the random-policy floor.
    pub fn weights_key(&self, policy: &str) -> String {
        // The random-policy floor has no weights, so at most one of two policies has weights.
        if self.policies.len() <= 2 { "weights".to_owned() } else { format!("weights of {policy}") }
    }

    /// Adds the provenance of a policy to the manifest.
    fn record_provenance(&self, manifest: &mut Manifest, policy: &PolicyRequest, resolved: &ResolvedPolicy) {
        if let Some(weights) = &resolved.weights {
            manifest.hashes.insert(self.weights_key(&policy.name), weights.clone());
        }
        if let Some(dataset) = &resolved.probe_dataset {
            manifest.hashes.insert(PROBE_DATASET.to_owned(), dataset.clone());
        }
        // A checkpoint names the libraries of its training; what plays and renders here is known already.
        for (name, version) in resolved.libraries.iter().filter(|(name, _)| *name != "renderer") {
            manifest.libraries.entry(name.clone()).or_insert_with(|| version.clone());
        }
        if let Some(device) = &resolved.device {
            manifest.device.clone_from(device);
        }
    }
}

/// The run of the episodes of two runs, one after the other.
fn joined(earlier: &Run, later: Run, counting: Counting) -> Run {
    let strict = earlier.strict.zip(later.strict);
    let strict = strict.map(|(a, b)| Proportion::wilson(a.successes + b.successes, a.n + b.n));
    let episodes = earlier.episodes.iter().cloned().chain(later.episodes).collect();
    let wall_seconds = earlier.timing.wall_seconds + later.timing.wall_seconds;
    let run = Run::new(&later.condition, &later.policy, counting, episodes, Timing { wall_seconds, ..later.timing });
    Run { strict, videos: earlier.videos.clone(), ..run }
}

/// The summary of a run, for [`Event::Finished`].
fn metrics(run: &Run) -> [(&'static str, f64); 5] {
    let Proportion { successes, n, rate, low, high, .. } = run.success;
    let counts = [successes, n].map(|count| count as f64);
    [
        ("success_rate", rate),
        ("success_low", low),
        ("success_high", high),
        ("successes", counts[0]),
        ("episodes", counts[1]),
    ]
}

/// The names of a policy and of a condition as the name of a file. It has a part of their hash where other names could give the same words.
fn file_name(policy: &str, condition: &str) -> String {
    let words = format!("{}-{}", slug(policy), slug(condition));
    if policy == slug(policy) && condition == Condition::IN_DISTRIBUTION {
        return words;
    }
    let hash = swm_core::manifest::hash(format!("{policy}\0{condition}").as_bytes());
    format!("{words}-{}", &hash[..8])
}

/// A name in the form of a file name: lower-case words joined by hyphens.
fn slug(name: &str) -> String {
    let words: Vec<&str> = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty()).collect();
    words.join("-").to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_files_differ_where_policies_or_conditions_do() {
        assert_eq!(file_name("lewm-rooms", Condition::IN_DISTRIBUTION), "lewm-rooms-in-distribution");
        let names = ["a", "b", "a.b", "a_b", "A", "сеть", "модель", "x-angle"];
        let conditions = [Condition::IN_DISTRIBUTION, "angle=1", "angle=-1", "in-distribution", "b in distribution"];
        let files: std::collections::BTreeSet<String> =
            names.iter().flat_map(|name| conditions.iter().map(|condition| file_name(name, condition))).collect();
        assert_eq!(files.len(), names.len() * conditions.len());
        assert!(files.iter().all(|file| file.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')));
    }
}
