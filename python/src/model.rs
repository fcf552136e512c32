//! [`Model`]: a checkpoint of the engine, for planning or acting.

use crate::arrays;
use crate::errors::{json, to_py_err};
use crate::exit;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use swm::core::{Batch, Candidates, CostModel, Error, Key, Origin, Policy, Result, Schema};
use swm::models::Device;
use swm::models::{CheckpointInfo, FAMILIES, LoadedModel, StoredCheckpoint, load_stored};
use swm::plan::ActionScale;
use swm::plan::objective::ObjectiveConfig;

/// A checkpoint. Its weights stay in memory, so that those that are loaded also play.
#[pyclass(frozen, subclass, module = "stable_worldmodel._engine")]
pub struct Model {
    path: PathBuf,
    stored: StoredCheckpoint,
    device: Device,
    objective: Value,
    scale: ActionScale,
    /// The hash of the checkpoint's weights.
    pub weights: String,
    /// The checkpoint info as JSON.
    info: String,
    /// The cost model of [`Model::cost`], created by the first call.
    cost: Mutex<Option<Box<dyn CostModel>>>,
    /// The policy of [`Model::act`] and its number of environments, created by the first call.
    policy: Mutex<Option<(Box<dyn Policy>, usize)>>,
    /// The id of the training environment; `None` if the manifest does not name one.
    env: Option<String>,
    /// The checkpoint, or the user if the user trusts it.
    origin: Origin,
}

impl Model {
    /// Creates the model.
    ///
    /// # Errors
    /// If the device has no memory for it.
    pub fn load(&self) -> Result<Box<dyn LoadedModel>> {
        load_stored(FAMILIES.rows, &self.stored, &self.device)
    }

    /// Creates a cost model and returns it with the scale of its actions.
    ///
    /// # Errors
    /// If the model cannot be created, holds a policy without a cost, or the objective is not valid.
    pub fn cost_model(&self) -> PyResult<(Box<dyn CostModel>, ActionScale)> {
        let loaded = self.load().map_err(to_py_err)?;
        let cost = loaded.cost().ok_or_else(|| {
            let what = format!("checkpoint {}", self.path.display());
            to_py_err(Error::config(what, "it acts and does not predict", "use it as a policy: FeedForwardPolicy"))
        })?;
        let objective: ObjectiveConfig = match &self.objective {
            Value::Null => ObjectiveConfig::default(),
            given => json("objective", &given.to_string())?,
        };
        Ok((objective.apply(cost).map_err(to_py_err)?, self.scale.clone()))
    }
}

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python<'_>, name: &str, device: &str, objective: &str, trust: bool) -> PyResult<Self> {
        let device = swm::models::device::parse(device).map_err(to_py_err)?;
        let objective: Value = json("objective", objective)?;
        let found = exit::detached(py, || {
            let path = swm::home::find_checkpoint(name)?;
            let stored = StoredCheckpoint::read(&path)?.in_memory()?;
            let info = load_stored(FAMILIES.rows, &stored, &device)?.info()?;
            Ok((path, stored, info))
        });
        let (path, stored, info) = found.map_err(to_py_err)?;
        let CheckpointInfo { family, weights, config, dataset_info, image_size, action_block, history, .. } = &info;
        let described = json!({
            "family": family,
            "weights": weights,
            "config": config,
            "env": dataset_info.env,
            "image": image_size,
            "action_block": action_block,
            "history": history,
            "action_mean": dataset_info.action.mean,
            "action_std": dataset_info.action.std,
        });
        Ok(Self {
            origin: Origin::file(&path, trust),
            path,
            stored,
            device,
            objective,
            scale: info.dataset_info.action.clone(),
            weights: info.weights.clone(),
            info: described.to_string(),
            cost: Mutex::new(None),
            policy: Mutex::new(None),
            env: info.dataset_info.env.clone(),
        })
    }

    /// The checkpoint info as JSON.
    #[getter]
    fn info(&self) -> &str {
        &self.info
    }

    /// The path of the checkpoint.
    #[getter(path)]
    pub fn name(&self) -> String {
        self.path.display().to_string()
    }

    /// Computes the actions of a checkpoint with a policy, in the environment's units.
    ///
    /// # Shapes
    /// `infos`: `[envs, ..]`; result: `[envs, dim]`.
    fn act<'py>(&self, py: Python<'py>, infos: &Bound<'py, PyDict>) -> PyResult<Bound<'py, PyAny>> {
        let batch = arrays::batch(infos)?;
        let rows = batch.rows();
        let mut policy = self.policy.lock().unwrap_or_else(PoisonError::into_inner);
        let cached = &mut *policy;
        let actions = exit::detached(py, || {
            let what = || format!("checkpoint {}", self.path.display());
            let Some(id) = &self.env else {
                return Err(Error::config(what(), "its manifest does not name an environment", "train it again"));
            };
            let spec = swm::env(id, &self.origin)?.env()?.spec().clone();
            if cached.as_ref().is_none_or(|(_, slots)| *slots != rows) {
                let policy = self.load()?.policy(&spec, rows).ok_or_else(|| {
                    Error::config(what(), "it predicts and does not act", "plan with it: get_cost, MPCPolicy")
                })??;
                *cached = Some((policy, rows));
            }
            let mut actions = Batch::zeros(&Schema::new([spec.action_column()])?, rows);
            if let Some((policy, _)) = cached {
                (0..rows).for_each(|slot| policy.begin(slot, Key::new(0).at(slot as u64)));
                policy.act(&batch, &vec![true; rows], &mut actions)?;
            }
            Ok(actions)
        });
        arrays::copy_rows(py, &actions.map_err(to_py_err)?, 0, &(0..rows).collect::<Vec<_>>())
    }

    /// Computes the costs of candidate action sequences.
    ///
    /// # Shapes
    /// `infos`: `[envs, ..]`; `candidates`: `[envs, samples, horizon, dim]`; result: `[envs, samples]`.
    fn cost<'py>(
        &self,
        py: Python<'py>,
        infos: &Bound<'py, PyDict>,
        candidates: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let shape: [usize; 4] = candidates.getattr("shape")?.extract()?;
        let actions = arrays::f32_values("action candidates", candidates, &shape)?;
        let [envs, samples, horizon, dim] = shape;
        let batch = arrays::batch(infos)?;
        let mut costs = vec![0.0; envs * samples];
        let mut cached = self.cost.lock().unwrap_or_else(PoisonError::into_inner);
        let cost = match &mut *cached {
            Some(cost) => cost,
            none => none.insert(self.cost_model()?.0),
        };
        exit::detached(py, || {
            cost.observe(&batch, &(0..envs).collect::<Vec<_>>())?;
            cost.cost(Candidates { actions: &actions, envs, samples, horizon, dim }, &mut costs)
        })
        .map_err(to_py_err)?;
        arrays::f32_array(py, &costs, &[envs, samples])
    }
}
