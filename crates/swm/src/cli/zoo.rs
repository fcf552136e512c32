//! `swm zoo`: lists the capsules that `zoo:NAME` finds.

use super::capsules::{CapsuleInfo, EvaluationInfo};
use super::{emit, emit_json, table};
use crate::zoo;
use serde_json::json;
use std::path::PathBuf;
use swm_core::Result;

/// Lists the capsules of the zoo. A damaged capsule has an error instead of a description.
pub fn zoo(as_json: bool) -> anyhow::Result<()> {
    let found = zoo::capsules().into_iter().map(|(name, path)| (name, CapsuleInfo::read(&path), path));
    let found: Vec<(String, Result<CapsuleInfo>, PathBuf)> = found.collect();
    if as_json {
        let rows = found.iter().map(|(name, info, path)| {
            let mut row = match info {
                Ok(info) => json!(info),
                Err(error) => json!({"error": error.to_string()}),
            };
            row["name"] = json!(name);
            row["path"] = json!(path.to_string_lossy());
            row
        });
        return emit_json(&rows.collect::<Vec<_>>());
    }
    let missing = zoo::in_data_wheel();
    if found.is_empty() && missing.is_empty() {
        emit("no capsules; `swm checkpoints pack` writes one, and docs/zoo.md says which folders are searched\n");
        return Ok(());
    }
    let lines = found.iter().map(|(name, info, _)| {
        let mut line = vec![format!("{}{name}", zoo::PREFIX)];
        line.extend(match info {
            Ok(info) => cells(info),
            Err(error) => vec![error.to_string()],
        });
        line
    });
    emit(&table(&["capsule", "model", "environment", "success [95 %]", "starts and goals", "size", "hash"], lines));
    if !missing.is_empty() {
        let names: Vec<String> = missing.iter().map(|name| format!("{}{name}", zoo::PREFIX)).collect();
        emit(&format!("not installed: {} ({})\n", names.join(", "), zoo::INSTALL_ALL));
    }
    Ok(())
}

/// Returns the cells of a capsule, after its name.
fn cells(info: &CapsuleInfo) -> Vec<String> {
    let or_none = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
    vec![
        info.family.clone(),
        or_none(info.env.clone()),
        or_none(info.evaluation.as_ref().map(EvaluationInfo::measured)),
        or_none(info.evaluation.as_ref().map(EvaluationInfo::starts)),
        format!("{} kB", info.bytes / 1000),
        info.hash.chars().take(12).collect(),
    ]
}
