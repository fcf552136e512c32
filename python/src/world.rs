//! [`World`]: a batch of environments with their infos as numpy arrays; collection and evaluation.

use crate::arrays;
use crate::data::foreign::ForeignWriter;
use crate::data::process::Owned;
use crate::errors::{attached, control, from_py_err, json, signal_poll, to_py_err};
use crate::exit;
use crate::gym::{InProcess, is_in_call};
use crate::held::Held;
use crate::policy::Actor;
use crate::snapshots;
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use serde_json::{Map, Value};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, TryLockError};
use swm::collect_target::{self, Existing};
use swm::core::columns::{TERMINATED, TRUNCATED};
use swm::core::pool::Reset;
use swm::core::results::Counting;
use swm::core::run::Control;
use swm::core::{Callable, CameraView, Env, Error, Manifest, Origin, ResetOptions, VariationRequest};
use swm::data::{ImageCodec, Location, WriteMode, WriteOptions};
use swm::envs::wrappers::{GoalFrame, Stack, WRAPPERS};
use swm::eval::{CollectConfig, EvalConfig, PolicyChoice, Starts, Videos, WorldConfig, episode_key, reset_seed};
use swm::gym::GymEnv;

/// What to do about a dataset that exists.
const EXISTS: &str =
    "continue it with mode=\"resume\" or mode=\"append\", replace it with mode=\"overwrite\", or choose another name";

/// A batch of environments of one kind.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct World {
    world: Owned<Mutex<swm::eval::World>>,
    envs: usize,
    /// Whether the environments are Gymnasium environments of this interpreter.
    in_process: bool,
}

/// The stack of visual wrappers of a JSON list of `[id, settings]`, shared by all environments.
///
/// # Errors
/// `ValueError` for an unknown wrapper or setting.
pub fn stack(wrappers: &str, wrap_goal: bool) -> PyResult<(Arc<Stack>, GoalFrame)> {
    let choices: Vec<(String, Map<String, Value>)> = json("wrappers", wrappers)?;
    let made = choices.into_iter().map(|(id, settings)| WRAPPERS.get(&id)?.make(&settings.into_iter().collect()));
    let goal = if wrap_goal { GoalFrame::Wrapped } else { GoalFrame::Clean };
    Ok((Arc::new(Stack::new(made).map_err(to_py_err)?), goal))
}

impl World {
    /// Locks the world of the engine.
    ///
    /// # Errors
    /// If another thread, or a policy of a running call, uses the world, or this process was forked from the one that made
    /// it.
    pub fn lock(&self) -> PyResult<MutexGuard<'_, swm::eval::World>> {
        match self.world.get("world").map_err(to_py_err)?.try_lock() {
            Ok(world) => Ok(world),
            // A reset replaces the state that a panic left in the environments.
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => Err(to_py_err(Error::config(
                "world",
                "another call is using it",
                "wait until that call returns; a policy gets the infos as its argument",
            ))),
        }
    }

    /// Locks the world of the engine to run its environments.
    ///
    /// # Errors
    /// As [`World::lock`], and if another environment of this interpreter calls this: the world's threads would wait for its
    /// end.
    fn lock_to_run(&self) -> PyResult<MutexGuard<'_, swm::eval::World>> {
        let world = self.lock()?;
        if self.in_process && world.pool().threads().current_num_threads() > 1 && is_in_call() {
            let problem = "it is used in the step or reset of another environment of this process, and environments of one \
                           process run one at a time";
            return Err(to_py_err(Error::config("world", problem, "create it with threads=1 or workers=True")));
        }
        Ok(world)
    }
}

