//! `swm models`: what can be trained, and at which sizes.

use super::{emit, emit_json, table};
use serde_json::json;
use swm_models::PRESETS;

/// The model families of this build.
pub const MODELS: &[(&str, &str)] = &[
    ("lewm", "LeWorldModel: encoder and predictor trained end to end, kept from collapsing by SIGReg"),
    (
        "inverse",
        "inverse dynamics on the frozen encoder of another checkpoint: acts without planning, the cheap baseline",
    ),
];

/// The presets of a family: ids and summaries.
fn presets(family: &str) -> Vec<(&'static str, &'static str)> {
    match family {
        "lewm" => PRESETS.iter().map(|preset| (preset.id, preset.summary)).collect(),
        _ => vec![("–", "trains in seconds on two CPU cores, given --encoder")],
    }
}

/// Lists them.
pub fn models(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all = MODELS.iter().map(|(id, summary)| {
            let presets = presets(id).into_iter().map(|(id, summary)| json!({"id": id, "summary": summary}));
            ((*id).to_owned(), json!({"summary": summary, "presets": presets.collect::<Vec<_>>()}))
        });
        return emit_json(&all.collect::<serde_json::Map<_, _>>());
    }
    let rows = MODELS.iter().flat_map(|(id, _)| {
        presets(id).into_iter().map(|(preset, summary)| vec![(*id).to_owned(), preset.to_owned(), summary.to_owned()])
    });
    emit(&table(&["model", "preset", "size"], rows));
    Ok(())
}
