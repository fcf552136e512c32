//! How our columns become Lance columns, and back.

use arrow_schema::{DataType, Field, Schema as ArrowSchema};
use lance_core::datatypes::Schema as LanceSchema;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema, columns};
use swm_image::{self, ImageCodec};

/// The columns that number episodes and steps; the writer fills them.
pub const EPISODE: &str = "episode_idx";
/// See [`EPISODE`].
pub const STEP: &str = "step_idx";

/// Metadata keys of the table.
const SCHEMA_KEY: &str = "stable_worldmodel.schema";
/// See [`SCHEMA_KEY`].
pub const MANIFEST_KEY: &str = "stable_worldmodel.manifest";

/// What we record beside the data, so that types and shapes come back as they were.
#[derive(Serialize, Deserialize)]
struct Recorded {
    columns: Schema,
    codec: ImageCodec,
}

/// How one of our columns is stored.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredColumn {
    /// The column as readers see it.
    pub spec: ColumnSpec,
    /// Its name in the table.
    pub name: String,
    /// What the table holds.
    pub kind: Kind,
}

/// What a table holds in a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Encoded pictures.
    Image,
    /// Numbers: a scalar, or a fixed-size list. Where they are written here, of this precision.
    Numbers(Precision),
}

/// What numbers are written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// `float32`, as the reference writes all numbers.
    Single,
    /// `float64`, so that nothing is rounded.
    Double,
}

impl Precision {
    fn of(dtype: DType) -> Self {
        if dtype == DType::Float64 { Self::Double } else { Self::Single }
    }

    fn data_type(self) -> DataType {
        match self {
            Self::Single => DataType::Float32,
            Self::Double => DataType::Float64,
        }
    }
}

/// The stored form of the columns an episode has; `episode_idx` and `step_idx` are left out.
///
/// # Errors
/// When two columns get the same name, or a column is empty.
pub fn columns_to_write(schema: &Schema) -> Result<Vec<StoredColumn>> {
    let mut columns: Vec<StoredColumn> = vec![];
    for spec in schema.columns() {
        // Lance reads a dot as a path into a structure.
        let name = columns::flat(&spec.name);
        if name == EPISODE || name == STEP {
            continue;
        }
        if let Some(other) = columns.iter().find(|other| other.name == name) {
            return Err(Error::config(
                "schema",
                format!("columns '{}' and '{}' would both be stored as '{name}'", other.spec.name, spec.name),
                "rename one of them",
            ));
        }
        if spec.is_empty() {
            return Err(Error::config("schema", format!("column '{}' holds no number", spec.name), "leave it out"));
        }
        let kind = if spec.is_image() { Kind::Image } else { Kind::Numbers(Precision::of(spec.dtype)) };
        columns.push(StoredColumn { spec: spec.clone(), name, kind });
    }
    if columns.is_empty() {
        return Err(Error::config("schema", "it has no columns", "an episode needs at least one"));
    }
    Ok(columns)
}

/// The table's columns in Arrow's terms.
pub fn arrow_schema(columns: &[StoredColumn]) -> ArrowSchema {
    let mut fields = vec![Field::new(EPISODE, DataType::Int32, true), Field::new(STEP, DataType::Int32, true)];
    for column in columns {
        fields.push(match column.kind {
            Kind::Image => Field::new(&column.name, DataType::Binary, true).with_metadata(plain_values()),
            #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
            Kind::Numbers(precision) => {
                let list = DataType::FixedSizeList(list_item(precision), column.spec.len() as i32);
                Field::new(&column.name, list, true)
            }
        });
    }
    ArrowSchema::new(fields)
}

/// How Lance is to store pictures: as they are, since they are compressed already; each on its own, unless a few stand
/// for many, such as the goals of episodes.
fn plain_values() -> HashMap<String, String> {
    let settings = [("lance-encoding:compression", "none"), ("lance-encoding:dict-size-ratio", "0.25")];
    settings.map(|(key, value)| (key.to_owned(), value.to_owned())).into()
}

/// The field of a list's numbers.
pub fn list_item(precision: Precision) -> Arc<Field> {
    Arc::new(Field::new("item", precision.data_type(), true))
}

/// What a table holds in a column of numbers that is to be continued.
pub fn stored_precision(data_type: &DataType) -> Option<Precision> {
    match data_type {
        DataType::FixedSizeList(item, _) if *item.data_type() == DataType::Float32 => Some(Precision::Single),
        DataType::FixedSizeList(item, _) if *item.data_type() == DataType::Float64 => Some(Precision::Double),
        _ => None,
    }
}

/// The table's metadata.
///
/// # Errors
/// When the manifest cannot be written as JSON.
pub fn metadata(schema: &Schema, codec: ImageCodec, manifest: Option<&Manifest>) -> Result<HashMap<String, String>> {
    let recorded = Recorded { columns: schema.clone(), codec };
    let mut metadata = HashMap::from([(SCHEMA_KEY.to_owned(), json(&recorded)?)]);
    if let Some(manifest) = manifest {
        metadata.insert(MANIFEST_KEY.to_owned(), json(manifest)?);
    }
    Ok(metadata)
}

/// A value as JSON.
pub fn json(value: &impl Serialize) -> Result<String> {
    serde_json::to_string(value).map_err(|e| Error::external("describing the dataset", e))
}

