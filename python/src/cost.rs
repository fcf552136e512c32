//! [`PythonCost`]: a model of Python's as a [`CostModel`], through an object that adapts it (`stable_worldmodel.planning`).

use crate::arrays;
use crate::errors::{foreign, raised};
use crate::model::Model;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::cell::RefCell;
use swm::core::{
    Batch, Candidates, Constrained, CostModel, DifferentiableCost, EnvSpec, Error, LatentDynamics, Result,
};
use swm::plan::{ActionScale, Score, SimulatorCost};

/// What to plan in.
pub struct Planned {
    pub cost: Box<dyn CostModel>,
    /// What the model means by an action; none where it says nothing.
    pub scale: Option<ActionScale>,
    pub weights: Option<String>,
    /// Whether Python is asked.
    pub python: bool,
}

/// What somebody gave as a model: one of ours, an adapted one of Python's, or nothing for the world itself.
pub fn model(given: Option<&Bound<'_, PyAny>>, spec: &EnvSpec, action_block: usize) -> PyResult<Planned> {
    let Some(given) = given else {
        let env = swm::env(&spec.id).map_err(raised)?;
        let scale = ActionScale::unscaled(spec);
        let cost = SimulatorCost::new(move || env.env(), scale.clone(), action_block, Score::default());
        return Ok(Planned { cost: Box::new(cost.map_err(raised)?), scale: Some(scale), weights: None, python: false });
    };
    if let Ok(model) = given.cast::<Model>() {
        let model = model.get();
        let (cost, scale) = model.planned()?;
        return Ok(Planned { cost, scale: Some(scale), weights: Some(model.weights.clone()), python: false });
    }
    let cost = Box::new(PythonCost::new(given)?);
    Ok(Planned { cost, scale: None, weights: None, python: true })
}

/// A model of Python's.
pub struct PythonCost {
    /// It has `observe(infos, envs)`, `cost(candidates)`, and where it says so `cost_and_gradient`, `encode`, `predict`,
    /// `predict_vjp`, `constrain`, `constrain_vjp`: all of numpy arrays.
    adapter: Py<PyAny>,
    gradient: bool,
    latent: Option<usize>,
    constrained: bool,
    /// Environments that were observed last.
    envs: usize,
    /// What went wrong where a trait lends no place for an error; the next question is answered by it.
    failed: RefCell<Option<Error>>,
}

impl PythonCost {
    pub fn new(adapter: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self {
            gradient: adapter.getattr("has_gradient")?.extract()?,
            latent: adapter.getattr("latent_dim")?.extract()?,
            constrained: adapter.getattr("has_constraints")?.extract()?,
            adapter: adapter.clone().unbind(),
            envs: 0,
            failed: RefCell::new(None),
        })
    }

    /// Notes that the adapter has observed so many environments already.
    pub fn observed(&mut self, envs: usize) {
        self.envs = envs;
    }

    /// Calls a method of the adapter.
    fn ask<T>(&self, work: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<T>) -> Result<T> {
        if let Some(error) = self.failed.take() {
            return Err(error);
        }
        Python::attach(|py| work(self.adapter.bind(py))).map_err(foreign)
    }
}

/// Candidates as an array `[envs, samples, horizon, dim]`.
fn candidates<'py>(py: Python<'py>, given: Candidates<'_>) -> PyResult<Bound<'py, PyAny>> {
    arrays::floats(py, given.actions, &[given.envs, given.samples, given.horizon, given.dim])
}

impl CostModel for PythonCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.envs = envs.len();
        self.ask(|adapter| {
            let py = adapter.py();
            let dict = PyDict::new(py);
            for (i, column) in infos.schema().columns().iter().enumerate() {
                dict.set_item(&column.name, arrays::copied(py, infos, i, envs)?)?;
            }
            adapter.call_method1("observe", (dict,)).map(drop)
        })
    }

    fn cost(&mut self, given: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.ask(|adapter| {
            let returned = adapter.call_method1("cost", (candidates(adapter.py(), given)?,))?;
            let shape = [given.envs, given.samples];
            costs.copy_from_slice(&arrays::numbers("the costs that the model returned", &returned, &shape)?);
            Ok(())
        })
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        self.gradient.then_some(self as _)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        self.latent.is_some().then_some(self as _)
    }

    fn constrained(&mut self) -> Option<&mut dyn Constrained> {
        self.constrained.then_some(self as _)
    }
}

