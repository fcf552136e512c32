//! `swm models`: lists the model families and their presets.

use super::{emit, emit_json, table};
use serde_json::json;
use swm_models::FAMILIES;

/// Lists the model families and their presets.
pub fn models(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all = FAMILIES.rows.iter().map(|family| {
            let presets: Vec<_> =
                family.presets.iter().map(|preset| json!({"id": preset.id, "summary": preset.summary})).collect();
            (family.id.to_owned(), json!({"summary": family.summary, "presets": presets}))
        });
        return emit_json(&all.collect::<serde_json::Map<_, _>>());
    }
    let rows = FAMILIES.rows.iter().flat_map(|family| {
        let preset = |preset: &swm_models::train::Preset| {
            vec![family.id.to_owned(), preset.id.to_owned(), preset.summary.to_owned()]
        };
        family.presets.iter().map(preset)
    });
    emit(&table(&["model", "preset", "size"], rows));
    for family in FAMILIES.rows {
        emit(&format!("\n{}: {}", family.id, family.summary));
    }
    emit("\n");
    Ok(())
}
