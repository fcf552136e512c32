//! `meta/info.json`: the features of a dataset and the templates of its file names.

use crate::formats::opened;
use serde::de::{MapAccess, Visitor};
use serde::ser::SerializeMap as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::columns::{EPISODE_IDX, PIXELS, PROPRIO, STATE, STEP_IDX};
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema, check_column_count, files};

/// The LeRobot version of written datasets.
pub const VERSION: &str = "v3.0";

/// The largest length of the path of a file and of its template, in bytes.
const LONGEST_PATH: usize = 4096;

/// Path template of data files in version 3.0.
pub const DATA_PATH: &str = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet";
/// Path template of videos in version 3.0.
pub const VIDEO_PATH: &str = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4";
/// Path template of the list of episodes in version 3.0.
pub const EPISODES_PATH: &str = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet";

/// The limit of the size of a text file in `meta/`, in bytes.
pub const MAX_TEXT_BYTES: u64 = 1 << 30;

/// The content of `meta/info.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Info {
    pub codebase_version: String,
    #[serde(default)]
    pub robot_type: Option<String>,
    pub total_episodes: usize,
    pub total_frames: usize,
    #[serde(default)]
    pub total_tasks: usize,
    #[serde(default = "default_chunks_size")]
    pub chunks_size: usize,
    #[serde(default = "default_file_size_in_mb")]
    pub data_files_size_in_mb: usize,
    #[serde(default = "default_file_size_in_mb")]
    pub video_files_size_in_mb: usize,
    pub fps: serde_json::Number,
    #[serde(default)]
    pub splits: BTreeMap<String, String>,
    pub data_path: String,
    #[serde(default)]
    pub video_path: Option<String>,
    pub features: Features,
    /// Metadata that only this project's writer adds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stable_worldmodel: Option<WriterMetadata>,
}

fn default_chunks_size() -> usize {
    1000
}

fn default_file_size_in_mb() -> usize {
    100
}

/// Metadata that only this project's writer adds to `meta/info.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct WriterMetadata {
    pub schema: Schema,
    pub manifest: Option<Manifest>,
    /// Whether the last action of an episode is a copy of the previous action and stands for a missing action.
    pub last_action_repeats: bool,
    /// How often the dataset was replaced by another one at its path.
    #[serde(default, skip_serializing_if = "opened::is_zero")]
    pub replaced: u64,
}

/// Features by name, in file order. The first camera becomes the column `pixels`.
#[derive(Clone, Debug, Default)]
pub struct Features(pub Vec<(String, Feature)>);

/// The description of a feature, LeRobot's word for a column.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Feature {
    pub dtype: String,
    pub shape: Vec<usize>,
    #[serde(default)]
    pub names: Value,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub info: Option<Value>,
}

impl Serialize for Features {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (name, feature) in &self.0 {
            map.serialize_entry(name, feature)?;
        }
        map.end()
    }
}

impl<'de> Deserialize<'de> for Features {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Entries;
        impl<'de> Visitor<'de> for Entries {
            type Value = Features;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("features by name")
            }

            fn visit_map<M: MapAccess<'de>>(self, mut map: M) -> Result<Features, M::Error> {
                let mut entries = vec![];
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(Features(entries))
            }
        }
        deserializer.deserialize_map(Entries)
    }
}

/// Storage of the values of a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Numeric values in the data files.
    Values,
    /// Encoded images in the data files.
    Images,
    /// Frames in videos. Holds the index of the column among the video features.
    Video(usize),
}

/// A column as readers return it.
#[derive(Clone, Debug)]
pub struct Column {
    pub spec: ColumnSpec,
    /// Name of the feature.
    pub native: String,
    pub kind: Kind,
}

impl Info {
    /// How often the dataset was replaced by another one at its path, if this project wrote it.
    pub fn replaced(&self) -> u64 {
        self.stable_worldmodel.as_ref().map_or(0, |recorded| recorded.replaced)
    }

