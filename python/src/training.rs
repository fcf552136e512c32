//! Training outside the engine: the checkpoint from which a run begins, and the checkpoints that it saves.

use crate::arrays;
use crate::data::dataset::Dataset;
use crate::data::process::detached;
use crate::errors::{json, to_py_err};
use crate::exit;
use numpy::{PyUntypedArray, PyUntypedArrayMethods as _};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::PathBuf;
use swm::cli::{check_training, record_training};
use swm::core::{Error, Manifest, Result};
use swm::data::LoaderConfig;
use swm::models::nn::parameters::{HostTensor, Named};
use swm::models::store::{Parts, StateParts, store};
use swm::models::train::TrainingPlan;
use swm::models::{FAMILIES, TrainOptions, TrainableConfig};

/// The name of the training program in `run.json`.
const PROGRAM: &str = "stable_worldmodel.train (torch)";

/// The complete configuration of a family, a preset with `key=value` settings, as JSON.
#[pyfunction]
pub fn training_config(family: &str, preset: Option<&str>, settings: Vec<String>) -> PyResult<String> {
    Ok(config(family, preset, &settings).map_err(to_py_err)?.to_json().to_string())
}

fn config(family: &str, preset: Option<&str>, settings: &[String]) -> Result<Box<dyn TrainableConfig>> {
    let family = FAMILIES.get(family)?;
    (family.config)(preset.unwrap_or(family.presets[0].id), settings)
}

/// Writes the checkpoint from which a run begins, and before it `run.json` with `command`, the command line of `swm train`
/// that continues the run; or with `resume` checks the checkpoint from which it continues. Returns the rest of what the run
/// needs, as JSON: `parameters` (clipping group and factor of the learning rate by name), and the loaders `training` and
/// `validation`.
#[pyfunction]
#[allow(clippy::too_many_arguments, reason = "one argument for each option in Python")]
pub fn begin_training(
    py: Python<'_>,
    family: &str,
    preset: Option<&str>,
    settings: Vec<String>,
    dataset: &Dataset,
    out: PathBuf,
    resume: bool,
    command: Vec<String>,
) -> PyResult<String> {
    let begun = detached(py, || {
        let options = TrainOptions { resume, cache: swm::home::weights()?, ..TrainOptions::default() };
        let config = config(family, preset, &settings)?;
        check_training(&out, resume)?;
        let record = || record_training(&out, (command.clone(), PROGRAM), false);
        config.begin(dataset.reader()?, &out, &options, &record).unwrap_or_else(|| {
            let problem = "it is trained by the engine only";
            Err(Error::config(family, problem, "train it with swm.wm.train, or `swm train`"))
        })
    });
    let TrainingPlan { parameters, training, validation } = begun.map_err(to_py_err)?;
    let groups: Named<[f64; 2]> =
        parameters.into_iter().map(|(name, group)| (name, [group.clip as f64, group.lr])).collect();
    let loader = |config: LoaderConfig| {
        json!({
            "num_steps": config.clip.num_steps,
            "frameskip": config.clip.frameskip,
            "columns": config.clip.columns,
            "goals": config.goals,
            "batch_size": config.batch_size,
            "seed": config.seed,
            "episodes": config.episodes,
            "drop_last": config.drop_last,
        })
    };
    let plan = json!({ "parameters": groups, "training": loader(training), "validation": validation.map(loader) });
    Ok(plan.to_string())
}

/// Adds `command`, the command line of `swm train` that continues a run, to its `run.json`, when the run is continued. The
/// caller holds the lock of the folder.
#[pyfunction(name = "record_training")]
pub fn record(run: PathBuf, command: Vec<String>) -> PyResult<()> {
    record_training(&run, (command, PROGRAM), true).map_err(to_py_err)
}

/// The parts of a checkpoint that are no tensors.
#[derive(Deserialize)]
struct Texts {
    /// The content of `config.json`.
    file: Value,
    manifest: Manifest,
    /// The content of `state.json`; `None` for a checkpoint from which no training continues.
    state: Option<Value>,
}

/// Writes a checkpoint to a run folder, and returns the hash of its weights. `raw` are the trained weights if `weights` are
/// their moving average.
#[pyfunction]
pub fn save_checkpoint(
    py: Python<'_>,
    run: PathBuf,
    texts: &str,
    weights: &Bound<'_, PyDict>,
    moments: &Bound<'_, PyDict>,
    raw: Option<&Bound<'_, PyDict>>,
    replace: bool,
) -> PyResult<String> {
    let Texts { file, manifest, state } = json("checkpoint", texts)?;
    let (weights, moments) = (tensors(weights)?, tensors(moments)?);
    let raw = raw.map(tensors).transpose()?;
    let state = state.map(|state| StateParts { state, moments, raw });
    exit::detached(py, || store(&run, Parts { file, manifest, weights, state }, replace)).map_err(to_py_err)
}

/// Copies `float32` arrays by name.
fn tensors(arrays: &Bound<'_, PyDict>) -> PyResult<Named<HostTensor>> {
    let tensor = |(name, array): (Bound<'_, PyAny>, Bound<'_, PyAny>)| {
        let name: String = name.extract()?;
        let shape = array.cast::<PyUntypedArray>()?.shape().to_vec();
        let values = arrays::f32_values(&name, &array, &shape)?;
        Ok((name, HostTensor { shape, values }))
    };
    arrays.iter().map(tensor).collect()
}