#[pymethods]
impl World {
    #[new]
    #[pyo3(signature = (env, envs, image, views, max_episode_steps, threads, wrappers, wrap_goal))]
    #[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
    fn new(
        py: Python<'_>,
        env: String,
        envs: usize,
        image: Option<(usize, usize)>,
        views: Vec<String>,
        max_episode_steps: Option<usize>,
        threads: usize,
        wrappers: &str,
        wrap_goal: bool,
    ) -> PyResult<Self> {
        let (stack, goal) = stack(wrappers, wrap_goal)?;
        let views: swm::core::Result<Vec<CameraView>> = views.iter().map(|text| CameraView::parse(text)).collect();
        let config = WorldConfig { envs, image, views: views.map_err(to_py_err)?, max_episode_steps, threads };
        let world = exit::detached(py, || {
            let chosen = swm::env(&env, &Origin::User)?;
            swm::eval::World::of(|| Ok(stack.wrap(chosen.env()?, goal)), config)
        });
        Ok(Self { world: Owned::new(Mutex::new(world.map_err(to_py_err)?)), envs, in_process: false })
    }

    /// Creates a world of Gymnasium environments in this interpreter. `make()` creates one environment and returns its
    /// `Bridge`.
    #[staticmethod]
    #[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
    fn gymnasium(
        py: Python<'_>,
        id: String,
        make: Py<PyAny>,
        envs: usize,
        image: Option<(usize, usize)>,
        max_episode_steps: Option<usize>,
        threads: usize,
        wrappers: &str,
        wrap_goal: bool,
    ) -> PyResult<Self> {
        let (stack, goal) = stack(wrappers, wrap_goal)?;
        let make = Held::new(make);
        let config = WorldConfig { envs, image, views: vec![], max_episode_steps, threads };
        let world = exit::detached(py, || {
            let made = || -> swm::core::Result<Box<dyn Env>> {
                let make = attached(|py| Ok(make.clone_ref(py)))?;
                Ok(stack.wrap(Box::new(GymEnv::new(&id, Box::new(InProcess::new(make)), 0)?), goal))
            };
            swm::eval::World::of(made, config)
        });
        Ok(Self { world: Owned::new(Mutex::new(world.map_err(to_py_err)?)), envs, in_process: true })
    }

    /// The specification of the environments as JSON.
    fn spec(&self) -> PyResult<String> {
        Ok(swm::describe::spec(self.lock()?.spec()).to_string())
    }

    /// The time limit of an episode, in steps.
    fn max_episode_steps(&self) -> PyResult<usize> {
        Ok(self.lock()?.pool().max_episode_steps())
    }

    /// Returns the infos of the last reset or step as arrays `[envs, 1, ..]`. The arrays share the engine's memory, so
    /// later steps change the arrays.
    pub fn infos<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyDict>> {
        let _call = exit::Call::begin(); // The first array imports numpy.
        let infos = PyDict::new(slf.py());
        let world = slf.get().lock()?;
        let batch = world.pool().infos();
        for (i, column) in batch.schema().columns().iter().enumerate() {
            // SAFETY: the pool never resizes its infos, and lives as long as this object, which the array keeps alive. Only
            // steps and resets write; a thread of Python that reads an array meanwhile may find values of both states.
            #[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
            infos.set_item(&column.name, unsafe { arrays::view(batch, i, true, slf.as_any()) }?)?;
        }
        Ok(infos)
    }

