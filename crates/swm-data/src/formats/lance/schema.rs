//! Mapping between dataset columns and Lance columns.

use arrow_schema::{DataType, Field, Schema as ArrowSchema};
use lance_core::datatypes::Schema as LanceSchema;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema, columns};
use swm_image::{self, ImageCodec};

/// Key of the table's metadata: the [`RecordedSchema`] as JSON.
const SCHEMA_KEY: &str = "stable_worldmodel.schema";
/// Key of the table's metadata: the [`Manifest`] as JSON.
pub const MANIFEST_KEY: &str = "stable_worldmodel.manifest";

/// The schema in the table's metadata, from which readers restore types and shapes.
#[derive(Serialize, Deserialize)]
struct RecordedSchema {
    columns: Schema,
    codec: ImageCodec,
}

/// The stored form of a dataset column.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredColumn {
    /// The column as readers return it.
    pub spec: ColumnSpec,
    /// Name of the column in the table.
    pub name: String,
    /// Kind of the stored values.
    pub kind: Kind,
}

/// The kind of values in a table's column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Encoded images.
    Image,
    /// Numeric values: a scalar or a fixed-size list, with the precision to write.
    Values(Precision),
}

/// The stored type of numeric values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// `float32`, as the reference implementation writes all numeric columns.
    Single,
    /// `float64`, without rounding.
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

/// The stored columns of an episode, without the index columns.
///
/// # Errors
/// If two columns get the same stored name, a name is empty or has a '`', a column has no elements, or there are no columns.
pub fn columns_to_write(schema: &Schema) -> Result<Vec<StoredColumn>> {
    let mut columns: Vec<StoredColumn> = vec![];
    for spec in schema.columns() {
        // Lance interprets a dot as a path into a structure.
        let name = columns::flat(&spec.name);
        if name == EPISODE_IDX || name == STEP_IDX {
            continue;
        }
        if name.is_empty() || name.contains(['`', '\0']) {
            let problem =
                format!("the column name '{}' cannot be read back from a Lance table", spec.name.escape_debug());
            return Err(Error::config("schema", problem, "give the column a name without '`'"));
        }
        if let Some(other) = columns.iter().find(|other| other.name == name) {
            return Err(Error::config(
                "schema",
                format!("columns '{}' and '{}' would both be stored as '{name}'", other.spec.name, spec.name),
                "rename one of them",
            ));
        }
        if spec.is_empty() {
            return Err(Error::config("schema", format!("column '{}' has no elements", spec.name), "leave it out"));
        }
        let kind = if spec.is_image() { Kind::Image } else { Kind::Values(Precision::of(spec.dtype)) };
        columns.push(StoredColumn { spec: spec.clone(), name, kind });
    }
    if columns.is_empty() {
        return Err(Error::config("schema", "it has no columns", "give every episode at least one column"));
    }
    Ok(columns)
}

/// The Arrow schema of the table.
pub fn arrow_schema(columns: &[StoredColumn]) -> ArrowSchema {
    let mut fields = vec![Field::new(EPISODE_IDX, DataType::Int32, true), Field::new(STEP_IDX, DataType::Int32, true)];
    for column in columns {
        fields.push(match column.kind {
            Kind::Image => Field::new(&column.name, DataType::Binary, true).with_metadata(plain_values()),
            Kind::Values(precision) => {
                let list = DataType::FixedSizeList(list_item(precision), column.spec.len() as i32);
                Field::new(&column.name, list, true)
            }
        });
    }
    ArrowSchema::new(fields)
}

/// Field metadata for images: no compression, because they are already encoded, and a dictionary only if few distinct
/// images repeat often, such as the goals of episodes.
fn plain_values() -> HashMap<String, String> {
    let settings = [("lance-encoding:compression", "none"), ("lance-encoding:dict-size-ratio", "0.25")];
    settings.map(|(key, value)| (key.to_owned(), value.to_owned())).into()
}

/// The field of a list's elements.
pub fn list_item(precision: Precision) -> Arc<Field> {
    Arc::new(Field::new("item", precision.data_type(), true))
}

/// The precision of an existing numeric column.
pub fn stored_precision(data_type: &DataType) -> Option<Precision> {
    match data_type {
        DataType::FixedSizeList(item, _) if *item.data_type() == DataType::Float32 => Some(Precision::Single),
        DataType::FixedSizeList(item, _) if *item.data_type() == DataType::Float64 => Some(Precision::Double),
        _ => None,
    }
}

/// The metadata of a new table: schema, codec and manifest.
///
/// # Errors
/// If the metadata cannot be serialised as JSON.
pub fn metadata(schema: &Schema, codec: ImageCodec, manifest: Option<&Manifest>) -> Result<HashMap<String, String>> {
    let recorded = RecordedSchema { columns: schema.clone(), codec };
    let mut metadata = HashMap::from([(SCHEMA_KEY.to_owned(), json(&recorded)?)]);
    if let Some(manifest) = manifest {
        metadata.insert(MANIFEST_KEY.to_owned(), json(manifest)?);
    }
    Ok(metadata)
}

/// Serialises a value as JSON.
pub fn json(value: &impl Serialize) -> Result<String> {
    serde_json::to_string(value).map_err(|e| Error::external("describing the dataset", e))
}

/// The manifest in a table's metadata.
pub fn manifest(lance: &LanceSchema) -> Option<Manifest> {
    serde_json::from_str(lance.metadata.get(MANIFEST_KEY)?).ok()
}

