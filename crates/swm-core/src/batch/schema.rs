//! Types and names of columns: [`DType`], [`ColumnSpec`], and [`Schema`], the columns of a batch in order.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::sync::Arc;

/// The type of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DType {
    /// True or false, one byte (0 or 1).
    Bool,
    /// 8-bit unsigned integers; an RGB image is `U8` with shape `[height, width, 3]`.
    U8,
    /// 32-bit signed integers.
    Int32,
    /// 64-bit signed integers.
    Int64,
    /// 32-bit floating point.
    Float32,
    /// 64-bit floating point.
    Float64,
}

impl DType {
    /// The number of bytes of one element.
    pub const fn size(self) -> usize {
        match self {
            Self::Bool | Self::U8 => 1,
            Self::Int32 | Self::Float32 => 4,
            Self::Int64 | Self::Float64 => 8,
        }
    }

    /// NumPy's name for this type.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::U8 => "uint8",
            Self::Int32 => "int32",
            Self::Int64 => "int64",
            Self::Float32 => "float32",
            Self::Float64 => "float64",
        }
    }
}

/// A Rust type that a column can hold.
pub trait Element: bytemuck::Pod + PartialEq + std::fmt::Debug {
    /// Whether columns of `dtype` hold this type.
    fn is(dtype: DType) -> bool;
}

macro_rules! element {
    ($($t:ty => $pat:pat),* $(,)?) => {
        $(impl Element for $t {
            fn is(dtype: DType) -> bool {
                matches!(dtype, $pat)
            }
        })*
    };
}
element! {
    u8 => DType::U8 | DType::Bool,
    i32 => DType::Int32,
    i64 => DType::Int64,
    f32 => DType::Float32,
    f64 => DType::Float64,
}

/// The limit of a row of one column, in bytes. Shapes come from files, too, so no size computation may overflow.
const LARGEST_ROW: usize = 1 << 36;

/// One column: its name, element type, and the shape of one row (empty for a scalar).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ColumnSpec {
    /// The column's name.
    pub name: String,
    /// The type of its elements.
    pub dtype: DType,
    /// The shape of one row.
    pub shape: Vec<usize>,
}

impl ColumnSpec {
    /// A column of `shape` elements of `dtype` per row.
    pub fn new(name: impl Into<String>, dtype: DType, shape: impl Into<Vec<usize>>) -> Self {
        Self { name: name.into(), dtype, shape: shape.into() }
    }

    /// A column of RGB images, `[height, width, 3]` bytes per row.
    pub fn image(name: impl Into<String>, height: usize, width: usize) -> Self {
        Self::new(name, DType::U8, [height, width, 3])
    }

    /// The number of elements of one row.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether a row has no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The number of bytes of one row.
    pub fn row_bytes(&self) -> usize {
        self.len() * self.dtype.size()
    }

    /// The number of bytes of one row, or `None` above [`LARGEST_ROW`].
    fn checked_row_bytes(&self) -> Option<usize> {
        let bytes = self.shape.iter().try_fold(self.dtype.size(), |bytes, &side| bytes.checked_mul(side))?;
        (bytes <= LARGEST_ROW).then_some(bytes)
    }

    /// Whether rows are RGB images.
    pub fn is_image(&self) -> bool {
        self.dtype == DType::U8 && matches!(self.shape[..], [_, _, 3])
    }
}

/// The columns of a [`crate::Batch`], in order. Cheap to clone.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "Vec<ColumnSpec>", try_from = "Vec<ColumnSpec>")]
pub struct Schema(Arc<[ColumnSpec]>);

impl From<Schema> for Vec<ColumnSpec> {
    fn from(schema: Schema) -> Self {
        schema.0.to_vec()
    }
}

impl TryFrom<Vec<ColumnSpec>> for Schema {
    type Error = Error;

    fn try_from(columns: Vec<ColumnSpec>) -> Result<Self> {
        Self::new(columns)
    }
}

/// The largest number of columns of a schema. Columns are searched by name one after another.
pub const LARGEST_SCHEMA: usize = 4096;

/// Checks the number of columns that a file or a caller declares.
///
/// # Errors
/// When there are more than [`LARGEST_SCHEMA`].
pub fn check_column_count(count: usize) -> Result<()> {
    if count <= LARGEST_SCHEMA {
        return Ok(());
    }
    let problem = format!("{count} columns, of at most {LARGEST_SCHEMA}");
    Err(Error::config("schema", problem, "store values of one kind in one column, as a vector"))
}

impl Schema {
    /// A schema of these columns.
    ///
    /// # Errors
    /// When there are more than [`LARGEST_SCHEMA`] columns, two columns have the same name, or a row of a column has more
    /// than 64 GiB.
    pub fn new(columns: impl Into<Vec<ColumnSpec>>) -> Result<Self> {
        let columns = columns.into();
        check_column_count(columns.len())?;
        let mut names = HashSet::with_capacity(columns.len());
        for column in &columns {
            if column.checked_row_bytes().is_none() {
                return Err(Error::config(
                    format!("column '{}'", column.name),
                    format!("its rows have the shape {:?}, which is too large", column.shape),
                    "check the file that it comes from",
                ));
            }
            if !names.insert(&*column.name) {
                return Err(Error::config(
                    "schema",
                    format!("two columns are named '{}'", column.name),
                    "give every column its own name",
                ));
            }
        }
        Ok(Self(columns.into()))
    }

    /// The columns.
    pub fn columns(&self) -> &[ColumnSpec] {
        &self.0
    }

    /// The number of bytes of one row of all columns.
    pub fn row_bytes(&self) -> usize {
        self.0.iter().map(ColumnSpec::row_bytes).fold(0, usize::saturating_add)
    }

    /// The index of a column, if the schema has it.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.0.iter().position(|column| column.name == name)
    }

    /// The index of a column.
    ///
    /// # Errors
    /// When no column has that name; the error suggests similar names.
    pub fn index(&self, name: &str) -> Result<usize> {
        self.find(name).ok_or_else(|| {
            Error::unknown(
                "column",
                name,
                self.0.iter().map(|c| c.name.as_str()),
                format!("the columns are {}", self.0.iter().map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ")),
            )
        })
    }

    /// The column of a name.
    ///
    /// # Errors
    /// As [`Schema::index`].
    pub fn column(&self, name: &str) -> Result<&ColumnSpec> {
        Ok(&self.0[self.index(name)?])
    }

    /// The columns in words, for errors.
    pub(super) fn describe(&self) -> String {
        let columns: Vec<String> =
            self.0.iter().map(|c| format!("{} {}{:?}", c.name, c.dtype.name(), c.shape)).collect();
        columns.join(", ")
    }
}