impl DifferentiableCost for PythonCost {
    fn cost_and_gradient(&mut self, given: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.ask(|adapter| {
            let shape = [given.envs, given.samples, given.horizon, given.dim];
            let returned = adapter.call_method1("cost_and_gradient", (candidates(adapter.py(), given)?,))?;
            let (cost, slope): (Bound<'_, PyAny>, Bound<'_, PyAny>) = returned.extract()?;
            costs.copy_from_slice(&arrays::numbers("the costs that the model returned", &cost, &shape[..2])?);
            gradient.copy_from_slice(&arrays::numbers("the gradient of the model's costs", &slope, &shape)?);
            Ok(())
        })
    }
}

impl LatentDynamics for PythonCost {
    fn latent_dim(&self) -> usize {
        self.latent.unwrap_or(0)
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        let shape = [self.envs, self.latent_dim()];
        self.ask(|adapter| {
            let (from, to): (Bound<'_, PyAny>, Bound<'_, PyAny>) = adapter.call_method0("encode")?.extract()?;
            start.copy_from_slice(&arrays::numbers("the latents of the present", &from, &shape)?);
            goal.copy_from_slice(&arrays::numbers("the latents of the goal", &to, &shape)?);
            Ok(())
        })
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        let dim = self.latent_dim();
        self.ask(|adapter| {
            let (py, n) = (adapter.py(), latents.len() / dim);
            let given =
                (arrays::floats(py, latents, &[n, dim])?, arrays::floats(py, actions, &[n, actions.len() / n])?);
            let returned = adapter.call_method1("predict", given)?;
            next.copy_from_slice(&arrays::numbers("the latents that the model predicted", &returned, &[n, dim])?);
            Ok(())
        })
    }

    fn predict_vjp(
        &mut self,
        latents: &[f32],
        actions: &[f32],
        next_gradient: &[f32],
        latent_gradient: &mut [f32],
        action_gradient: &mut [f32],
    ) -> Result<()> {
        let dim = self.latent_dim();
        self.ask(|adapter| {
            let (py, n) = (adapter.py(), latents.len() / dim);
            let width = actions.len() / n;
            let given = (
                arrays::floats(py, latents, &[n, dim])?,
                arrays::floats(py, actions, &[n, width])?,
                arrays::floats(py, next_gradient, &[n, dim])?,
            );
            let returned = adapter.call_method1("predict_vjp", given)?;
            let (states, acts): (Bound<'_, PyAny>, Bound<'_, PyAny>) = returned.extract()?;
            latent_gradient.copy_from_slice(&arrays::numbers("a prediction's gradient", &states, &[n, dim])?);
            action_gradient.copy_from_slice(&arrays::numbers("a prediction's gradient", &acts, &[n, width])?);
            Ok(())
        })
    }
}

impl Constrained for PythonCost {
    fn constraints(&self, horizon: usize) -> usize {
        self.ask(|adapter| adapter.call_method1("constraints", (horizon,))?.extract()).unwrap_or_else(|error| {
            self.failed.replace(Some(error));
            1
        })
    }

    fn constrain(&mut self, given: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        let n = values.len() / (given.envs * given.samples);
        self.ask(|adapter| {
            let returned = adapter.call_method1("constrain", (candidates(adapter.py(), given)?,))?;
            let shape = [given.envs, given.samples, n];
            values.copy_from_slice(&arrays::numbers("the constraints that the model returned", &returned, &shape)?);
            Ok(())
        })
    }

    fn constrain_vjp(&mut self, given: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        let n = weights.len() / (given.envs * given.samples);
        self.ask(|adapter| {
            let py = adapter.py();
            let weights = arrays::floats(py, weights, &[given.envs, given.samples, n])?;
            let returned = adapter.call_method1("constrain_vjp", (candidates(py, given)?, weights))?;
            let shape = [given.envs, given.samples, given.horizon, given.dim];
            let added = arrays::numbers("the gradient of the model's constraints", &returned, &shape)?;
            gradient.iter_mut().zip(added).for_each(|(to, more)| *to += more);
            Ok(())
        })
    }
}
