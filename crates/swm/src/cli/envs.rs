//! `swm envs` and `swm fovs`: what worlds there are and what can be varied in them.

use super::{complain, emit, emit_json, table};
use clap::Args;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use swm::{ENVS, gym};
use swm_core::{EnvChoice, EnvEntry, EnvSpec, Space, VariationSpace};

/// Arguments of `swm envs`.
#[derive(Args)]
pub struct EnvsArgs {
    /// One to show in full, such as swm/TwoRoom-v1
    env: Option<String>,
}

/// Arguments of `swm fovs`.
#[derive(Args)]
pub struct FovsArgs {
    /// The environment, such as swm/TwoRoom-v1
    env: String,
}

/// Lists the environments.
pub fn envs(args: &EnvsArgs, as_json: bool) -> anyhow::Result<()> {
    if let Some(id) = &args.env {
        return show(&swm::env(id)?, as_json);
    }
    if as_json {
        let all = ENVS.rows.iter().map(|row| match row.env() {
            Ok(env) => (row.id.to_owned(), describe(row, env.spec())),
            Err(error) => (row.id.to_owned(), json!({"summary": row.summary, "missing": error.to_string()})),
        });
        return emit_json(&all.collect::<Map<String, Value>>());
    }
    let mut missing = BTreeSet::new();
    let rows: Vec<Vec<String>> = ENVS
        .rows
        .iter()
        .map(|row| {
            let (action, factors) = match row.env() {
                Ok(env) => {
                    let spec = env.spec();
                    (spec.action_space.describe(), spec.variation_space.factors().len().to_string())
                }
                Err(error) => {
                    missing.insert(error.to_string());
                    ("missing".to_owned(), String::new())
                }
            };
            vec![
                row.id.to_owned(),
                action,
                factors,
                row.experts.iter().map(|e| e.id).collect::<Vec<_>>().join(", "),
                row.summary.to_owned(),
            ]
        })
        .collect();
    emit(&table(&["environment", "action", "factors", "experts", "task"], rows));
    missing.iter().for_each(|error| complain(&format!("missing: {error}\n")));
    emit("\nand every environment of Gymnasium, such as\n");
    emit(&table(
        &["environment", "what it is"],
        gym::EXAMPLES.iter().map(|(id, what)| vec![(*id).to_owned(), (*what).to_owned()]),
    ));
    Ok(())
}

/// Shows one environment: its options, cameras, columns and experts.
fn show(choice: &EnvChoice, as_json: bool) -> anyhow::Result<()> {
    let (row, env) = (&choice.entry, choice.env()?);
    let spec = env.spec();
    if as_json {
        return emit_json(&describe(row, spec));
    }
    let list = |words: Vec<String>| if words.is_empty() { "none".to_owned() } else { words.join(", ") };
    let columns =
        spec.columns.iter().map(|column| format!("{} {}{:?}", column.name, column.dtype.name(), column.shape));
    let mut rows = vec![
        vec!["task".to_owned(), row.summary.to_owned()],
        vec!["action".to_owned(), spec.action_space.describe()],
        vec!["columns".to_owned(), list(columns.collect())],
        vec!["steps".to_owned(), spec.max_episode_steps.to_string()],
        vec!["factors".to_owned(), format!("{} (`swm fovs {}`)", spec.variation_space.factors().len(), spec.id)],
        vec!["cameras".to_owned(), list(spec.cameras.clone())],
    ];
    rows.extend(row.options.iter().map(|option| {
        let values = option.values.join(", ");
        vec![
            format!("option {}", option.key),
            format!("{}: {values} (now {})", option.summary, choice.choices.get(option.key)),
        ]
    }));
    rows.extend(row.experts.iter().map(|e| vec![format!("expert {}", e.id), e.summary.to_owned()]));
    emit(&table(&[&spec.id, ""], rows));
    Ok(())
}

/// Lists the factors of variation of one environment.
pub fn fovs(args: &FovsArgs, as_json: bool) -> anyhow::Result<()> {
    let env = swm::env(&args.env)?.env()?;
    let space = &env.spec().variation_space;
    if as_json {
        return emit_json(&json!({
            "variation": variation(space),
            "sampling_order": sampling_order(space),
            "default_variations": space.defaults(),
        }));
    }
    let rows = space.factors().iter().map(|factor| {
        vec![
            factor.key.clone(),
            factor.space.describe(),
            factor.space.written(&factor.init_value),
            if space.defaults().contains(&factor.key) { "sampled".to_owned() } else { String::new() },
        ]
    });
    emit(&table(&["factor", "values", "default", "at reset"], rows));
    Ok(())
}

/// One environment, with the fields a Python user knows.
fn describe(row: &EnvEntry, spec: &EnvSpec) -> Value {
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
        "summary": row.summary,
        "action_space": space(&spec.action_space),
        "observation_space": observation(spec),
        "info": info,
        "variation": variation(&spec.variation_space),
        "sampling_order": sampling_order(&spec.variation_space),
        "default_variations": spec.variation_space.defaults(),
        "max_episode_steps": spec.max_episode_steps,
        "cameras": spec.cameras,
        "options": row.options.iter().map(|o| json!({"key": o.key, "summary": o.summary, "values": o.values})).collect::<Vec<_>>(),
        "experts": row.experts.iter().map(|e| json!({"id": e.id, "summary": e.summary})).collect::<Vec<_>>(),
    })
}

/// What an agent observes: a space, or several by name.
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

/// Every factor by its key.
fn variation(variation_space: &VariationSpace) -> Map<String, Value> {
    let factors = variation_space.factors().iter();
    factors
        .map(|factor| {
            let mut value = space(&factor.space);
            value["init_value"] = shaped(&factor.space, &factor.init_value);
            (factor.key.clone(), value)
        })
        .collect()
}

/// Groups and factors, in the order they are sampled.
fn sampling_order(variation_space: &VariationSpace) -> Vec<String> {
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

/// A space with its bounds written out.
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

/// A value as a scalar or as lists within lists, in whole numbers where its type is whole; null where there is no bound.
#[allow(clippy::cast_possible_truncation)]
fn shaped(space: &Space, value: &[f64]) -> Value {
    let whole = matches!(space, Space::Discrete { .. } | Space::MultiDiscrete { .. } | Space::Rgb);
    let mut values: Vec<Value> = value.iter().map(|&v| if whole { json!(v as i64) } else { json!(v) }).collect();
    for &size in space.shape().iter().rev() {
        values = values.chunks(size.max(1)).map(|row| Value::Array(row.to_vec())).collect();
    }
    values.pop().unwrap_or_default()
}
