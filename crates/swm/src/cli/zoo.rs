//! `swm zoo`: lists the capsules that `zoo:NAME` finds.

use super::{capsules, emit, emit_json, table};
use crate::zoo;
use serde_json::{Value, json};

/// Lists the capsules of the zoo. A damaged capsule has an error instead of a description.
pub fn zoo(as_json: bool) -> anyhow::Result<()> {
    let rows = zoo::capsules().into_iter().map(|(name, path)| {
        let mut row = capsules::describe(&path).unwrap_or_else(|error| json!({"error": error.to_string()}));
        row["name"] = json!(name);
        row["path"] = json!(path);
        row
    });
    let rows: Vec<Value> = rows.collect();
    if as_json {
        return emit_json(&rows);
    }
    if rows.is_empty() {
        emit("no capsules; `swm checkpoints pack` writes one, and docs/zoo.md says which folders are searched\n");
        return Ok(());
    }
    let text = |value: &Value| value.as_str().unwrap_or("–").to_owned();
    let lines = rows.iter().map(|row| {
        let name = format!("{}{}", zoo::PREFIX, text(&row["name"]));
        if let Some(error) = row["error"].as_str() {
            return vec![name, error.to_owned()];
        }
        vec![
            name,
            text(&row["family"]),
            text(&row["env"]),
            capsules::success(&row["evaluation"]).unwrap_or("–".to_owned()),
            format!("{} kB", row["bytes"].as_u64().unwrap_or_default() / 1000),
            text(&row["licence"]),
            text(&row["hash"]).chars().take(12).collect(),
        ]
    });
    emit(&table(&["capsule", "model", "environment", "success [95 %]", "size", "licence", "hash"], lines));
    Ok(())
}
