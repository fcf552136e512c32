//! `swm envs` and `swm fovs`: list environments and their factors of variation.

use super::{emit, emit_json, eprint, table};
use crate::{ENVS, describe, gym};
use clap::Args;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use swm_core::{EnvChoice, Origin};

/// Arguments of `swm envs`.
#[derive(Args)]
pub struct EnvsArgs {
    /// The environment to show, such as swm/TwoRoom-v1
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
        return show(&crate::env(id, &Origin::User)?, as_json);
    }
    if as_json {
        let all = ENVS.rows.iter().map(|row| match row.env() {
            Ok(env) => (row.id.to_owned(), describe::env(row, env.spec())),
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
    missing.iter().for_each(|error| eprint(&format!("missing: {error}\n")));
    emit("\nThird-party environments of Gymnasium work too, such as:\n");
    emit(&table(
        &["environment", "description"],
        gym::EXAMPLES.iter().map(|(id, description)| vec![(*id).to_owned(), (*description).to_owned()]),
    ));
    Ok(())
}

/// Shows one environment: its options, cameras, columns and experts.
fn show(choice: &EnvChoice, as_json: bool) -> anyhow::Result<()> {
    let (row, env) = (&choice.entry, choice.env()?);
    let spec = env.spec();
    if as_json {
        return emit_json(&describe::env(row, spec));
    }
    let list = |names: Vec<String>| if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    let columns =
        spec.columns.iter().map(|column| format!("{} {}{:?}", column.name, column.dtype.name(), column.shape));
    let mut rows = vec![
        vec!["task".to_owned(), row.summary.to_owned()],
        vec!["action".to_owned(), spec.action_space.describe()],
        vec!["columns".to_owned(), list(columns.collect())],
        vec!["time limit".to_owned(), format!("{} steps", spec.max_episode_steps)],
        vec!["factors".to_owned(), format!("{} (`swm fovs {}`)", spec.variation_space.factors().len(), spec.id)],
        vec!["cameras".to_owned(), list(spec.cameras.clone())],
    ];
    rows.extend(row.options.iter().map(|option| {
        let values = option.values.join(", ");
        vec![
            format!("option {}", option.key),
            format!("{}: {values} (chosen: {})", option.summary, choice.choices.get(option.key)),
        ]
    }));
    rows.extend(row.experts.iter().map(|e| vec![format!("expert {}", e.id), e.summary.to_owned()]));
    emit(&table(&[&spec.id, "value"], rows));
    Ok(())
}

/// Lists the factors of variation of one environment.
pub fn fovs(args: &FovsArgs, as_json: bool) -> anyhow::Result<()> {
    let env = crate::env(&args.env, &Origin::User)?.env()?;
    let space = &env.spec().variation_space;
    if as_json {
        return emit_json(&json!({
            "variation": describe::variation(space),
            "sampling_order": describe::sampling_order(space),
            "default_variations": space.defaults(),
        }));
    }
    let rows = space.factors().iter().map(|factor| {
        vec![
            factor.key.clone(),
            factor.space.describe(),
            factor.space.format_values(&factor.init_value),
            if space.defaults().contains(&factor.key) { "sampled".to_owned() } else { String::new() },
        ]
    });
    emit(&table(&["factor", "values", "default", "at reset"], rows));
    Ok(())
}
