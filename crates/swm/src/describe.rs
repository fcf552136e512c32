//! Descriptions of environments as JSON, with the field names of Gymnasium's spaces, for `swm envs --json` and for the
//! Python package.

use crate::{ENVS, zoo};
use serde_json::{Map, Value, json};
use swm_core::{EnvEntry, EnvSpec, Named as _, Space, VariationSpace};

/// Says that an environment without scripted experts has none, or which tasks they play.
pub fn without_experts(chosen: &EnvEntry) -> String {
    let all = ENVS.get(chosen.id).map_or(&[][..], |row| row.experts);
    let tasks: Vec<&str> = all.iter().flat_map(|expert| expert.tasks).copied().collect();
    let experts =
        if tasks.is_empty() { "no experts".to_owned() } else { format!("experts of {} only", tasks.join(", ")) };
    format!("{} has {experts}", chosen.id)
}

/// Describes a registered environment: its spec, summary, options and experts, among them one of the zoo.
pub fn env(row: &EnvEntry, made: &EnvSpec) -> Value {
    let mut value = spec(made);
    value["summary"] = json!(row.summary);
    value["options"] =
        row.options.iter().map(|o| json!({"key": o.key, "summary": o.summary, "values": o.values})).collect();
    let scripted = row.experts.iter().map(|e| json!({"id": e.id(), "summary": e.summary}));
    let trained = zoo::trained_expert(row, &made.id, "expert");
    let trained = trained.map(|name| json!({"id": "expert", "summary": format!("trained by interaction: {name}")}));
    value["experts"] = scripted.chain(trained).collect();
    value
}

/// Returns the spec of an environment: spaces, info columns, factors of variation, time limit, cameras.
pub fn spec(spec: &EnvSpec) -> Value {
    let info: Map<String, Value> = spec
        .columns
        .iter()
        .map(|column| {
            let shape: Vec<String> = column.shape.iter().map(ToString::to_string).collect();
            let shape = if shape.is_empty() { String::new() } else { format!("[{}]", shape.join(", ")) };
            (column.name.clone(), json!(format!("{}{shape}", column.dtype.name())))
        })
        .collect();
    json!({
        "id": spec.id,
        "action_space": space(&spec.action_space),
        "observation_space": observation(spec),
        "observation_column": match &spec.observation_space[..] {
            [(name, _)] => Some(*name),
            _ => None,
        },
        "info": info,
        "variation": variation(&spec.variation_space),
        "sampling_order": sampling_order(&spec.variation_space),
        "default_variations": spec.variation_space.defaults(),
        "max_episode_steps": spec.max_episode_steps,
        "cameras": spec.cameras,
    })
}

/// Returns the observation space; several spaces become a `Dict`.
fn observation(spec: &EnvSpec) -> Value {
    match &spec.observation_space[..] {
        [(_, one)] => space(one),
        several => {
            let spaces: Map<String, Value> =
                several.iter().map(|(name, one)| ((*name).to_owned(), space(one))).collect();
            json!({"type": "Dict", "spaces": spaces})
        }
    }
}

/// Returns the space and the default value of every factor of variation, by key.
pub fn variation(variation_space: &VariationSpace) -> Map<String, Value> {
    let factors = variation_space.factors().iter();
    factors
        .map(|factor| {
            let mut value = space(&factor.space);
            value["init_value"] = shaped(&factor.space, &factor.init_value);
            (factor.key.clone(), value)
        })
        .collect()
}

/// Returns the keys of groups and factors in the order in which they are sampled.
pub fn sampling_order(variation_space: &VariationSpace) -> Vec<String> {
    let mut order: Vec<String> = vec![];
    for factor in variation_space.factors() {
        if let Some((group, _)) = factor.key.split_once('.')
            && !order.iter().any(|known| known == group)
        {
            order.push(group.to_owned());
        }
        order.push(factor.key.clone());
    }
    order
}

/// Returns a space with its bounds.
fn space(space: &Space) -> Value {
    let bounds = |pick: fn((f64, f64)) -> f64| {
        let values: Vec<f64> = (0..space.len()).map(|i| pick(space.bounds(i))).collect();
        shaped(space, &values)
    };
    match space {
        Space::Discrete { n, start } => json!({"type": "Discrete", "n": n, "start": start}),
        Space::MultiDiscrete { nvec, start } => json!({"type": "MultiDiscrete", "nvec": nvec, "start": start}),
        Space::Box { .. } | Space::Rgb => json!({
            "type": if matches!(space, Space::Rgb) { "RGBBox" } else { "Box" },
            "shape": space.shape(),
            "dtype": space.dtype().name(),
            "low": bounds(|b| b.0),
            "high": bounds(|b| b.1),
        }),
    }
}

/// Returns a value of a space as a scalar or as nested lists. Integer spaces give integers; infinite bounds are null.
fn shaped(space: &Space, value: &[f64]) -> Value {
    let is_integer = matches!(space, Space::Discrete { .. } | Space::MultiDiscrete { .. } | Space::Rgb);
    let mut values: Vec<Value> = value.iter().map(|&v| if is_integer { json!(v as i64) } else { json!(v) }).collect();
    for &size in space.shape().iter().rev() {
        values = values.chunks(size.max(1)).map(|row| Value::Array(row.to_vec())).collect();
    }
    values.pop().unwrap_or_default()
}