/// The manifest in a table's metadata.
pub fn manifest(lance: &LanceSchema) -> Option<Manifest> {
    serde_json::from_str(lance.metadata.get(MANIFEST_KEY)?).ok()
}

/// The codec with which a table was begun.
pub fn codec(lance: &LanceSchema) -> Option<ImageCodec> {
    serde_json::from_str::<Recorded>(lance.metadata.get(SCHEMA_KEY)?).ok().map(|recorded| recorded.codec)
}

/// The columns of a table: as recorded where it was written here, else inferred. Text and nested columns of
/// foreign tables are left out. Comes with the schema that readers see, which begins with `episode_idx` and
/// `step_idx`.
///
/// `first_picture` gives the first stored picture of a column, for its size; `None` where there are no rows.
///
/// # Errors
/// When the table has no `episode_idx`, or its columns contradict what was recorded.
pub fn columns_to_read(
    folder: &Path,
    lance: &LanceSchema,
    first_picture: impl Fn(&str) -> Result<Option<Vec<u8>>>,
) -> Result<(Vec<StoredColumn>, Schema)> {
    let arrow = ArrowSchema::from(lance);
    for name in [EPISODE, STEP] {
        let field = arrow.field_with_name(name).ok();
        if !field.is_some_and(|field| field.data_type().is_integer()) {
            return Err(Error::corrupt(
                folder,
                format!("the table has no integer column '{name}'"),
                "only tables of episodes can be read: one row a step, numbered by episode_idx and step_idx",
            ));
        }
    }
    let recorded: Option<Recorded> = match lance.metadata.get(SCHEMA_KEY) {
        None => None,
        Some(text) => Some(
            serde_json::from_str(text)
                .map_err(|e| super::store::damaged(folder, format!("its recorded schema is unreadable: {e}")))?,
        ),
    };
    let mut columns = vec![];
    for field in arrow.fields() {
        let name = field.name();
        if name == EPISODE || name == STEP {
            continue;
        }
        let known = recorded
            .as_ref()
            .and_then(|recorded| recorded.columns.columns().iter().find(|spec| columns::flat(&spec.name) == *name));
        let contradiction = |held: &str| {
            super::store::damaged(folder, format!("column '{name}' holds {held}, unlike its recorded schema says"))
        };
        let (spec, kind) = match field.data_type() {
            DataType::Binary | DataType::LargeBinary => match known {
                Some(spec) if spec.is_image() => (spec.clone(), Kind::Image),
                Some(_) => return Err(contradiction("encoded pictures")),
                None => {
                    let Some(bytes) = first_picture(name)? else { continue };
                    // Binary columns of foreign tables need not be pictures.
                    let Ok((height, width)) = swm_image::image_size(&bytes) else { continue };
                    (ColumnSpec::image(name, height, width), Kind::Image)
                }
            },
            other => {
                let (item, shape) = match other {
                    DataType::FixedSizeList(item, n) => (item.data_type(), vec![usize::try_from(*n).unwrap_or(0)]),
                    scalar => (scalar, vec![]),
                };
                let Some(dtype) = number_type(item) else { continue };
                match known {
                    Some(spec) if !spec.is_image() && spec.len() == shape.iter().product::<usize>() => {
                        (spec.clone(), Kind::Numbers(Precision::of(dtype)))
                    }
                    Some(_) => return Err(contradiction(&format!("{other}"))),
                    None => (ColumnSpec::new(name, dtype, shape), Kind::Numbers(Precision::of(dtype))),
                }
            }
        };
        if !spec.is_empty() {
            columns.push(StoredColumn { spec, name: name.clone(), kind });
        }
    }
    // The numbers come first, with the type they were declared with where an episode carried them.
    let declared = |name| {
        let spec = recorded.as_ref()?.columns.columns().iter().find(|spec| spec.name == name)?;
        (spec.len() == 1 && !spec.is_image()).then(|| spec.clone())
    };
    let numbers = [EPISODE, STEP].map(|name| declared(name).unwrap_or_else(|| ColumnSpec::new(name, DType::Int32, [])));
    let visible: Vec<ColumnSpec> = numbers.into_iter().chain(columns.iter().map(|c| c.spec.clone())).collect();
    Ok((columns, Schema::new(visible)?))
}

/// The type that holds Arrow's numbers without loss.
fn number_type(data_type: &DataType) -> Option<DType> {
    Some(match data_type {
        DataType::Boolean => DType::Bool,
        DataType::UInt8 => DType::U8,
        DataType::Int8 | DataType::Int16 | DataType::UInt16 | DataType::Int32 => DType::Int32,
        DataType::UInt32 | DataType::Int64 | DataType::UInt64 => DType::Int64,
        DataType::Float16 | DataType::Float32 => DType::Float32,
        DataType::Float64 => DType::Float64,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_that_would_collide_are_refused() {
        let schema = |names: &[&str]| {
            let specs: Vec<ColumnSpec> = names.iter().map(|n| ColumnSpec::new(*n, DType::Float32, [])).collect();
            columns_to_write(&Schema::new(specs).expect("schema"))
        };
        let names: Vec<String> = schema(&["a.b", "step_idx", "c"]).expect("fine").into_iter().map(|c| c.name).collect();
        assert_eq!(names, ["a_b", "c"]);
        assert!(schema(&["a.b", "a_b"]).expect_err("collide").to_string().contains("'a.b' and 'a_b'"));
        assert!(schema(&["step_idx"]).expect_err("nothing left").to_string().contains("no columns"));
    }
}
