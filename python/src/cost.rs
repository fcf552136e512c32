//! [`PythonCost`]: a [`CostModel`] implemented in Python, called through the adapter class of
//! `stable_worldmodel.planning`.

use crate::arrays;
use crate::errors::{attached, to_py_err};
use crate::exit;
use crate::held::Held;
use crate::model::Model;
use numpy::{IxDyn, PyArrayDyn, PyArrayMethods as _, PyUntypedArrayMethods as _};
use pyo3::ffi;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::cell::RefCell;
use swm::core::{
    Batch, Candidates, Constrained, CostModel, DifferentiableCost, EnvSpec, Error, LatentDynamics, Origin, Result,
};
use swm::plan::{ActionScale, Score, SimulatorCost};

/// A cost model for planning, with its action scale and origin.
pub struct PlanningModel {
    pub cost: Box<dyn CostModel>,
    /// The scale of the model's actions; `None` if the model does not define one.
    pub scale: Option<ActionScale>,
    /// The hash of the model's weights; `None` unless the model is a checkpoint.
    pub weights: Option<String>,
    /// Whether the model is implemented in Python.
    pub python: bool,
}

/// Converts the model that Python passes: a checkpoint of the engine, an adapter of a Python model, or `None` for the
/// simulator.
///
/// # Errors
/// If the simulator cannot be created, the checkpoint cannot be loaded, or the adapter lacks an attribute.
pub fn planning_model(
    given: Option<&Bound<'_, PyAny>>,
    spec: &EnvSpec,
    action_block: usize,
) -> PyResult<PlanningModel> {
    let Some(given) = given else {
        // The world already runs this environment.
        let env = swm::env(&spec.id, &Origin::User).map_err(to_py_err)?;
        let scale = ActionScale::unscaled(spec);
        let cost = SimulatorCost::new(move || env.env(), scale.clone(), action_block, Score::default());
        return Ok(PlanningModel {
            cost: Box::new(cost.map_err(to_py_err)?),
            scale: Some(scale),
            weights: None,
            python: false,
        });
    };
    if let Ok(model) = given.cast::<Model>() {
        let model = model.get();
        let (cost, scale) = model.cost_model()?;
        return Ok(PlanningModel { cost, scale: Some(scale), weights: Some(model.weights.clone()), python: false });
    }
    let cost = Box::new(PythonCost::new(given)?);
    Ok(PlanningModel { cost, scale: None, weights: None, python: true })
}

/// A cost model implemented in Python.
pub struct PythonCost {
    /// Has the methods `observe(infos)` and `cost(candidates)`, and depending on its flags `cost_and_gradient`,
    /// `encode`, `predict`, `predict_vjp`, `constrain` and `constrain_vjp`. All methods take and return numpy arrays.
    adapter: Held<Py<PyAny>>,
    gradient: bool,
    /// The latent dimension; `None` if the model has no latent dynamics.
    latent: Option<usize>,
    constrained: bool,
    /// The number of environments in the last observation.
    envs: usize,
    /// The arrays of candidates.
    buffers: RefCell<Buffers>,
    /// The error of a call in a trait method that cannot return errors; the next call returns this error.
    failed: RefCell<Option<Error>>,
}

impl PythonCost {
    /// Wraps an adapter.
    ///
    /// # Errors
    /// If the adapter lacks one of the attributes `has_gradient`, `latent_dim` and `has_constraints`.
    pub fn new(adapter: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self {
            gradient: adapter.getattr("has_gradient")?.extract()?,
            latent: adapter.getattr("latent_dim")?.extract()?,
            constrained: adapter.getattr("has_constraints")?.extract()?,
            adapter: Held::new(adapter.clone().unbind()),
            envs: 0,
            buffers: RefCell::default(),
            failed: RefCell::new(None),
        })
    }

    /// Records that the adapter has already observed `envs` environments.
    pub fn observed(&mut self, envs: usize) {
        self.envs = envs;
    }

    /// Runs `work` with the adapter. If `failed` holds an error, returns this error instead.
    fn call<T>(&self, work: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<T>) -> Result<T> {
        if let Some(error) = self.failed.take() {
            return Err(error);
        }
        attached(|py| work(self.adapter.bind(py)))
    }
}

/// Arrays that are filled again as soon as nothing in Python refers to them, because new memory of their size costs page faults: more
/// than the copy.
#[derive(Default)]
struct Buffers(Vec<Held<Py<PyArrayDyn<f32>>>>);

impl Buffers {
    /// The most arrays: that of the present call, one that the last call left, and a spare one.
    const MOST: usize = 3;

    /// Copies the candidates into an array `[envs, samples, horizon, dim]`.
    fn filled<'py>(&mut self, py: Python<'py>, given: Candidates<'_>) -> PyResult<Bound<'py, PyAny>> {
        let shape = [given.envs, given.samples, given.horizon, given.dim];
        // Tensors and views refer to the array that owns the memory, which is one of these.
        let is_free = |array: &Held<Py<PyArrayDyn<f32>>>| {
            // SAFETY: the pointer is that of a living object, and this thread is attached to the interpreter.
            #[allow(unsafe_code, reason = "PyO3 has no other way to count references")]
            let references = unsafe { ffi::Py_REFCNT(array.as_ptr()) };
            references == 1 && array.bind(py).shape() == shape
        };
        if let Some(array) = self.0.iter().find(|array| is_free(array)).map(|array| array.bind(py).clone())
            && let Ok(mut free) = array.try_readwrite()
            && let Ok(values) = free.as_slice_mut()
        {
            values.copy_from_slice(given.actions);
            drop(free);
            return Ok(array.into_any());
        }
        let array = PyArrayDyn::<f32>::zeros(py, IxDyn(&shape), false);
        array.readwrite().as_slice_mut()?.copy_from_slice(given.actions);
        if self.0.len() == Self::MOST {
            self.0.remove(0);
        }
        self.0.push(Held::new(array.clone().unbind()));
        Ok(array.into_any())
    }
}

