//! The features of new datasets: the names and descriptions of the columns in `meta/info.json`.

use super::info::{DATA_PATH, Feature, Features, Info, VERSION, VIDEO_PATH, WriterMetadata, native_name};
use crate::dataset::WriteOptions;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{DType, Error, Result, Schema};

/// Frame rate of videos and timestamps, in frames per second. The rate is arbitrary, because simulated environments
/// have no common rate.
pub const FRAMES_PER_SECOND: u32 = 25;

/// Indices of the columns to store, with the names of their features.
pub fn stored_columns(schema: &Schema) -> Result<Vec<(usize, String)>> {
    let mut columns: Vec<(usize, String)> = vec![];
    for (index, column) in schema.columns().iter().enumerate() {
        let refuse = |problem: String, fix: &str| Err(Error::config("schema", problem, fix));
        if column.name == EPISODE_IDX || column.name == STEP_IDX {
            continue;
        }
        if column.is_empty() {
            return refuse(format!("column '{}' has no elements", column.name), "leave it out");
        }
        let native = native_name(column, schema);
        let reserved = ["timestamp", "frame_index", "episode_index", "index", "task_index", "task"];
        let invalid = native.contains(['/', '\\', '\0']) || native.starts_with('.');
        // Readers know these by their own names, which a camera could have.
        let is_index = ["frame_index", "episode_index"].contains(&&*column.name);
        if invalid || is_index || reserved.contains(&&*native) || columns.iter().any(|(_, other)| *other == native) {
            return refuse(format!("'{native}' is not a valid LeRobot feature name"), "rename the column");
        }
        columns.push((index, native));
    }
    if columns.is_empty() {
        return Err(Error::config("schema", "it has no columns", "give every episode at least one column"));
    }
    Ok(columns)
}

/// The content of `meta/info.json` of a dataset without episodes.
pub fn new_info(schema: &Schema, columns: &[(usize, String)], options: &WriteOptions) -> Info {
    let mut features: Vec<(String, Feature)> = columns
        .iter()
        .map(|(index, native)| {
            let column = &schema.columns()[*index];
            let feature = if column.is_image() {
                let names = json!(["height", "width", "channels"]);
                let details = json!({
                    "video.height": column.shape[0], "video.width": column.shape[1], "video.codec": "h264",
                    "video.fps": FRAMES_PER_SECOND, "video.channels": 3, "video.is_depth_map": false,
                    "has_audio": false,
                });
                Feature { dtype: "video".to_owned(), shape: column.shape.clone(), names, info: Some(details) }
            } else {
                // More than one axis would need Arrow extensions; the recorded schema restores the shape.
                let shape = vec![column.len()];
                Feature { dtype: column.dtype.name().to_owned(), shape, names: Value::Null, info: None }
            };
            (native.clone(), feature)
        })
        .collect();
    let mut add_required = |name: &str, dtype: DType| {
        let feature = Feature { dtype: dtype.name().to_owned(), shape: vec![1], names: Value::Null, info: None };
        features.push((name.to_owned(), feature));
    };
    add_required("timestamp", DType::Float32);
    ["frame_index", "episode_index", "index", "task_index"].iter().for_each(|name| add_required(name, DType::Int64));
    let cameras = columns.iter().any(|(index, _)| schema.columns()[*index].is_image());
    Info {
        codebase_version: VERSION.to_owned(),
        robot_type: None,
        total_episodes: 0,
        total_frames: 0,
        total_tasks: 0,
        chunks_size: 1000,
        data_files_size_in_mb: 100,
        video_files_size_in_mb: 200,
        fps: FRAMES_PER_SECOND.into(),
        splits: BTreeMap::new(),
        data_path: DATA_PATH.to_owned(),
        video_path: cameras.then(|| VIDEO_PATH.to_owned()),
        features: Features(features),
        stable_worldmodel: Some(WriterMetadata {
            schema: schema.clone(),
            manifest: options.manifest.clone(),
            last_action_repeats: true,
            replaced: 0,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::ColumnSpec;

    #[test]
    fn cameras_do_not_have_the_names_of_the_indices() {
        let schema = |name: &str| Schema::new(vec![ColumnSpec::new(name, DType::U8, [4, 4, 3])]).expect("a schema");
        assert_eq!(stored_columns(&schema("wrist")).expect("a camera").len(), 1);
        for name in ["frame_index", "episode_index"] {
            let error = stored_columns(&schema(name)).expect_err("an index").to_string();
            assert!(error.contains("rename the column"), "{error}");
        }
    }
}
