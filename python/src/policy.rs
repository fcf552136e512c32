//! [`Actor`]: who acts, as the engine sees it: policies of ours, and of Python's.

use crate::cost::model;
use crate::errors::{foreign, json, raised};
use crate::world::World;
use crate::{arrays, solver};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::sync::{Mutex, MutexGuard, PoisonError};
use swm::core::{Batch, EnvPool, Key, Named as _, Policy, RandomPolicy, Result};
use swm::plan::{ActionScale, MpcConfig, MpcPolicy, TraceLog};

/// Who acts in one world.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Actor {
    policy: Mutex<Box<dyn Policy>>,
    log: Option<TraceLog>,
    /// The hash of the weights behind it.
    pub weights: Option<String>,
}

impl Actor {
    /// The policy, for as long as nobody else uses it.
    pub fn lock(&self) -> PyResult<MutexGuard<'_, Box<dyn Policy>>> {
        Ok(self.policy.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn new(policy: Box<dyn Policy>, seed: Option<u64>) -> Self {
        let policy = match seed {
            Some(seed) => Box::new(Seeded { policy, seed }),
            None => policy,
        };
        Self { policy: Mutex::new(policy), log: None, weights: None }
    }
}

#[pymethods]
impl Actor {
    /// Uniformly at random.
    #[staticmethod]
    fn random(world: &World, seed: Option<u64>) -> PyResult<Self> {
        let world = world.lock()?;
        Ok(Self::new(Box::new(RandomPolicy::new(world.spec(), world.pool().len())), seed))
    }

    /// One of the environment's experts, the first by default.
    #[staticmethod]
    fn expert(world: &World, name: &str, seed: Option<u64>) -> PyResult<Self> {
        let world = world.lock()?;
        let entry = swm::env(&world.spec().id).map_err(raised)?.entry;
        Ok(Self::new(swm::resolver::scripted(&entry, name, &world).map_err(raised)?, seed))
    }

    /// A checkpoint that acts by itself.
    #[staticmethod]
    fn checkpoint(py: Python<'_>, world: &World, name: &str) -> PyResult<Self> {
        let world = world.lock()?;
        let (spec, slots) = (world.spec().clone(), world.pool().len());
        let (policy, card) = py.detach(|| swm::resolver::direct(name, &spec, slots)).map_err(raised)?;
        Ok(Self { weights: Some(card.weights), ..Self::new(policy, None) })
    }

    /// What `call(infos, active, fresh)` returns: `infos` as [`World::infos`] gives them, which slots act, and which of them
    /// begin an episode; it returns an array of actions.
    #[staticmethod]
    fn calling(world: &Bound<'_, World>, call: Py<PyAny>) -> PyResult<Self> {
        let infos = World::infos(world)?.unbind();
        let fresh = vec![false; world.get().lock()?.pool().len()];
        Ok(Self::new(Box::new(Calling { call, infos, fresh }), None))
    }

    /// One that plans in a model: a [`crate::model::Model`], an object of `stable_worldmodel.planning` that adapts one of
    /// Python's, or `None` for the world itself.
    #[staticmethod]
    #[allow(clippy::too_many_arguments)]
    fn planning(
        py: Python<'_>,
        world: &World,
        solver: &str,
        settings: &str,
        mpc: &str,
        scale: Option<(Vec<f32>, Vec<f32>)>,
        given: Option<&Bound<'_, PyAny>>,
        seed: Option<u64>,
    ) -> PyResult<Self> {
        let world = world.lock()?;
        let (spec, slots) = (world.spec().clone(), world.pool().len());
        let mpc: MpcConfig = json("plan", mpc)?;
        let made = solver::made(solver, settings)?;
        let scale = scale.map(|(mean, std)| ActionScale { mean, std });
        let model = model(given, &spec, mpc.action_block)?;
        let scale = scale.or(model.scale).unwrap_or_else(|| ActionScale::unscaled(&spec));
        let mut cost = model.cost;
        let actions = swm::plan::ActionKind::of(&spec.action_space);
        swm::plan::pairing(solver, &mut *cost, actions).map_err(raised)?;
        let log = TraceLog::default();
        let policy = py.detach(|| MpcPolicy::new(made, cost, mpc, scale, &spec, slots)).map_err(raised)?;
        let policy = policy.traced(log.clone());
        let policy: Box<dyn Policy> = if model.python { Box::new(Here(policy)) } else { Box::new(policy) };
        Ok(Self { log: Some(log), weights: model.weights, ..Self::new(policy, seed) })
    }

    /// The plans made since the last call, as JSON.
    fn take_plans(&self) -> String {
        let plans = self.log.as_ref().map(TraceLog::take).unwrap_or_default();
        serde_json::json!(plans).to_string()
    }

    /// Experts of an environment.
    #[staticmethod]
    fn experts(env: &str) -> PyResult<Vec<&'static str>> {
        Ok(swm::env(env).map_err(raised)?.entry.experts.iter().map(|expert| expert.id()).collect())
    }
}

/// A policy with a seed of its own beside the episode's.
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

/// A policy that asks Python: it is asked on the thread that called, where Ctrl-C arrives.
struct Here(MpcPolicy);

impl Policy for Here {
    fn begin(&mut self, slot: usize, key: Key) {
        self.0.begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        solver::here(|| self.0.act(infos, active, actions))
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

/// A policy of Python's.
struct Calling {
    call: Py<PyAny>,
    infos: Py<PyDict>,
    fresh: Vec<bool>,
}

impl Policy for Calling {
    fn begin(&mut self, slot: usize, _key: Key) {
        self.fresh[slot] = true;
    }

    fn act(&mut self, _infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let Self { call, infos, fresh } = self;
        let asked = Python::attach(|py| {
            let infos = infos.bind(py).copy()?;
            let flags = |flags: &[bool]| PyArray1::from_slice(py, flags);
            let given = call.bind(py).call1((infos, flags(active), flags(fresh)))?;
            arrays::fill(actions, 0, &given)
        });
        fresh.fill(false);
        asked.map_err(foreign)
    }

    fn uses_threads(&self) -> bool {
        false
    }
}
