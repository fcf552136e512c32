//! [`Actor`]: a policy bound to a world, implemented in the engine or in Python.

use crate::cost::planning_model;
use crate::errors::{attached, json, to_py_err};
use crate::exit;
use crate::held::Held;
use crate::model::Model;
use crate::observer::PythonObserver;
use crate::world::World;
use crate::{arrays, solver};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use swm::core::run::Interrupt;
use swm::core::{Batch, EnvPool, Key, Named as _, Policy, RandomPolicy, Result};
use swm::eval::PolicyChoice;
use swm::plan::{ActionScale, MpcConfig, MpcPolicy, TraceLog};

/// The name under which a manifest has the hash of a policy's weights.
const POLICY: &str = "policy";

/// A policy for the environments of one world.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Actor {
    policy: Mutex<Box<dyn Policy>>,
    log: Option<TraceLog>,
    /// The hashes of the weights of checkpoints, as a manifest stores them.
    pub hashes: BTreeMap<String, String>,
}

impl Actor {
    /// Locks the policy.
    pub fn lock(&self) -> PyResult<MutexGuard<'_, Box<dyn Policy>>> {
        Ok(self.policy.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn new(policy: Box<dyn Policy>, seed: Option<u64>) -> Self {
        let policy = match seed {
            Some(seed) => Box::new(Seeded { policy, seed }),
            None => policy,
        };
        Self { policy: Mutex::new(policy), log: None, hashes: BTreeMap::new() }
    }
}

#[pymethods]
impl Actor {
    /// Creates the policy that samples actions uniformly.
    #[staticmethod]
    fn random(world: &World, seed: Option<u64>) -> PyResult<Self> {
        let world = world.lock()?;
        Ok(Self::new(Box::new(RandomPolicy::new(world.spec(), world.pool().len())), seed))
    }

    /// Creates the environment's expert with this name.
    #[staticmethod]
    fn expert(world: &World, name: &str, seed: Option<u64>) -> PyResult<Self> {
        let world = world.lock()?;
        let entry = swm::env(&world.spec().id, &swm::core::Origin::User).map_err(to_py_err)?.entry;
        let (policy, weights) = swm::resolver::expert(&entry, name, &world).map_err(to_py_err)?;
        Ok(Self { hashes: hash_of(weights), ..Self::new(policy, seed) })
    }

    /// The hash of the weights of the checkpoint that acts or plans; `None` for other policies.
    #[getter]
    fn weights(&self) -> Option<&str> {
        self.hashes.get(POLICY).map(String::as_str)
    }

    /// Creates the policy of a checkpoint.
    #[staticmethod]
    fn checkpoint(py: Python<'_>, world: &World, name: &str) -> PyResult<Self> {
        let world = world.lock()?;
        let (spec, slots) = (world.spec().clone(), world.pool().len());
        let (policy, info) =
            exit::detached(py, || swm::resolver::checkpoint_policy(name, &spec, slots)).map_err(to_py_err)?;
        Ok(Self { hashes: hash_of(Some(info.weights)), ..Self::new(policy, None) })
    }

    /// Creates the policy of a loaded checkpoint.
    #[staticmethod]
    fn model(py: Python<'_>, world: &World, model: &Model) -> PyResult<Self> {
        let world = world.lock()?;
        let (spec, slots) = (world.spec().clone(), world.pool().len());
        let made = exit::detached(py, || swm::resolver::direct(&*model.load()?, &model.name(), &spec, slots));
        let (policy, info) = made.map_err(to_py_err)?;
        Ok(Self { hashes: hash_of(Some(info.weights)), ..Self::new(policy, None) })
    }

    /// Creates the mixture of policies that a [`PolicyChoice`] describes in JSON.
    #[staticmethod]
    fn mixture(py: Python<'_>, world: &World, choice: &str) -> PyResult<Self> {
        let choice: PolicyChoice = json("policy", choice)?;
        let mut world = world.lock()?;
        let world = &mut *world;
        let made = exit::detached(py, move || {
            let entry = swm::env(&world.spec().id, &swm::core::Origin::User)?.entry;
            swm::resolver::policy_of_choice(&entry, &choice, world)
        });
        let (policy, hashes) = made.map_err(to_py_err)?;
        Ok(Self { hashes, ..Self::new(policy, None) })
    }

    /// Creates a policy implemented in Python: `call(infos, active, fresh, episodes)` returns an array of actions. `infos` is a
    /// copy of the dict of [`World::infos`]; `active` marks the slots that act, `fresh` the slots with a new episode; `episodes` are
    /// the keys of their episodes, as of [`World::episode_key`].
    #[staticmethod]
    fn python(world: &Bound<'_, World>, call: Py<PyAny>) -> PyResult<Self> {
        let infos = World::infos(world)?.unbind();
        let slots = world.get().lock()?.pool().len();
        let (fresh, episodes) = (vec![false; slots], vec![0; slots]);
        Ok(Self::new(Box::new(PythonPolicy { call: Held::new(call), infos: Held::new(infos), fresh, episodes }), None))
    }