/// Copies the candidates into an array `[envs, samples, horizon, dim]`.
fn candidates<'py>(py: Python<'py>, given: Candidates<'_>) -> PyResult<Bound<'py, PyAny>> {
    arrays::f32_array(py, given.actions, &[given.envs, given.samples, given.horizon, given.dim])
}

impl CostModel for PythonCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.envs = envs.len();
        self.call(|adapter| {
            let py = adapter.py();
            let dict = PyDict::new(py);
            for (i, column) in infos.schema().columns().iter().enumerate() {
                dict.set_item(&column.name, arrays::copy_rows(py, infos, i, envs)?)?;
            }
            exit::call_method(adapter, "observe", (dict,)).map(drop)
        })
    }

    fn cost(&mut self, given: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.call(|adapter| {
            let candidates = self.buffers.borrow_mut().filled(adapter.py(), given)?;
            let returned = exit::call_method(adapter, "cost", (candidates,))?;
            arrays::copy_f32("the costs of the model", &returned, &[given.envs, given.samples], costs)
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
        self.call(|adapter| {
            let shape = [given.envs, given.samples, given.horizon, given.dim];
            let candidates = self.buffers.borrow_mut().filled(adapter.py(), given)?;
            let returned = exit::call_method(adapter, "cost_and_gradient", (candidates,))?;
            let (values, gradients): (Bound<'_, PyAny>, Bound<'_, PyAny>) = returned.extract()?;
            arrays::copy_f32("the costs of the model", &values, &shape[..2], costs)?;
            arrays::copy_f32("the gradient of the model's costs", &gradients, &shape, gradient)
        })
    }
}

impl LatentDynamics for PythonCost {
    fn latent_dim(&self) -> usize {
        self.latent.unwrap_or(0)
    }

    fn encode(&mut self, start: &mut [f32], goal: &mut [f32]) -> Result<()> {
        let shape = [self.envs, self.latent_dim()];
        self.call(|adapter| {
            let (current, target): (Bound<'_, PyAny>, Bound<'_, PyAny>) =
                exit::call_method(adapter, "encode", ())?.extract()?;
            arrays::copy_f32("the latents of the current observation", &current, &shape, start)?;
            arrays::copy_f32("the latents of the goal", &target, &shape, goal)
        })
    }

    fn predict(&mut self, latents: &[f32], actions: &[f32], next: &mut [f32]) -> Result<()> {
        let dim = self.latent_dim();
        self.call(|adapter| {
            let (py, n) = (adapter.py(), latents.len() / dim);
            let given =
                (arrays::f32_array(py, latents, &[n, dim])?, arrays::f32_array(py, actions, &[n, actions.len() / n])?);
            let returned = exit::call_method(adapter, "predict", given)?;
            arrays::copy_f32("the predicted latents", &returned, &[n, dim], next)
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
        self.call(|adapter| {
            let (py, n) = (adapter.py(), latents.len() / dim);
            let action_dim = actions.len() / n;
            let given = (
                arrays::f32_array(py, latents, &[n, dim])?,
                arrays::f32_array(py, actions, &[n, action_dim])?,
                arrays::f32_array(py, next_gradient, &[n, dim])?,
            );
            let returned = exit::call_method(adapter, "predict_vjp", given)?;
            let (latent, action): (Bound<'_, PyAny>, Bound<'_, PyAny>) = returned.extract()?;
            let what = "the gradient of a prediction";
            arrays::copy_f32(what, &latent, &[n, dim], latent_gradient)?;
            arrays::copy_f32(what, &action, &[n, action_dim], action_gradient)
        })
    }
}

impl Constrained for PythonCost {
    fn constraints(&self, horizon: usize) -> usize {
        self.call(|adapter| exit::call_method(adapter, "constraints", (horizon,))?.extract()).unwrap_or_else(|error| {
            self.failed.replace(Some(error));
            1
        })
    }

    fn constrain(&mut self, given: Candidates<'_>, values: &mut [f32]) -> Result<()> {
        let n = values.len() / (given.envs * given.samples);
        self.call(|adapter| {
            let returned = exit::call_method(adapter, "constrain", (candidates(adapter.py(), given)?,))?;
            let shape = [given.envs, given.samples, n];
            arrays::copy_f32("the constraints of the model", &returned, &shape, values)
        })
    }

    fn constrain_vjp(&mut self, given: Candidates<'_>, weights: &[f32], gradient: &mut [f32]) -> Result<()> {
        let n = weights.len() / (given.envs * given.samples);
        self.call(|adapter| {
            let py = adapter.py();
            let weights = arrays::f32_array(py, weights, &[given.envs, given.samples, n])?;
            let returned = exit::call_method(adapter, "constrain_vjp", (candidates(py, given)?, weights))?;
            let shape = [given.envs, given.samples, given.horizon, given.dim];
            let added = arrays::f32_values("the gradient of the model's constraints", &returned, &shape)?;
            gradient.iter_mut().zip(added).for_each(|(to, more)| *to += more);
            Ok(())
        })
    }
}
