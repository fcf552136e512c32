//! [`Model`]: a checkpoint of ours, to plan in.

use crate::arrays;
use crate::errors::{json, raised};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use swm::core::{Candidates, CostModel, Error};
use swm::families::{Card, load};
use swm::models::Device;
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
        let (path, card) = py
            .detach(|| {
                let path = swm::home::find_checkpoint(name)?;
                let card = load(&path, &device)?.card()?;
                Ok((path, card))
            })
            .map_err(raised)?;
        let Card { family, weights, config, facts, image, action_block, history, .. } = &card;
        let described = json!({
            "family": family,
            "weights": weights,
            "config": config,
            "env": facts.env,
            "image": image,
            "action_block": action_block,
            "history": history,
            "action_mean": facts.action.mean,
            "action_std": facts.action.std,
        });
        Ok(Self {
            path,
            device,
            objective,
            scale: card.facts.action.clone(),
            weights: card.weights.clone(),
            card: described.to_string(),
            asked: Mutex::new(None),
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
