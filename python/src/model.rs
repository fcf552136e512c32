//! [`Model`]: a checkpoint of ours, to plan in.

use crate::arrays;
use crate::errors::{json, raised};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use swm::core::{Batch, Candidates, CostModel, Error, Key, Policy, Schema};
use swm::models::Device;
use swm::models::{CheckpointInfo, load};
use swm::plan::ActionScale;
use swm::plan::objective::ObjectiveConfig;

/// A checkpoint.
#[pyclass(frozen, subclass, module = "stable_worldmodel._engine")]
pub struct Model {
    path: PathBuf,
    device: Device,
    objective: Value,
    scale: ActionScale,
    /// The hash of its weights.
    pub weights: String,
    card: String,
    /// The cost that answers [`Model::cost`], made when it is first asked.
    asked: Mutex<Option<Box<dyn CostModel>>>,
    /// The policy that answers [`Model::act`], and for how many environments it was made.
    acting: Mutex<Option<(Box<dyn Policy>, usize)>>,
    /// The environment it was trained on.
    env: Option<String>,
}

impl Model {
    /// A cost of its own, and what it means by an action.
    pub fn planned(&self) -> PyResult<(Box<dyn CostModel>, ActionScale)> {
        let loaded = load(&self.path, &self.device).map_err(raised)?;
        let cost = loaded.cost().ok_or_else(|| {
            let what = format!("checkpoint {}", self.path.display());
            raised(Error::config(what, "it acts and does not predict", "let it act: FeedForwardPolicy"))
        })?;
        let objective: ObjectiveConfig = match &self.objective {
            Value::Null => ObjectiveConfig::default(),
            given => json("objective", &given.to_string())?,
        };
        Ok((objective.apply(cost).map_err(raised)?, self.scale.clone()))
    }
}

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python<'_>, name: &str, device: &str, objective: &str) -> PyResult<Self> {
        let device = swm::models::device::parse(device).map_err(raised)?;
        let objective: Value = json("objective", objective)?;
        let (path, info) = py
            .detach(|| {
                let path = swm::home::find_checkpoint(name)?;
                let info = load(&path, &device)?.info()?;
                Ok((path, info))
            })
            .map_err(raised)?;
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
            path,
            device,
            objective,
            scale: info.dataset_info.action.clone(),
            weights: info.weights.clone(),
            card: described.to_string(),
            asked: Mutex::new(None),
            acting: Mutex::new(None),
            env: info.dataset_info.env.clone(),
        })
    }

    /// What it is, as JSON.
    #[getter]
    fn card(&self) -> &str {
        &self.card
    }

    /// Where it is.
    #[getter]
    fn path(&self) -> String {
        self.path.display().to_string()
    }

    /// What a model that acts does: an action a row of infos, in the environment's units.
    fn act<'py>(&self, py: Python<'py>, infos: &Bound<'py, PyDict>) -> PyResult<Bound<'py, PyAny>> {
        let batch = arrays::batch(infos)?;
        let rows = batch.rows();
        let mut acting = self.acting.lock().unwrap_or_else(PoisonError::into_inner);
        let acting = &mut *acting;
        let actions = py.detach(|| {
            let what = || format!("checkpoint {}", self.path.display());
            let Some(id) = &self.env else {
                return Err(Error::config(what(), "it does not say which environment it acts in", "train it again"));
            };
            let spec = swm::env(id)?.env()?.spec().clone();
            if acting.as_ref().is_none_or(|(_, slots)| *slots != rows) {
                let policy = load(&self.path, &self.device)?.policy(&spec, rows).ok_or_else(|| {
                    Error::config(what(), "it predicts and does not act", "plan in it: get_cost, MPCPolicy")
                })??;
                *acting = Some((policy, rows));
            }
            let mut actions = Batch::zeros(&Schema::new([spec.action_column()])?, rows);
            if let Some((policy, _)) = acting {
                (0..rows).for_each(|slot| policy.begin(slot, Key::new(0).at(slot as u64)));
                policy.act(&batch, &vec![true; rows], &mut actions)?;
            }
            Ok(actions)
        });
        arrays::copied(py, &actions.map_err(raised)?, 0, &(0..rows).collect::<Vec<_>>())
    }

    /// What plans cost: `[envs, samples]` for infos of `envs` rows and candidates `[envs, samples, horizon, dim]`.
    fn cost<'py>(
        &self,
        py: Python<'py>,
        infos: &Bound<'py, PyDict>,
        candidates: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let shape: [usize; 4] = candidates.getattr("shape")?.extract()?;
        let actions = arrays::numbers("action candidates", candidates, &shape)?;
        let [envs, samples, horizon, dim] = shape;
        let batch = arrays::batch(infos)?;
        let mut costs = vec![0.0; envs * samples];
        let mut asked = self.asked.lock().unwrap_or_else(PoisonError::into_inner);
        let cost = match &mut *asked {
            Some(cost) => cost,
            none => none.insert(self.planned()?.0),
        };
        py.detach(|| {
            cost.observe(&batch, &(0..envs).collect::<Vec<_>>())?;
            cost.cost(Candidates { actions: &actions, envs, samples, horizon, dim }, &mut costs)
        })
        .map_err(raised)?;
        arrays::floats(py, &costs, &[envs, samples])
    }
}
