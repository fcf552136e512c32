//! Running an [`EvalRequest`]: every policy, the random floor first, on the same starts, condition by condition.

use crate::prediction::{Predictor, predict_run};
use crate::request::{Acts, EvalRequest, HeldOut, PolicyRequest, StartsRequest};
use crate::witness::Witness;
use crate::{EvalConfig, Starts, Videos, World, WorldConfig};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use swm_core::results::{Comparison, Counting, Run, Searches};
use swm_core::run::{Control, Event, Progress};
use swm_core::{Env, Error, Manifest, PlanTrace, Policy, RandomPolicy, Result, Results, VariationRequest};
use swm_data::Reader;

/// What the floor is called in results.
const FLOOR: &str = "random";

/// Knows the things that a request names.
pub trait Resolver {
    /// One environment of the request, its wrappers around it.
    ///
    /// # Errors
    /// When there is no such environment or wrapper.
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>>;

    /// A dataset by its name or path.
    ///
    /// # Errors
    /// When there is none, or it is damaged.
    fn dataset(&self, name: &str) -> Result<Arc<dyn Reader>>;

    /// A policy for all environments of a world. The random floor is made without asking.
    ///
    /// # Errors
    /// When what it names is not there or does not fit the world.
    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<Actor>;

    /// The model of a policy, to look at its predictions; none where it has no model or shows none.
    ///
    /// # Errors
    /// As [`Resolver::policy`].
    fn predictor(&self, _request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        Ok(None)
    }
}

/// A policy, and where it came from.
pub struct Actor {
    /// The policy.
    pub policy: Box<dyn Policy>,
    /// The hash of its weights, if it has any.
    pub weights: Option<String>,
    /// Versions of the libraries that decide its actions.
    pub libraries: BTreeMap<String, String>,
    /// Where it computes, such as `cpu (flex)`, if not like everything else.
    pub device: Option<String>,
    /// Gives the searches of all plans since it was last called, where they are traced.
    #[allow(clippy::type_complexity)]
    pub searches: Option<Box<dyn FnMut() -> Vec<PlanTrace>>>,
}

impl From<Box<dyn Policy>> for Actor {
    fn from(policy: Box<dyn Policy>) -> Self {
        Self { policy, weights: None, libraries: BTreeMap::new(), device: None, searches: None }
    }
}

/// What an evaluation runs on, and what is wanted of it besides results: nothing that decides a number.
#[derive(Clone, Debug, Default)]
pub struct Means {
    /// Environments played, and planned for, at the same time. Compat counting of episodic starts names its own number.
    pub envs: usize,
    /// Worker threads; as many as the machine offers for 0.
    pub threads: usize,
    /// Films of the first episodes of every run: the folder of the results file, and how many.
    pub videos: Option<(PathBuf, usize)>,
    /// Set by somebody (Ctrl-C) to stop.
    pub stop: Option<Arc<AtomicBool>>,
}