/// The codec in a table's metadata.
pub fn codec(lance: &LanceSchema) -> Option<ImageCodec> {
    serde_json::from_str::<RecordedSchema>(lance.metadata.get(SCHEMA_KEY)?).ok().map(|recorded| recorded.codec)
}

/// The columns of a table, and the schema for readers, which starts with the index columns. Columns come from the
/// table's metadata if this module wrote the table, and are inferred from the stored types otherwise. Text and nested
/// columns of third-party tables are skipped.
///
/// `first_image` returns the first stored image of a column, or `None` if there are no rows. The header of this
/// image contains the image size.
///
/// # Errors
/// If the table has no index columns, or its columns contradict the recorded schema.
#[allow(clippy::too_many_lines, reason = "one case per kind of stored column")]
pub fn columns_to_read(
    folder: &Path,
    lance: &LanceSchema,
    first_image: impl Fn(&str) -> Result<Option<Vec<u8>>>,
) -> Result<(Vec<StoredColumn>, Schema)> {
    let arrow = ArrowSchema::from(lance);
    for name in [EPISODE_IDX, STEP_IDX] {
        let field = arrow.field_with_name(name).ok();
        if !field.is_some_and(|field| field.data_type().is_integer()) {
            return Err(Error::corrupt(
                folder,
                format!("the table has no integer column '{name}'"),
                "only tables of episodes can be read: one row per step, with episode_idx and step_idx",
            ));
        }
    }
    let recorded: Option<RecordedSchema> = match lance.metadata.get(SCHEMA_KEY) {
        None => None,
        Some(text) => Some(
            serde_json::from_str(text)
                .map_err(|e| super::errors::damaged(folder, format!("its recorded schema is unreadable: {e}")))?,
        ),
    };
    let mut columns = vec![];
    for field in arrow.fields() {
        let name = field.name();
        if name == EPISODE_IDX || name == STEP_IDX {
            continue;
        }
        let known = recorded
            .as_ref()
            .and_then(|recorded| recorded.columns.columns().iter().find(|spec| columns::flat(&spec.name) == *name));
        let contradiction = |found: &str| {
            super::errors::damaged(
                folder,
                format!("column '{name}' holds {found}, which contradicts the recorded schema"),
            )
        };
        let (spec, kind) = match field.data_type() {
            DataType::Binary | DataType::LargeBinary => match known {
                Some(spec) if spec.is_image() => (spec.clone(), Kind::Image),
                Some(_) => return Err(contradiction("encoded images")),
                None => {
                    let Some(bytes) = first_image(name)? else { continue };
                    // Binary columns of third-party tables may hold other data than images.
                    if !swm_image::is_image(&bytes) {
                        continue;
                    }
                    let (height, width) = swm_image::image_size(&bytes)
                        .map_err(|problem| super::errors::damaged(folder, format!("column '{name}': {problem}")))?;
                    (ColumnSpec::image(name, height, width), Kind::Image)
                }
            },
            other => {
                let (item, shape) = match other {
                    DataType::FixedSizeList(item, n) => (item.data_type(), vec![usize::try_from(*n).unwrap_or(0)]),
                    scalar => (scalar, vec![]),
                };
                let Some(dtype) = column_dtype(item) else { continue };
                match known {
                    Some(spec) if !spec.is_image() && spec.len() == shape.iter().product::<usize>() => {
                        (spec.clone(), Kind::Values(Precision::of(dtype)))
                    }
                    Some(_) => return Err(contradiction(&format!("{other}"))),
                    None => (ColumnSpec::new(name, dtype, shape), Kind::Values(Precision::of(dtype))),
                }
            }
        };
        if !spec.is_empty() {
            columns.push(StoredColumn { spec, name: name.clone(), kind });
        }
    }
    // Index columns come first, with their declared type if the written episodes contained them.
    let declared = |name| {
        let spec = recorded.as_ref()?.columns.columns().iter().find(|spec| spec.name == name)?;
        (spec.len() == 1 && !spec.is_image()).then(|| spec.clone())
    };
    let indices =
        [EPISODE_IDX, STEP_IDX].map(|name| declared(name).unwrap_or_else(|| ColumnSpec::new(name, DType::Int32, [])));
    let visible: Vec<ColumnSpec> = indices.into_iter().chain(columns.iter().map(|c| c.spec.clone())).collect();
    Ok((columns, Schema::new(visible)?))
}

/// The narrowest column type that holds Arrow's values without loss.
fn column_dtype(data_type: &DataType) -> Option<DType> {
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
    fn rejects_columns_with_the_same_stored_name() {
        let schema = |names: &[&str]| {
            let specs: Vec<ColumnSpec> = names.iter().map(|n| ColumnSpec::new(*n, DType::Float32, [])).collect();
            columns_to_write(&Schema::new(specs).expect("creating the schema"))
        };
        let names: Vec<String> = schema(&["a.b", "step_idx", "c"])
            .expect("creating the columns to write")
            .into_iter()
            .map(|c| c.name)
            .collect();
        assert_eq!(names, ["a_b", "c"]);
        assert!(
            schema(&["a.b", "a_b"])
                .expect_err("columns with equal stored names")
                .to_string()
                .contains("'a.b' and 'a_b'")
        );
        assert!(schema(&["step_idx"]).expect_err("a schema without columns").to_string().contains("no columns"));
    }
}