    /// Returns the actions `[envs, ..]` of the next [`World::advance`], which the caller writes.
    fn actions<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let mut world = slf.get().lock()?;
        let batch = world.actions_mut();
        // SAFETY: the world never resizes its actions, and lives as long as this object, which the array keeps alive.
        // Python writes the array, and the engine reads it during a step; its elements are plain numbers.
        #[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
        unsafe {
            arrays::view(batch, 0, false, slf.as_any())
        }
    }

    /// Starts an episode for every `(slot, seed)` of `starts`. `options` is a JSON object with a variation request, a
    /// state and a goal state.
    fn reset(&self, py: Python<'_>, starts: Vec<(usize, u64)>, options: &str) -> PyResult<()> {
        let options = reset_options(options)?;
        if let Some((slot, _)) = starts.iter().find(|(slot, _)| *slot >= self.envs) {
            return Err(PyIndexError::new_err(format!(
                "reset: environment {slot} does not exist, the world has {} environments",
                self.envs
            )));
        }
        let mut world = self.lock_to_run()?;
        let world = &mut *world;
        let resets: Vec<Reset> =
            starts.iter().map(|&(slot, seed)| Reset { slot, seed, options: options.clone() }).collect();
        exit::detached(py, || world.restart(&resets)).map_err(to_py_err)
    }

    /// Begins episode `episode` of `seed` in a slot of the policy. The environment is not reset.
    fn begin(&self, actor: &Actor, slot: usize, seed: u64, episode: usize) -> PyResult<()> {
        actor.lock()?.begin(slot, episode_key(seed, episode));
        Ok(())
    }

    /// Computes the policy's actions for the active slots.
    fn act(&self, py: Python<'_>, actor: &Actor, active: Vec<bool>) -> PyResult<()> {
        let (mut world, mut policy) = (self.lock()?, actor.lock()?);
        let (world, policy) = (&mut *world, &mut **policy);
        let mut control = Control::new().with_poll(signal_poll());
        exit::detached(py, || world.act_until(policy, &active, &mut control)).map_err(to_py_err)
    }

    /// Steps the active slots with the current actions.
    fn advance(&self, py: Python<'_>, active: Vec<bool>) -> PyResult<()> {
        let mut world = self.lock_to_run()?;
        let world = &mut *world;
        exit::detached(py, || world.advance(&active)).map_err(to_py_err)
    }

    /// Plays `steps` steps with a policy. A slot whose episode is over starts the next episode of `seed` instead of a
    /// step. `next` is the index of the first episode to start. Returns the `(slot, episode)` pairs of the started
    /// episodes and the index of the next episode.
    #[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
    fn play(
        &self,
        py: Python<'_>,
        actor: &Actor,
        steps: usize,
        seed: u64,
        mut next: usize,
        options: &str,
    ) -> PyResult<(Vec<(usize, usize)>, usize)> {
        let (mut world, mut policy) = (self.lock_to_run()?, actor.lock()?);
        let (world, policy) = (&mut *world, &mut **policy);
        let mut begun = vec![];
        let mut control = Control::new().with_poll(signal_poll());
        exit::detached(py, || {
            let schema = world.pool().infos().schema();
            let flags = [schema.index(TERMINATED)?, schema.index(TRUNCATED)?];
            let mut active = vec![true; world.pool().len()];
            for _ in 0..steps {
                control.check()?;
                let infos = world.pool().infos();
                for (slot, active) in active.iter_mut().enumerate() {
                    *active = flags.iter().all(|&flag| infos.bytes(flag)[slot] == 0);
                }
                if active.contains(&true) {
                    world.act_until(policy, &active, &mut control)?;
                    world.advance(&active)?;
                }
                if active.contains(&false) {
                    let over = (0..active.len()).filter(|&slot| !active[slot]);
                    let starting: Vec<(usize, usize)> = over.zip(next..).collect();
                    next += starting.len();
                    // The options are parsed here because most calls start no episode.
                    let options = reset_options(options).map_err(from_py_err)?;
                    let reset = |&(slot, episode)| {
                        let seed = reset_seed(episode_key(seed, episode));
                        Reset { slot, seed, options: options.clone() }
                    };
                    world.restart(&starting.iter().map(reset).collect::<Vec<_>>())?;
                    for &(slot, episode) in &starting {
                        policy.begin(slot, episode_key(seed, episode));
                    }
                    begun.extend(starting);
                }
            }
            Ok(())
        })
        .map_err(to_py_err)?;
        Ok((begun, next))
    }

    /// The factors of the current episode of a slot, by key.
    fn factors<'py>(&self, py: Python<'py>, slot: usize) -> PyResult<Bound<'py, PyDict>> {
        factors(py, self.lock()?.pool().env(slot))
    }

    /// The full state of a slot's environment.
    fn snapshot<'py>(&self, py: Python<'py>, slot: usize) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &snapshots::seal(self.lock()?.pool().env(slot).snapshot())))
    }

    /// Restores a snapshot in a slot.
    fn restore(&self, py: Python<'_>, slot: usize, state: Vec<u8>) -> PyResult<()> {
        let mut world = self.lock_to_run()?;
        let world = &mut *world;
        let snapshot = snapshots::unseal(state)?;
        exit::detached(py, || world.modify(&[slot], |_, env| env.restore(&snapshot))).map_err(to_py_err)
    }

    /// Checks that datasets can hold all actions of the environments.
    fn check_storable(&self) -> PyResult<()> {
        swm::data::check_storable(self.lock()?.spec()).map_err(to_py_err)
    }

    /// Collects episodes into a dataset at `path`, or into `writer`, an object with `write_episode`. Returns
    /// `(episodes, added, steps, warning)`; the warning lists the columns with NaN or infinite values, if there are any.
    #[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
    fn collect(
        &self,
        py: Python<'_>,
        actor: &Actor,
        path: Option<String>,
        writer: Option<Py<PyAny>>,
        format: Option<String>,
        mode: &str,
        codec: Option<&str>,
        config: &str,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(usize, usize, usize, Option<String>)> {
        let Collection { episodes, seed, variation, policy: name, action_noise, goal, first, strict_finite, wrappers } =
            json("collection", config)?;
        let mode = match mode {
            "append" => WriteMode::Append,
            "overwrite" => WriteMode::Overwrite,
            _ => WriteMode::Create,
        };
        let codec: ImageCodec = codec.map_or(Ok(ImageCodec::default()), |text| json("codec", text))?;
        let (writer, mut control) = (writer.map(|writer| ForeignWriter::new(writer, 0)), control(progress));
        let (mut world, mut policy) = (self.lock_to_run()?, actor.lock()?);
        let (world, policy) = (&mut *world, &mut **policy);
        let collected = exit::detached(py, || {
            let config =
                CollectConfig { episodes, seed, variation, policy: name, action_noise, goal, first, strict_finite };
            let mut manifest = Manifest { hashes: actor.hashes.clone(), ..world.collect_manifest(&config) };
            manifest.config["codec"] = serde_json::json!(codec);
            manifest.config["wrappers"] = wrappers;
            let schema = world.collect_schema(&config)?;
            let create = |location: &Location, mode, manifest, continues| {
                let manifest = Some(manifest);
                let options =
                    WriteOptions { mode, codec, manifest, exclusive: true, continues, ..WriteOptions::default() };
                match &format {
                    Some(format) => swm::data::FORMATS.get(format)?.create(location, &schema, options),
                    None => swm::data::create(location.clone(), &schema, options),
                }
            };
            let location = match &writer {
                Some(_) => None,
                None => Some(swm::home::target(&path.unwrap_or_default(), format.as_deref())?),
            };
            let existing = location.as_ref().map(|to| collect_target::check(to, mode, &manifest, false, EXISTS));
            let Existing { continues, not_finite } = existing.transpose()?.unwrap_or_default();
            manifest.not_finite = not_finite;
            let writer: Box<dyn swm::data::Writer> = match (writer, &location) {
                (Some(writer), _) => Box::new(writer),
                (None, Some(location)) => create(location, mode, manifest.clone(), continues)?,
                (None, None) => return Err(Error::config("World.collect", "no target is given", "give a path")),
            };
            let collected = world.collect(policy, writer, &config, &mut control);
            let warning = collect_target::describe_not_finite(world.not_finite());
            if let (Some(_), Some(location)) = (&warning, &location) {
                collect_target::add_not_finite(&mut manifest, world.not_finite());
                create(location, WriteMode::Append, manifest, None)?.finish()?;
            }
            Ok((collected?, warning))
        });
        let (collected, warning) = collected.map_err(to_py_err)?;
        Ok((collected.episodes, collected.added, collected.steps, warning))
    }

    /// Evaluates a policy and returns the run as JSON.
    fn evaluate(
        &self,
        py: Python<'_>,
        actor: &Actor,
        config: &str,
        dataset: Option<String>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<String> {
        let settings: Evaluation = json("evaluation", config)?;
        let mut control = control(progress);
        let (mut world, mut policy) = (self.lock_to_run()?, actor.lock()?);
        let (world, policy) = (&mut *world, &mut **policy);
        let run = exit::detached(py, || {
            let starts = match dataset {
                Some(dataset) => {
                    let reader = swm::home::open_dataset(&dataset)?;
                    let picks = match settings.picks {
                        Some(picks) => picks,
                        None => Starts::choose(&*reader, settings.episodes, settings.goal_offset, settings.seed)?,
                    };
                    let (env, offset) = (world.pool().env(0), settings.goal_offset);
                    let calls = &settings.callables;
                    Starts::from_dataset(&*reader, env, picks, offset, settings.seed, settings.variation, calls)?
                }
                None if matches!(settings.counting, Counting::Compat { .. }) => {
                    Starts::sequential(settings.episodes, settings.seed, settings.variation)?
                }
                None => Starts::episodic(settings.episodes, settings.seed, settings.variation)?,
            };
            let videos = settings.videos.map(|(root, prefix, count)| Videos {
                root,
                prefix,
                count,
                fps: 15,
                frame_strip: None,
                staged: false,
            });
            let config = EvalConfig {
                policy: settings.policy,
                condition: settings.condition,
                budget: settings.budget,
                counting: settings.counting,
                planning_seed: None,
                videos,
            };
            world.evaluate(policy, &starts, &config, &mut control)
        });
        serde_json::to_string(&run.map_err(to_py_err)?)
            .map_err(|error| to_py_err(Error::external("writing the run as JSON", error)))
    }

    /// The libraries that determine states and frames, with their versions, as JSON.
    fn libraries(&self) -> PyResult<String> {
        Ok(Value::from_iter(self.lock()?.libraries()).to_string())
    }

    /// The number of episodes stored at a path; `None` if there is no dataset.
    #[staticmethod]
    fn stored(py: Python<'_>, path: &str, format: Option<&str>) -> PyResult<Option<usize>> {
        let stored = exit::detached(py, || {
            let location = swm::home::target(path, format)?;
            if location.path().is_some_and(|path| !path.exists()) {
                return Ok(None);
            }
            swm::data::recover(&location)?;
            Ok(Some(swm::data::open(location)?.episodes().len()))
        });
        stored.map_err(to_py_err)
    }

    /// The key of an episode, on which the random draws of policies depend.
    #[staticmethod]
    fn episode_key(seed: u64, episode: usize) -> u64 {
        episode_key(seed, episode).seed()
    }

    /// The seed of the environment's reset at the start of an episode.
    #[staticmethod]
    fn episode_seed(seed: u64, episode: usize) -> u64 {
        reset_seed(episode_key(seed, episode))
    }
}

/// The settings of a collection, from JSON.
#[derive(serde::Deserialize)]
struct Collection {
    episodes: usize,
    seed: u64,
    variation: VariationRequest,
    policy: PolicyChoice,
    action_noise: f64,
    goal: bool,
    first: usize,
    strict_finite: bool,
    wrappers: Value,
}

/// The settings of an evaluation, from JSON.
#[derive(serde::Deserialize)]
struct Evaluation {
    episodes: usize,
    seed: u64,
    variation: VariationRequest,
    policy: String,
    condition: String,
    budget: Option<usize>,
    counting: Counting,
    picks: Option<Vec<[usize; 2]>>,
    goal_offset: usize,
    callables: Vec<Callable>,
    videos: Option<(PathBuf, String, usize)>,
}

/// Parses the options of a reset from JSON.
///
/// # Errors
/// `ValueError` if the JSON is not valid.
pub fn reset_options(text: &str) -> PyResult<ResetOptions> {
    #[derive(serde::Deserialize)]
    struct Given {
        variation: VariationRequest,
        state: Option<Vec<f64>>,
        goal_state: Option<Vec<f64>>,
    }
    let Given { variation, state, goal_state } = json("options", text)?;
    Ok(ResetOptions { variation, state, goal_state })
}

/// Returns the factors of the current episode by key, each as a list of floats.
pub fn factors<'py>(py: Python<'py>, env: &dyn Env) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (key, value) in env.factors().iter() {
        dict.set_item(key, value.to_vec())?;
    }
    Ok(dict)
}
