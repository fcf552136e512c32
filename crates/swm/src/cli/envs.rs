//! `swm envs` and `swm fovs`: what worlds there are and what can be varied in them.

use super::{complain, emit, emit_json, table};
use clap::Args;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use swm::{ENVS, describe, gym};
use swm_core::EnvChoice;

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
        return emit_json(&describe::env(row, spec));
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
