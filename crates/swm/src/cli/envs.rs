//! `swm envs` and `swm fovs`: list environments and their factors of variation.

use super::{emit, emit_json, eprint, table};
use crate::{ENVS, describe, gym, mujoco, zoo};
use clap::Args;
use serde_json::{Map, Value, json};
use swm_core::{EnvChoice, ExpertEntry, Origin};
use swm_mujoco::assets::Status;

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
    // From the registry alone: to make a MuJoCo environment, its model is compiled.
    let trained = zoo::experts();
    let rows = ENVS.rows.iter().map(|row| {
        let named = |expert: &ExpertEntry| match expert.tasks {
            [] => expert.id.to_owned(),
            tasks => format!("{},task={}", expert.id, tasks.join("|")),
        };
        let mut experts: Vec<String> = row.experts.iter().map(named).collect();
        if experts.is_empty() {
            let options = trained.iter().filter_map(|(_, env)| env.strip_prefix(row.id));
            experts.extend(options.map(|options| format!("expert{options}")));
        }
        vec![row.id.to_owned(), experts.join("; "), row.summary.to_owned()]
    });
    emit(&table(&["environment", "experts", "task"], rows));
    emit("\n`swm envs ENV` shows actions, columns, options and cameras, `swm fovs ENV` the factors of variation.\n");
    let missing: Vec<&str> =
        mujoco::assets::status().filter(|(_, status)| *status == Status::Absent).map(|(asset, _)| asset.name).collect();
    if !missing.is_empty() {
        let names = missing.join(", ");
        eprint(&format!("3-D environments need assets that are not installed ({names}): run `swm assets install`\n"));
    }
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
    if let Some(trained) = zoo::trained_expert(row, &spec.id, "expert") {
        rows.push(vec!["expert".to_owned(), format!("trained by interaction: {trained} (`swm zoo`)")]);
    }
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
