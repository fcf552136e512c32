//! The outputs of a model for a [`Reference`](super::Reference) batch, with which a capsule is checked on another machine.
//!
//! | model | inputs | outputs |
//! | --- | --- | --- |
//! | predicts latents | the columns that it encodes; `actions`, in the environment's units | `latents`, `predicted` |
//! | acts without a solver | all columns of the environments | `actions` of the first step |
//! | only scores plans | all columns of the environments; `actions`, in the model's units | `costs` of one candidate each |

use crate::family::LoadedModel;
use crate::nn::parameters::{HostTensor, Named};
use swm_core::columns::ACTION;
use swm_core::{Batch, Candidates, EnvSpec, Error, Key, Result, Schema};

/// The input column of actions, `[rows, horizon, action dimension of a model step]`.
pub const ACTIONS: &str = "actions";

/// The largest accepted difference between two outputs, relative to the largest element.
pub const TOLERANCE: f64 = 1e-4;

/// Returns the names of the columns that a model reads from a reference batch; `None` for all columns.
pub fn columns(model: &dyn LoadedModel) -> Option<Vec<String>> {
    Some(model.predictor()?.columns())
}

/// Computes the outputs of a model. `spec` returns the environment of a model that acts.
///
/// # Errors
/// When the inputs do not fit the model, or the model has no output.
pub fn outputs(
    model: &dyn LoadedModel,
    inputs: &Batch,
    spec: impl FnOnce() -> Result<EnvSpec>,
) -> Result<Named<HostTensor>> {
    let rows = inputs.rows();
    if let Some(mut predictor) = model.predictor() {
        let dim = predictor.latent_dim();
        let (actions, horizon) = actions(inputs)?;
        let (mut latents, mut predicted) = (vec![0.0; rows * dim], vec![0.0; rows * horizon * dim]);
        predictor.encode(inputs, &mut latents)?;
        predictor.rollout(&latents, actions, horizon, &mut predicted)?;
        return Ok(named([("latents", vec![rows, dim], latents), ("predicted", vec![rows, horizon, dim], predicted)]));
    }
    if model.acts() {
        let spec = spec()?;
        let Some(policy) = model.policy(&spec, rows) else { return Err(no_output(model)) };
        let (mut policy, mut taken) = (policy?, Batch::zeros(&Schema::new([spec.action_column()])?, rows));
        (0..rows).for_each(|row| policy.begin(row, Key::new(0).at(row as u64)));
        policy.act(inputs, &vec![true; rows], &mut taken)?;
        let dim = taken.schema().columns()[0].len();
        return Ok(named([("actions", vec![rows, dim], taken.to_f32(ACTION)?)]));
    }
    let Some(mut cost) = model.cost() else { return Err(no_output(model)) };
    let (actions, horizon) = actions(inputs)?;
    let dim = actions.len() / (rows * horizon);
    let mut costs = vec![0.0; rows];
    cost.observe(inputs, &(0..rows).collect::<Vec<_>>())?;
    cost.cost(Candidates { actions, envs: rows, samples: 1, horizon, dim }, &mut costs)?;
    Ok(named([("costs", vec![rows], costs)]))
}

/// Returns the largest difference between the recorded outputs and others, relative to the largest element of the
/// recorded tensor.
///
/// # Errors
/// When a tensor is missing or has another shape.
pub fn difference(recorded: &Named<HostTensor>, found: &Named<HostTensor>) -> Result<f64> {
    let shapes = |outputs: &Named<HostTensor>| -> Vec<String> {
        outputs.iter().map(|(name, tensor)| format!("{name} {:?}", tensor.shape)).collect()
    };
    if shapes(recorded) != shapes(found) || recorded.is_empty() {
        let (given, expected) = (shapes(recorded).join(", "), shapes(found).join(", "));
        return Err(Error::mismatch("comparing reference outputs", given, format!("the model's outputs: {expected}")));
    }
    let differences = recorded.iter().zip(found.values()).map(|((_, recorded), found)| {
        let largest =
            recorded.values.iter().fold(f64::MIN_POSITIVE, |largest, value| largest.max(f64::from(value.abs())));
        let pairs = recorded.values.iter().zip(&found.values);
        // A difference that is not a number is larger than every tolerance.
        let differ = |(a, b): (&f32, &f32)| if b.is_finite() { f64::from((a - b).abs()) } else { f64::INFINITY };
        pairs.map(differ).fold(0.0, f64::max) / largest
    });
    Ok(differences.fold(0.0, f64::max))
}

/// Returns the actions of the inputs and the number of model steps.
fn actions(inputs: &Batch) -> Result<(&[f32], usize)> {
    let shape = &inputs.schema().column(ACTIONS)?.shape;
    match shape[..] {
        [horizon, dim] if horizon > 0 && dim > 0 => Ok((inputs.get::<f32>(ACTIONS)?, horizon)),
        _ => Err(Error::mismatch("reading reference actions", format!("rows of {shape:?}"), "[horizon, action]")),
    }
}

fn named<const N: usize>(tensors: [(&str, Vec<usize>, Vec<f32>); N]) -> Named<HostTensor> {
    tensors.into_iter().map(|(name, shape, values)| (name.to_owned(), HostTensor { shape, values })).collect()
}

fn no_output(model: &dyn LoadedModel) -> Error {
    let family = model.info().map_or("model", |info| info.family);
    let problem = "it neither predicts nor acts, so a reference batch has no outputs";
    Error::config(format!("a capsule of a {family}"), problem, "pack another model")
}
