//! What a model is told of a world before it has data of it.

use crate::nn::Named;
use crate::train::{ColumnInfo, DatasetInfo};
use swm_core::{EnvSpec, Error, Result, Space};
use swm_plan::ActionScale;

/// The dataset info of a world: the shapes of `columns`, and actions whose bounds are -1 and 1 in model units. Of the numbers in the
/// columns nothing is known yet: they keep their scale.
///
/// # Errors
/// When actions are not numbers between finite bounds, or the world does not observe a column.
pub fn dataset_info(spec: &EnvSpec, columns: &[String]) -> Result<DatasetInfo> {
    let action = bounded(spec)?;
    let known = |name: &String| {
        let column = spec.columns.iter().find(|column| column.name == *name).ok_or_else(|| {
            let known = spec.columns.iter().map(|column| column.name.as_str());
            Error::unknown("column of the world", name, known, format!("{} observes these", spec.id))
        })?;
        let same = |value: f64| vec![value; column.len()];
        let dataset_info =
            ColumnInfo { shape: column.shape.clone(), mean: same(0.0), std: same(1.0), min: same(0.0), max: same(0.0) };
        Ok((name.clone(), dataset_info))
    };
    // What the model is trained with but does not see is not the world's to show.
    let others = ["pixels", "action", "reward", "terminated"];
    let columns =
        columns.iter().filter(|name| !others.contains(&name.as_str())).map(known).collect::<Result<Named<_>>>()?;
    Ok(DatasetInfo { action, columns, env: Some(spec.id.clone()) })
}

#[allow(clippy::cast_possible_truncation)]
fn bounded(spec: &EnvSpec) -> Result<ActionScale> {
    let refused = |fix: &str| {
        let given = format!("its actions are {}", spec.action_space.describe());
        Err(Error::config(format!("playing in {}", spec.id), given, fix))
    };
    match &spec.action_space {
        Space::Box { low, high, .. } => {
            if low.iter().chain(high).any(|bound| !bound.is_finite()) {
                return refused("choose a world whose actions have bounds");
            }
            let of =
                |middle: f64| low.iter().zip(high).map(|(low, high)| ((high + middle * low) / 2.0) as f32).collect();
            Ok(ActionScale { mean: of(1.0), std: of(-1.0) })
        }
        _ => refused("choose a world of continuous actions (`swm envs` lists them)"),
    }
}