    /// Creates a planning policy. `model` is a [`crate::model::Model`], an adapter of `stable_worldmodel.planning`, or
    /// `None` for the simulator. `observer` reads the iterations of its searches: see [`PythonObserver`].
    #[staticmethod]
    #[pyo3(signature = (world, solver, settings, mpc, scale, model, seed, observer=None))]
    #[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
    fn planning(
        py: Python<'_>,
        world: &World,
        solver: &str,
        settings: &str,
        mpc: &str,
        scale: Option<(Vec<f32>, Vec<f32>)>,
        model: Option<&Bound<'_, PyAny>>,
        seed: Option<u64>,
        observer: Option<Py<PyAny>>,
    ) -> PyResult<Self> {
        let world = world.lock()?;
        let (spec, slots) = (world.spec().clone(), world.pool().len());
        let mpc: MpcConfig = json("plan", mpc)?;
        let search = solver::make(solver, settings)?;
        let scale = scale.map(|(mean, std)| ActionScale { mean, std });
        let model = planning_model(model, &spec, mpc.action_block)?;
        let scale = scale.or(model.scale).unwrap_or_else(|| ActionScale::unscaled(&spec));
        let mut cost = model.cost;
        let actions = swm::plan::ActionKind::of(&spec.action_space);
        swm::plan::pairing(solver, &mut *cost, actions).map_err(to_py_err)?;
        let log = TraceLog::default();
        let policy =
            exit::detached(py, || MpcPolicy::new(search, cost, mpc, scale, &spec, slots)).map_err(to_py_err)?;
        let policy = policy.traced(log.clone());
        let policy = match observer {
            Some(observer) => policy.observed(Box::new(PythonObserver::new(observer))),
            None => policy,
        };
        let policy: Box<dyn Policy> = if model.python { Box::new(OnThisThread(policy)) } else { Box::new(policy) };
        Ok(Self { log: Some(log), hashes: hash_of(model.weights), ..Self::new(policy, seed) })
    }

    /// Returns and clears the records of the plans since the last call, as JSON.
    fn take_plans(&self) -> String {
        let plans = self.log.as_ref().map(TraceLog::take).unwrap_or_default();
        serde_json::json!(plans).to_string()
    }

    /// The names of an environment's experts.
    #[staticmethod]
    fn experts(env: &str) -> PyResult<Vec<&'static str>> {
        let choice = swm::env(env, &swm::core::Origin::User).map_err(to_py_err)?;
        let trained = swm::zoo::trained_expert(&choice.entry, &choice.id(), "expert");
        let scripted = choice.entry.experts.iter().map(|expert| expert.id());
        Ok(scripted.chain(trained.map(|_| "expert")).collect())
    }
}

/// Returns the hashes of a policy with these weights.
fn hash_of(weights: Option<String>) -> BTreeMap<String, String> {
    weights.map(|weights| (POLICY.to_owned(), weights)).into_iter().collect()
}

/// A policy whose random stream depends on a seed in addition to the episode's key.
struct Seeded {
    policy: Box<dyn Policy>,
    seed: u64,
}

impl Policy for Seeded {
    fn begin(&mut self, slot: usize, key: Key) {
        self.policy.begin(slot, key.with("policy seed").at(self.seed));
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        self.policy.act(infos, active, actions)
    }

    fn act_until(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        interrupt: &dyn Interrupt,
    ) -> Result<()> {
        self.policy.act_until(infos, active, actions, interrupt)
    }

    fn observe_envs(&mut self, envs: &EnvPool, active: &[bool]) -> Result<()> {
        self.policy.observe_envs(envs, active)
    }

    fn uses_threads(&self) -> bool {
        self.policy.uses_threads()
    }

    fn take_latencies(&mut self) -> Vec<f64> {
        self.policy.take_latencies()
    }
}

/// A planning policy that calls a Python model on the current thread: see [`solver::on_this_thread`].
struct OnThisThread(MpcPolicy);

impl Policy for OnThisThread {
    fn begin(&mut self, slot: usize, key: Key) {
        self.0.begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        solver::on_this_thread(|| self.0.act(infos, active, actions))
    }

    fn act_until(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        interrupt: &dyn Interrupt,
    ) -> Result<()> {
        solver::on_this_thread(|| self.0.act_until(infos, active, actions, interrupt))
    }

    fn observe_envs(&mut self, envs: &EnvPool, active: &[bool]) -> Result<()> {
        self.0.observe_envs(envs, active)
    }

    fn uses_threads(&self) -> bool {
        false
    }

    fn take_latencies(&mut self) -> Vec<f64> {
        self.0.take_latencies()
    }
}

/// A policy implemented in Python.
struct PythonPolicy {
    call: Held<Py<PyAny>>,
    infos: Held<Py<PyDict>>,
    fresh: Vec<bool>,
    episodes: Vec<u64>,
}

impl Policy for PythonPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        self.fresh[slot] = true;
        self.episodes[slot] = key.seed();
    }

    fn act(&mut self, _infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let Self { call, infos, fresh, episodes } = self;
        let called = attached(|py| {
            // Copies: a policy that changes its observation must not change what the engine stores.
            let given = PyDict::new(py);
            for (name, column) in infos.bind(py) {
                given.set_item(name, column.call_method0("copy")?)?;
            }
            let infos = given;
            let flags = |flags: &[bool]| PyArray1::from_slice(py, flags);
            let given =
                exit::call(call.bind(py), (infos, flags(active), flags(fresh), PyArray1::from_slice(py, episodes)))?;
            arrays::fill(actions, 0, &given)
        });
        fresh.fill(false);
        called
    }

    fn uses_threads(&self) -> bool {
        false
    }
}
