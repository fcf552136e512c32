//! [`PythonObserver`]: reads the iterations of a search in Python.

use crate::arrays;
use crate::errors::attached;
use crate::exit;
use crate::held::Held;
use numpy::{PyArray1, PyArrayMethods as _};
use pyo3::prelude::*;
use std::ops::ControlFlow;
use swm::core::{Iteration, Result, SearchObserver};
use swm::plan::PlanObserver;

/// An observer implemented in Python, with these methods:
///
/// - `iteration(index, candidates, costs, elites, gradient)` returns whether the search ends after this iteration.
///   `candidates` and `gradient` are arrays `[envs, samples, horizon, dim]`, `costs` `[envs, samples]`, `elites` the
///   indices `[envs, elites]`, cheapest first; `elites` and `gradient` are `None` for solvers without them.
/// - `begin(envs)` and `end()` surround every search of a policy.
pub struct PythonObserver(Held<Py<PyAny>>);

impl PythonObserver {
    /// Wraps an object.
    pub fn new(observer: Py<PyAny>) -> Self {
        Self(Held::new(observer))
    }
}

impl SearchObserver for PythonObserver {
    fn iteration(&self, iteration: &Iteration<'_>) -> Result<ControlFlow<()>> {
        let given = &iteration.candidates;
        let shape = [given.envs, given.samples, given.horizon, given.dim];
        let stop = attached(|py| {
            let elites = if iteration.elites.is_empty() {
                None
            } else {
                let indices = iteration.elites.iter().map(|&elite| elite as i64);
                let per_env = iteration.elites.len() / given.envs;
                Some(PyArray1::from_iter(py, indices).reshape([given.envs, per_env])?)
            };
            let gradient = iteration.gradient.map(|gradient| arrays::f32_array(py, gradient, &shape)).transpose()?;
            let (candidates, costs) =
                (arrays::f32_array(py, given.actions, &shape)?, arrays::f32_array(py, iteration.costs, &shape[..2])?);
            let arguments = (iteration.index, candidates, costs, elites, gradient);
            exit::call_method(self.0.bind(py), "iteration", arguments)?.extract::<bool>()
        });
        Ok(if stop? { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

impl PlanObserver for PythonObserver {
    fn begin(&self, slots: &[usize]) -> Result<()> {
        attached(|py| exit::call_method(self.0.bind(py), "begin", (slots.len(),)).map(drop))
    }

    fn end(&self) -> Result<()> {
        attached(|py| exit::call_method(self.0.bind(py), "end", ()).map(drop))
    }
}