/// How far an evaluation is.
#[derive(Debug)]
pub enum Moment<'a> {
    /// A policy begins under a condition.
    Begins {
        /// The policy.
        policy: &'a str,
        /// The condition.
        condition: &'a str,
    },
    /// Another episode is done.
    Progress(Progress<'a>),
    /// All are.
    Ends(&'a Run),
}

impl EvalRequest {
    /// Evaluates every policy, and the random floor, from the same starts under every condition. `watch` is told how far
    /// it is.
    ///
    /// # Errors
    /// When the request contradicts itself or names what is not there, a policy or an environment fails, or the run is
    /// stopped.
    pub fn run(
        &self,
        resolver: &dyn Resolver,
        means: &Means,
        watch: &mut (dyn FnMut(Moment<'_>) + Send),
    ) -> Result<Results> {
        self.check()?;
        let request = self.with_floor()?;
        let mut world = World::of(
            || resolver.env(&request),
            WorldConfig {
                envs: request.side_by_side(means),
                image: request.image.map(|[height, width]| (height, width)),
                views: vec![],
                max_episode_steps: request.budget,
                threads: means.threads,
            },
        )?;
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
        // What is not there or does not fit is found before anything is played.
        for policy in request.policies.iter().filter(|policy| policy.acts != Acts::Random) {
            resolver.policy(policy, &world)?;
        }
        let (mut witness, mut runs) = (Witness::default(), vec![]);
        for condition in &request.conditions {
            let starts = request.starts(dataset.as_deref(), world.pool().env(0), condition.variation.clone())?;
            witness.note(&mut world, &starts)?;
            for policy in &request.policies {
                let mut actor = match policy.acts {
                    Acts::Random => Actor::from(floor(&world)),
                    _ => resolver.policy(policy, &world)?,
                };
                request.credit(&mut manifest, policy, &actor);
                watch(Moment::Begins { policy: &policy.name, condition: &condition.name });
                let config = EvalConfig {
                    policy: policy.name.clone(),
                    condition: condition.name.clone(),
                    budget: request.budget,
                    counting: request.counting,
                    videos: means.videos.as_ref().map(|(root, count)| Videos {
                        root: root.clone(),
                        prefix: format!("videos/{}-{}", slug(&policy.name), slug(&condition.name)),
                        count: *count,
                        fps: 15,
                    }),
                };
                let mut control = Control::new().with_events(|event| {
                    if let Event::Progress(at) = event {
                        watch(Moment::Progress(at));
                    }
                });
                if let Some(stop) = &means.stop {
                    control = control.with_interrupt(Arc::clone(stop));
                }
                let mut run = world.evaluate(&mut *actor.policy, &starts, &config, &mut control)?;
                drop(control);
                if let Some((horizon, reader)) = request.prediction.zip(dataset.as_deref())
                    && let Some(mut predictor) = resolver.predictor(policy)?
                {
                    let threads = world.pool().threads();
                    run.prediction = Some(threads.install(|| predict_run(&mut *predictor, reader, &run, horizon))?);
                }
                run.searches = actor.searches.as_mut().and_then(|traces| Searches::of(&traces()));
                watch(Moment::Ends(&run));
                runs.push(run);
            }
        }
        manifest.hashes.extend(witness.hashes());
        Ok(Results {
            manifest,
            env: request.env.clone(),
            protocol: request.protocol().to_owned(),
            counting: request.counting,
            comparisons: Comparison::all(&runs, request.counting),
            runs,
        })
    }

    /// The same with the floor first.
    fn with_floor(&self) -> Result<Self> {
        let mut request = self.clone();
        match self.policies.iter().position(|policy| policy.acts == Acts::Random) {
            Some(place) => {
                let floor = request.policies.remove(place);
                request.policies.insert(0, floor);
            }
            None if self.policies.iter().any(|policy| policy.name == FLOOR) => {
                return Err(Error::config(
                    format!("policy '{FLOOR}'"),
                    "it does not act at random, and the random floor goes by that name",
                    "name it otherwise",
                ));
            }
            None => request.policies.insert(0, PolicyRequest { name: FLOOR.to_owned(), acts: Acts::Random }),
        }
        Ok(request)
    }

    /// Environments of the world.
    fn side_by_side(&self, means: &Means) -> usize {
        match (self.counting, &self.starts) {
            (Counting::Compat { envs }, StartsRequest::Episodic) => envs,
            _ => means.envs.min(self.episodes).max(1),
        }
    }

    /// From where to play under a condition.
    fn starts(&self, dataset: Option<&dyn Reader>, env: &dyn Env, variation: VariationRequest) -> Result<Starts> {
        let Some((reader, StartsRequest::Dataset { goal_offset, held_out, .. })) = dataset.zip(Some(&self.starts))
        else {
            return match self.counting {
                Counting::Strict { .. } => Starts::episodic(self.episodes, self.seed, variation),
                Counting::Compat { .. } => Starts::sequential(self.episodes, self.seed, variation),
            };
        };
        let (n, seed) = (self.episodes, self.seed);
        let picks = match held_out {
            None => Starts::choose(reader, n, *goal_offset, seed)?,
            Some(HeldOut { part, split }) => {
                Starts::choose_among(reader, &split.episodes(reader, *part)?, n, *goal_offset, seed)?
            }
        };
        Starts::from_dataset(reader, env, picks, *goal_offset, seed, variation, &[])
    }

    fn manifest(&self) -> Result<Manifest> {
        let config = serde_json::to_value(self).map_err(|e| Error::external("writing an evaluation's request", e))?;
        Ok(Manifest::new("evaluate", self.seed, config))
    }

    /// Notes where a policy came from.
    fn credit(&self, manifest: &mut Manifest, policy: &PolicyRequest, actor: &Actor) {
        if let Some(weights) = &actor.weights {
            // The floor is one of them.
            let alone = self.policies.len() <= 2;
            let what = if alone { "weights".to_owned() } else { format!("weights of {}", policy.name) };
            manifest.hashes.insert(what, weights.clone());
        }
        manifest.libraries.extend(actor.libraries.clone());
        if let Some(device) = &actor.device {
            manifest.device.clone_from(device);
        }
    }
}

fn floor(world: &World) -> Box<dyn Policy> {
    Box::new(RandomPolicy::new(world.spec(), world.pool().len()))
}

/// A name as part of a file name.
fn slug(name: &str) -> String {
    let words: Vec<&str> = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty()).collect();
    words.join("-").to_lowercase()
}
