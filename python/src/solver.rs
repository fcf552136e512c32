//! Planning without a world: [`solve`] plans once for every row of a batch of infos.

use crate::arrays;
use crate::cost::PythonCost;
use crate::errors::{json, signal_poll, to_py_err};
use crate::exit;
use crate::model::Model;
use crate::observer::PythonObserver;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde_json::Value;
use std::time::{Duration, Instant};
use swm::core::run::Control;
use swm::core::{Error, Key, PlanProblem, PlanSpace, SearchObserver, Solver};
use swm::plan::{BetweenIterations, MpcConfig, SOLVERS};

/// Runs `work` on the current thread, as a member of a thread pool.
///
/// Python handles signals only in the main thread, so that Ctrl-C interrupts a Python model only there. The other threads of
/// the pool draw candidates.
pub fn on_this_thread<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    thread_local! {
        // The pool is leaked, because it cannot be dropped before its thread ends.
        static POOL: Option<&'static ThreadPool> =
            ThreadPoolBuilder::new().use_current_thread().build().ok().map(|pool| &*Box::leak(Box::new(pool)));
    }
    match POOL.with(|pool| *pool) {
        Some(pool) => pool.install(work),
        None => work(),
    }
}

/// Creates a solver by id, with settings in JSON.
///
/// # Errors
/// For an unknown solver or setting.
pub fn make(solver: &str, settings: &str) -> PyResult<Box<dyn Solver>> {
    let settings: Value = json("solver settings", settings)?;
    (SOLVERS.get(solver).map_err(to_py_err)?.make)(&settings).map_err(to_py_err)
}

/// Checks the sizes of a plan, before Python allocates by them.
///
/// # Errors
/// `ValueError` for a size that [`MpcConfig::check`] refuses.
#[pyfunction]
pub fn check_plan(horizon: usize, action_block: usize, history: usize) -> PyResult<()> {
    let config = MpcConfig { horizon, receding_horizon: 1, action_block, history, ..MpcConfig::default() };
    config.check().map_err(to_py_err)
}

/// Plans for every row of `infos`, with the random key `(seed, call, row)`, or `(seed, episode, plan)` if `plans` has the key of the
/// episode and the number of the plan of each row. Returns the actions, their costs, and the
/// search traces as JSON.
///
/// `low` and `high` are the bounds of the elements of a model step with continuous actions; `choices` holds the number
/// of options of each discrete choice. `observer` reads the iterations: see [`PythonObserver`]. After `budget` seconds, the search stops
/// with its best plan.
///
/// # Shapes
/// `infos`: `[envs, ..]`; `init` and actions: `[envs, horizon, dim]`; costs: `[envs]`.
#[pyfunction]
#[pyo3(signature = (solver, settings, model, infos, envs, horizon, low, high, choices, init, seed, call, plans=None, observer=None, budget=None))]
#[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
pub fn solve<'py>(
    py: Python<'py>,
    solver: &str,
    settings: &str,
    model: &Bound<'py, PyAny>,
    infos: &Bound<'py, PyDict>,
    envs: usize,
    horizon: usize,
    low: Vec<f32>,
    high: Vec<f32>,
    choices: Option<Vec<usize>>,
    init: Option<&Bound<'py, PyAny>>,
    seed: u64,
    call: u64,
    plans: Option<Vec<(u64, u64)>>,
    observer: Option<Py<PyAny>>,
    budget: Option<f64>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>, String)> {
    let _call = exit::Call::begin();
    let budget = budget.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    let deadline = budget.and_then(|budget| Instant::now().checked_add(budget));
    let mut solver = make(solver, settings)?;
    let space = match &choices {
        Some(choices) => PlanSpace::Discrete { choices },
        None => PlanSpace::Continuous { low: &low, high: &high },
    };
    let dim = space.dim();
    let init = init.map(|init| arrays::f32_values("init_action", init, &[envs, horizon, dim])).transpose()?;
    let plans = plans.unwrap_or_else(|| (0..envs).map(|row| (call, row as u64)).collect());
    if plans.len() != envs {
        return Err(PyValueError::new_err(format!(
            "plans: expected {envs} pairs, one for each row, got {}",
            plans.len()
        )));
    }
    // Plans outside of episodes have a key of their own.
    let key = Key::new(seed).with("solve");
    let keys: Vec<Key> = plans.iter().map(|&(first, second)| key.at(first).at(second)).collect();
    let problem = PlanProblem { horizon, space, keys: &keys, init: init.as_deref(), deadline, observer: None };
    let observer = observer.map(PythonObserver::new);
    let observer = observer.as_ref().map(|observer| observer as &dyn SearchObserver);
    let mut control = Control::new().with_poll(signal_poll());
    let plan = if let Ok(model) = model.cast::<Model>() {
        let (mut cost, _) = model.get().cost_model()?;
        let batch = arrays::batch(infos)?;
        exit::detached(py, || {
            cost.observe(&batch, &(0..envs).collect::<Vec<_>>())?;
            control.install(None, |interrupt| {
                let between = BetweenIterations { interrupt: Some(interrupt), observer };
                solver.solve(&mut *cost, PlanProblem { observer: between.observer(), ..problem })
            })
        })
    } else {
        let mut cost = PythonCost::new(model)?;
        exit::call_method(model, "observe", (infos,))?;
        cost.observed(envs);
        exit::detached(py, || {
            control.on_this_thread(|interrupt| {
                let between = BetweenIterations { interrupt: Some(interrupt), observer };
                let problem = PlanProblem { observer: between.observer(), ..problem };
                on_this_thread(|| solver.solve(&mut cost, problem))
            })
        })
    };
    let plan = plan.map_err(to_py_err)?;
    let trace = serde_json::to_string(&plan.trace).map_err(|e| to_py_err(Error::external("writing a trace", e)))?;
    let actions = arrays::f32_array(py, &plan.actions, &[envs, horizon, dim])?;
    Ok((actions, arrays::f32_array(py, &plan.costs, &[envs])?, trace))
}
