//! [`pack`]: writes a capsule from a checkpoint.

use super::{EvaluationRecord, MODEL, RecordedEpisode, cpu_level};
use crate::resolver::HomeResolver;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use swm_core::columns;
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, DType, Error, Key, Origin, Result, Schema, VariationRequest};
use swm_eval::{Recorded, RunOptions, StartsRequest, World, WorldConfig};
use swm_models::capsule::{self, Capsule, Description, Evaluation, Reference, reference};
use swm_models::{Device, FAMILIES, LoadedModel, StoredCheckpoint, load_stored};

/// The rows of a reference batch.
const ROWS: usize = 4;
/// The model steps of the reference actions.
const HORIZON: usize = 3;

/// What a capsule is packed from.
#[derive(Clone, Debug)]
pub struct PackRequest {
    /// The run folder of the checkpoint, or a capsule.
    pub run: PathBuf,
    /// A `results.json` with an evaluation of the checkpoint.
    pub results: Option<PathBuf>,
    /// A `results.json` of the checkpoint whose episodes were played to their end, for its returns.
    pub returns: Option<PathBuf>,
    /// The licence of the weights.
    pub licence: Option<String>,
    /// Who trained the model.
    pub author: Option<String>,
    /// Whether the checkpoint and the results may choose any environment, wrapper and dataset.
    pub trust: bool,
}

/// Packs a checkpoint. A capsule is packed again: it keeps its licence, author and evaluation where the request has
/// none.
///
/// # Errors
/// When the checkpoint or the results are damaged or do not fit each other, or the environment cannot be made.
pub fn pack(request: &PackRequest, options: &RunOptions, control: &mut Control<'_>) -> Result<Capsule> {
    let old = request.run.is_file().then(|| Capsule::read(&request.run)).transpose()?;
    let stored = match &old {
        Some(capsule) => StoredCheckpoint::of(&request.run, capsule),
        None => StoredCheckpoint::read(&request.run)?,
    };
    let evaluated = stored.manifest().hashes.get("weights").cloned().unwrap_or_default();
    let rounded = capsule::round(&stored)?;
    let model: Rc<dyn LoadedModel> = Rc::from(load_stored(FAMILIES.rows, &rounded.stored, &Device::flex())?);
    let reference = make_reference(&*model, request)?;
    let hash = rounded.stored.manifest().hashes.get("weights").cloned().unwrap_or_default();
    let mut evaluation = match &request.results {
        Some(file) => Some(evaluate(file, request.trust, &[&hash, &evaluated], model, options, control)?),
        None => old.as_ref().and_then(|capsule| capsule.evaluation.clone()),
    };
    if let Some(file) = &request.returns {
        let returns = EvaluationRecord::returns_in(file, &swm_report::read_results(file)?, &[&hash, &evaluated])?;
        let Some(evaluation) = &mut evaluation else {
            let fix = "give the results of another evaluation as well, with strict counting: --eval";
            return Err(Error::config(file.display().to_string(), "the capsule has no evaluation", fix));
        };
        evaluation.record["returns"] = json!(returns);
    }
    let old = old.map(|capsule| capsule.description).unwrap_or_default();
    let description = Description {
        licence: request.licence.clone().or(old.licence),
        author: request.author.clone().or(old.author),
        cpu_level: cpu_level(),
    };
    Ok(rounded.capsule(description, reference, evaluation))
}

/// Returns a reference batch: observations after resets of the model's environment, and random actions.
fn make_reference(model: &dyn LoadedModel, request: &PackRequest) -> Result<Reference> {
    let info = model.info()?;
    let Some(env) = &info.dataset_info.env else {
        let fix = "train on a dataset that names its environment";
        return Err(Error::config(request.run.display().to_string(), "it names no environment", fix));
    };
    let env = crate::env(env, &Origin::file(&request.run, request.trust))?;
    let image = info.image_size.map(|side| (side, side));
    let mut world = World::new(env, WorldConfig { envs: ROWS, image, ..WorldConfig::default() })?;
    world.reset(0, &VariationRequest::default())?;
    let (infos, spec) = (world.pool().infos(), world.spec());
    let observed = infos.schema().columns().iter();
    let observed = observed.map(|column| ColumnSpec { name: columns::collected(&column.name), ..column.clone() });
    let mut inputs: Vec<(usize, ColumnSpec)> = observed.enumerate().collect();
    if let Some(read) = reference::columns(model) {
        inputs.retain(|(_, column)| read.contains(&column.name));
    }
    let mut rng = Key::new(0).with("reference actions").rng();
    let mut step =
        || -> Vec<f32> { spec.action_space.sample(&mut rng).into_iter().map(|value| value as f32).collect() };
    let actions: Vec<f32> = (0..ROWS * HORIZON * info.action_block).flat_map(|_| step()).collect();
    let shape = [HORIZON, actions.len() / (ROWS * HORIZON)];
    let actions_column = ColumnSpec::new(reference::ACTIONS, DType::Float32, shape);
    let schema: Vec<ColumnSpec> = inputs.iter().map(|(_, column)| column.clone()).chain([actions_column]).collect();
    let mut batch = Batch::zeros(&Schema::new(schema)?, ROWS);
    for (to, (from, _)) in inputs.iter().enumerate() {
        batch.bytes_mut(to).copy_from_slice(infos.bytes(*from));
    }
    batch.get_mut::<f32>(reference::ACTIONS)?.copy_from_slice(&actions);
    let outputs = reference::outputs(model, &batch, || Ok(spec.clone()))?;
    Ok(Reference { inputs: batch, outputs })
}

/// Plays some episodes of an evaluation again with the rounded weights, and records their outcomes.
fn evaluate(
    file: &Path,
    trust: bool,
    hashes: &[&str],
    model: Rc<dyn LoadedModel>,
    options: &RunOptions,
    control: &mut Control<'_>,
) -> Result<Evaluation> {
    let results = swm_report::read_results(file)?;
    let (mut record, numbers) = EvaluationRecord::find(file, &results, hashes)?;
    let resolver = HomeResolver::new(Origin::file(file, trust)).with_checkpoint(MODEL, model);
    let replay = record.request.replay(Recorded { numbers: &numbers, rows: None }, &resolver, options, control)?;
    let outcomes = numbers.iter().zip(&replay.run.episodes);
    record.episodes = outcomes.map(|(&number, result)| RecordedEpisode::of(number, result)).collect();
    if let StartsRequest::Dataset { dataset, .. } = &mut record.request.starts {
        // The folders of this machine mean nothing on another one.
        *dataset = Path::new(dataset).file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    }
    Ok(Evaluation { record: json!(record), starts: replay.starts, rows: replay.rows })
}
