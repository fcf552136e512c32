//! Planning outside of worlds: one problem for every environment of some infos.

use crate::arrays;
use crate::cost::PythonCost;
use crate::errors::{json, raised};
use crate::model::Model;
use crate::world::plan_key;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde_json::Value;
use swm::core::{Error, Key, PlanProblem, PlanSpace, Solver};
use swm::plan::SOLVERS;

/// Works with this very thread as one of a pool's. Solvers ask a model from whichever thread of the pool they work on, and
/// Python hands its signals to the main thread only: so a model of Python's is asked where Ctrl-C arrives.
pub fn here<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    thread_local! {
        // A pool that this thread belongs to cannot end before it does.
        static POOL: Option<&'static ThreadPool> =
            ThreadPoolBuilder::new().use_current_thread().build().ok().map(|pool| &*Box::leak(Box::new(pool)));
    }
    match POOL.with(|pool| *pool) {
        Some(pool) => pool.install(work),
        None => work(),
    }
}

/// A solver with these settings, JSON.
pub fn made(solver: &str, settings: &str) -> PyResult<Box<dyn Solver>> {
    let settings: Value = json("solver settings", settings)?;
    (SOLVERS.get(solver).map_err(raised)?.make)(&settings).map_err(raised)
}

/// Plans for every row of `infos`, with the key `(seed, number, row)`. `low` and `high` bound the numbers of a model step, or
/// `choices` are its choices; `init` is `[envs, horizon, dim]`. Returns actions `[envs, horizon, dim]`, their costs and how
/// the searches went, as JSON.
#[pyfunction]
#[pyo3(signature = (solver, settings, model, infos, envs, horizon, low, high, choices, init, seed, number))]
#[allow(clippy::too_many_arguments)]
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
    number: u64,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>, String)> {
    let mut solver = made(solver, settings)?;
    let space = match &choices {
        Some(choices) => PlanSpace::Discrete { choices },
        None => PlanSpace::Continuous { low: &low, high: &high },
    };
    let dim = space.dim();
    let init = init.map(|init| arrays::numbers("init_action", init, &[envs, horizon, dim])).transpose()?;
    let keys: Vec<Key> = (0..envs).map(|row| plan_key(seed).at(number).at(row as u64)).collect();
    let problem = PlanProblem { horizon, space, keys: &keys, init: init.as_deref(), deadline: None };
    let plan = if let Ok(model) = model.cast::<Model>() {
        let (mut cost, _) = model.get().planned()?;
        let batch = arrays::batch(infos)?;
        py.detach(|| {
            cost.observe(&batch, &(0..envs).collect::<Vec<_>>())?;
            solver.solve(&mut *cost, problem)
        })
    } else {
        let mut cost = PythonCost::new(model)?;
        model.call_method1("observe", (infos,))?;
        cost.observed(envs);
        py.detach(|| here(|| solver.solve(&mut cost, problem)))
    };
    let plan = plan.map_err(raised)?;
    let trace = serde_json::to_string(&plan.trace).map_err(|e| raised(Error::external("writing a trace", e)))?;
    let actions = arrays::floats(py, &plan.actions, &[envs, horizon, dim])?;
    Ok((actions, arrays::floats(py, &plan.costs, &[envs])?, trace))
}