    /// Reads `meta/info.json` of a dataset.
    ///
    /// # Errors
    /// If the file is missing or damaged, or the version is not supported.
    pub fn read(root: &Path) -> Result<Self> {
        let path = root.join("meta").join("info.json");
        if !files::exists(&path)? {
            let problem = if files::exists(root)? { "it holds no meta/info.json" } else { "there is no such dataset" };
            return Err(Error::corrupt(root, problem, "check the path; `swm datasets` lists the stored datasets"));
        }
        let bytes = files::read(&path, MAX_TEXT_BYTES)?;
        let info: Self = serde_json::from_slice(&bytes).map_err(|e| damaged(&path, format!("is unreadable: {e}")))?;
        if !info.is_v3() && info.codebase_version != "v2.1" && info.codebase_version != "v2.0" {
            let problem = format!("LeRobot's version {} is not supported", info.codebase_version);
            return Err(Error::corrupt(&path, problem, "convert it with LeRobot's own tools to v2.1 or v3.0"));
        }
        if info.chunks_size == 0 || info.fps().is_none() {
            return Err(damaged(&path, "its chunks_size or fps is invalid".to_owned()));
        }
        Ok(info)
    }

    pub fn is_v3(&self) -> bool {
        self.codebase_version == VERSION
    }

    /// Frames per second, if valid.
    pub fn fps(&self) -> Option<f64> {
        self.fps.as_f64().filter(|fps| fps.is_finite() && *fps > 0.0)
    }

    /// Names of the video features.
    pub fn video_keys(&self) -> Vec<&str> {
        self.features.0.iter().filter(|(_, feature)| feature.dtype == "video").map(|(name, _)| name.as_str()).collect()
    }

    /// The columns of the dataset. Features with text or without elements are skipped.
    ///
    /// # Errors
    /// If there are too many features, or the shape of one is invalid.
    pub fn columns(&self, root: &Path) -> Result<Vec<Column>> {
        check_column_count(self.features.0.len())?;
        let (mut columns, mut videos, mut primary) = (vec![], 0, true);
        for (native, feature) in &self.features.0 {
            let recorded = self.stable_worldmodel.as_ref().and_then(|recorded| {
                let columns = recorded.schema.columns().iter();
                columns.clone().find(|column| native_name(column, &recorded.schema) == *native)
            });
            let camera = feature.dtype == "video" || feature.dtype == "image";
            let (spec, kind) = if camera {
                let (height, width) = feature.size().ok_or_else(|| {
                    damaged(
                        root,
                        format!("the shape {:?} of the camera '{native}' is not that of an RGB image", feature.shape),
                    )
                })?;
                let name = if std::mem::take(&mut primary) { PIXELS } else { native };
                let kind = if feature.dtype == "video" { Kind::Video(videos) } else { Kind::Images };
                videos += usize::from(feature.dtype == "video");
                (ColumnSpec::image(name, height, width), kind)
            } else {
                let Some(dtype) = feature.column_dtype() else { continue };
                let name = if native == "observation.state" { PROPRIO } else { native };
                let shape = if feature.shape == [1] { vec![] } else { feature.shape.clone() };
                (ColumnSpec::new(name, dtype, shape), Kind::Values)
            };
            let spec = match recorded {
                Some(known) if feature.is_stored_as(known, &spec) => known.clone(),
                Some(known) => return Err(feature.contradicts(known, native, root)),
                // The writer of this format adds features that are not in the schema passed to it.
                _ if self.stable_worldmodel.is_some() => continue,
                _ => spec,
            };
            let is_index = native == "episode_index" || native == "frame_index";
            let too_large =
                spec.shape.iter().try_fold(1_usize, |n, &side| n.checked_mul(side)).is_none_or(|n| n > 1 << 28);
            if too_large {
                return Err(damaged(
                    root,
                    format!("the shape {:?} of the feature '{native}' is too large", feature.shape),
                ));
            }
            if !is_index && !spec.is_empty() {
                columns.push(Column { spec, native: native.clone(), kind });
            }
        }
        if let Some(recorded) = &self.stable_worldmodel {
            let is_index = |column: &ColumnSpec| [EPISODE_IDX, STEP_IDX].contains(&column.name.as_str());
            let is_read = |spec: &ColumnSpec| columns.iter().any(|column| column.spec.name == spec.name);
            let mut stored = recorded.schema.columns().iter().filter(|spec| !is_index(spec) && !spec.is_empty());
            if let Some(missing) = stored.find(|spec| !is_read(spec)) {
                return Err(damaged(root, format!("the recorded column '{}' has no feature", missing.name)));
            }
            let position = |column: &Column| recorded.schema.find(&column.spec.name);
            columns.sort_by_key(position);
        }
        Ok(columns)
    }

