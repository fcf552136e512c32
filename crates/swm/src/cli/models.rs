//! `swm models`: what can be trained, and at which sizes.

use super::{emit, emit_json, table};
use serde_json::json;
use swm_models::PRESETS;

/// The model families of this build.
pub const MODELS: &[(&str, &str)] =
    &[("lewm", "LeWorldModel: encoder and predictor trained end to end, kept from collapsing by SIGReg")];

/// Lists them.
pub fn models(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all = MODELS.iter().map(|(id, summary)| {
            let presets = PRESETS.iter().map(|preset| json!({"id": preset.id, "summary": preset.summary}));
            ((*id).to_owned(), json!({"summary": summary, "presets": presets.collect::<Vec<_>>()}))
        });
        return emit_json(&all.collect::<serde_json::Map<_, _>>());
    }
    let rows = MODELS.iter().flat_map(|(id, _)| {
        PRESETS.iter().map(|preset| vec![(*id).to_owned(), preset.id.to_owned(), preset.summary.to_owned()])
    });
    emit(&table(&["model", "preset", "size"], rows));
    Ok(())
}