    /// The path of a file: `template` with the key and the indices filled in.
    ///
    /// # Errors
    /// If the path is too long, or leaves the dataset's folder.
    pub fn file(&self, root: &Path, template: &str, key: &str, indices: &[(&str, usize)]) -> Result<PathBuf> {
        let name = if template.len() > LONGEST_PATH { String::new() } else { fill(template, key, indices) };
        if template.len().max(name.len()) > LONGEST_PATH {
            return Err(damaged(root, format!("the path of a file has more than {LONGEST_PATH} bytes")));
        }
        let inside = Path::new(&name).components().all(|part| matches!(part, std::path::Component::Normal(_)));
        if inside {
            Ok(root.join(name))
        } else {
            Err(damaged(root, format!("the path '{name}' leads outside the dataset's folder")))
        }
    }
}

impl Feature {
    /// Height and width of a camera's images, from the names of the axes or, without names, from the position of the
    /// colour axis.
    fn size(&self) -> Option<(usize, usize)> {
        let [a, b, c] = self.shape[..] else { return None };
        let named = |name: &str| self.names.as_array()?.iter().position(|found| found.as_str() == Some(name));
        let sides = match (named("height"), named("width")) {
            (Some(height), Some(width)) => (*self.shape.get(height)?, *self.shape.get(width)?),
            _ if c == 3 || c == 1 => (a, b),
            _ if a == 3 || a == 1 => (b, c),
            _ => return None,
        };
        (sides.0 > 0 && sides.1 > 0 && sides.0 < 1 << 16 && sides.1 < 1 << 16).then_some(sides)
    }

    /// Whether the feature, read as `spec`, is that of a recorded column.
    fn is_stored_as(&self, known: &ColumnSpec, spec: &ColumnSpec) -> bool {
        let camera = spec.is_image();
        known.len() == spec.len() && known.is_image() == camera && (camera || known.dtype == spec.dtype)
    }

    /// The error of a feature that differs from its recorded column.
    fn contradicts(&self, known: &ColumnSpec, native: &str, root: &Path) -> Error {
        let recorded = format!("its recorded column {} {:?}", known.dtype.name(), known.shape);
        damaged(root, format!("the feature '{native}' is {} {:?}, {recorded}", self.dtype, self.shape))
    }

    /// The column type for the feature's values, or `None` for text. Only `uint64` values from 2^63 on do not fit.
    fn column_dtype(&self) -> Option<DType> {
        Some(match self.dtype.as_str() {
            "bool" => DType::Bool,
            "uint8" => DType::U8,
            "int8" | "int16" | "uint16" | "int32" => DType::Int32,
            "uint32" | "int64" | "uint64" => DType::Int64,
            "float16" | "float32" => DType::Float32,
            "float64" => DType::Float64,
            _ => return None,
        })
    }
}

/// Name of the feature that stores a column.
pub fn native_name(column: &ColumnSpec, schema: &Schema) -> String {
    let state = if schema.find(PROPRIO).is_some() { PROPRIO } else { STATE };
    match &*column.name {
        name if column.is_image() => format!("observation.images.{name}"),
        name if name == state => "observation.state".to_owned(),
        name => name.to_owned(),
    }
}

/// The error for an inconsistent dataset.
pub fn damaged(path: &Path, problem: String) -> Error {
    Error::corrupt(path, problem, "restore it from a copy, or rebuild the dataset")
}

/// Fills a key and indices into a path template in Python's format notation.
pub fn fill(template: &str, key: &str, indices: &[(&str, usize)]) -> String {
    let mut filled = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once('{') {
        filled.push_str(before);
        let (field, after) = after.split_once('}').unwrap_or((after, ""));
        let (name, form) = field.split_once(':').unwrap_or((field, ""));
        if name == "video_key" || name == "image_key" {
            filled.push_str(key);
        } else if let Some((_, index)) = indices.iter().find(|(known, _)| *known == name) {
            // `form` is a format such as `03d`.
            let width = form.trim_end_matches('d').trim_start_matches('0').parse::<usize>().unwrap_or(0).min(20);
            filled.push_str(&format!("{index:0width$}"));
        }
        rest = after;
    }
    filled.push_str(rest);
    filled
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fills_path_templates() {
        let indices = [("chunk_index", 2), ("file_index", 1234)];
        assert_eq!(
            fill(VIDEO_PATH, "observation.images.top", &indices),
            "videos/observation.images.top/chunk-002/file-1234.mp4"
        );
        assert_eq!(fill("a{unknown}b{", "", &indices), "ab");
    }
}
